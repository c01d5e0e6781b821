"""Motions of cameras: what they mean, steps that find a way back, and what of them is no motion of the cameras at all."""

import dataclasses

import numpy as np
import pytest
import torch

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.cameras.motions import Motions, moved
from nerfvol.kernels import splat_reference
from nerfvol.kernels.splat_state import view_of
from nerfvol.rotations import rotation_of

LENS = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)


def ring(n=9, radius=3.0):
    angles = 2 * np.pi * np.arange(n) / n
    return [Camera(LENS, look_at((radius * np.cos(a), radius * np.sin(a), 0.5), (0, 0, 0))) for a in angles]


def off_by(cameras, degrees, share, seed=0):
    """The cameras, each turned by ``degrees`` and shifted by ``share`` of 3 units, in directions of its own."""
    rng, out = np.random.default_rng(seed), []
    for camera in cameras:
        w, v = rng.normal(size=(2, 3))
        motion = np.concatenate([np.radians(degrees) * w / np.linalg.norm(w), 3 * share * v / np.linalg.norm(v)])
        out.append(dataclasses.replace(camera, c2w=moved(camera.c2w, motion)))
    return out


def test_a_motion_is_what_the_kernels_mean_by_it():
    motion = [0.1, -0.2, 0.05, 0.3, 0.1, -0.2]
    camera, origin = ring()[2], np.array([0.3, 0.1, -0.4])
    view = view_of(dataclasses.replace(camera, c2w=moved(camera.c2w, motion)), origin)
    rotation, translation, eye = splat_reference.moved(
        view_of(camera, origin), torch.tensor(motion, dtype=torch.float64)
    )
    np.testing.assert_allclose(view.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(view.translation, translation, atol=1e-12)
    np.testing.assert_allclose(view.eye, eye, atol=1e-12)


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-3, 2.0])
def test_rotations_of_vectors(length):
    w = length * np.array([0.48, -0.6, 0.64])
    x, y, z = w
    twin = torch.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))
    np.testing.assert_allclose(rotation_of(w), twin, atol=1e-15)


def gradient_of(pose, true, points):
    """Of half the mean squared distance in pixels between where a camera sees points (n, 3) and where the true one does, in a
    motion (6,), by central differences."""

    def loss(motion):
        seen = []
        for c2w in (moved(pose, motion), true):
            t = (points - c2w[:3, 3]) @ (c2w[:3, :3] * (1, -1, -1))
            seen.append(LENS.fx * t[:, :2] / t[:, 2:])
        return ((seen[0] - seen[1]) ** 2).sum(1).mean() / 2

    h = 1e-6 * np.eye(6)
    return np.array([(loss(e) - loss(-e)) / 2e-6 for e in h])


def test_steps_lead_back():
    """0.5 degrees and 1 % are 1.3 pixels here; 120 visits with steps of 0.3 to 0.01 pixels leave less than a tenth."""
    cameras = ring()
    motions = Motions(off_by(cameras, 0.5, 0.01), 3.0)
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3))
    true = Motions(cameras, 3.0)
    before = [gap(motions, true, i, points) for i in range(len(cameras))]
    for visit in range(120):
        for i, camera in enumerate(cameras):
            g = gradient_of(motions.poses[i], camera.c2w, points)
            motions.step(i, g, LENS, 0.3 * 0.03 ** (visit / 120))
    after = [gap(motions, true, i, points) for i in range(len(cameras))]
    assert np.median(before) > 0.4 and max(after) < 0.1 * np.median(before)


def gap(a, b, i, points):
    """Root mean square distance in pixels between where two cameras see points."""
    seen = []
    for motions in (a, b):
        pose = motions.poses[i]
        t = (points - pose[:3, 3]) @ (pose[:3, :3] * (1, -1, -1))
        seen.append(LENS.fx * t[:, :2] / t[:, 2:])
    return float(np.sqrt(((seen[0] - seen[1]) ** 2).sum(1).mean()))


def test_steps_turn_about_the_pivot():
    """A gradient of turning alone leaves the pivot where it is seen; one of shifting alone, w = p x v, turns nothing."""
    motions, still = Motions(ring(), 3.0), ring()[2].c2w
    motions.step(2, [1.0, -2.0, 0.5, 0.0, 0.0, 0.0], LENS, 5.0)
    pose = motions.poses[2]
    pivot = still[:3, 3] - 3 * still[:3, 2]
    np.testing.assert_allclose((pivot - pose[:3, 3]) @ (pose[:3, :3] * (1, -1, -1)), [0, 0, 3], atol=1e-12)
    assert np.abs(pose - still).max() > 0.01
    shifted, v = Motions(ring(), 3.0), np.array([1.0, -2.0, 0.5])
    shifted.step(2, [*np.cross([0, 0, 3], v), *v], LENS, 5.0)
    np.testing.assert_allclose(shifted.poses[2][:3, :3], still[:3, :3], atol=1e-12)
    assert np.abs(shifted.poses[2] - still).max() > 0.01


def test_what_all_cameras_do_together_is_undone():
    """A turn, a shift and a growth of scene and cameras together show the same."""
    motions = Motions(ring(), 3.0)
    turn, scale, shift = rotation_of([0.2, 0.1, -0.3]), 1.3, np.array([0.5, -1.0, 2.0])
    motions.poses[:, :3, :3] = turn @ motions.given[:, :3, :3]
    motions.poses[:, :3, 3] = scale * motions.given[:, :3, 3] @ turn.T + shift
    found, rotation, back = motions.back()
    np.testing.assert_allclose([found, *rotation.ravel()], [1 / scale, *turn.T.ravel()], atol=1e-12)
    np.testing.assert_allclose(back, -turn.T @ shift / scale, atol=1e-12)
    np.testing.assert_allclose(motions.put_back(), motions.given, atol=1e-12)
    assert motions.pixels([LENS] * 9).max() < 1e-9


def test_pixels_say_how_far_a_picture_moved():
    motions = Motions(ring(), 3.0)
    motions.poses[4] = moved(motions.poses[4], [0, np.radians(1.0), 0, 0, 0, 0])
    pixels = motions.pixels([LENS] * 9)
    # A degree is 1.22 pixels in the middle, 8 % more at the corners looked at; the others take a ninth of it or less.
    assert 8 / 9 * np.radians(1) * LENS.fx < pixels[4] < 1.08 * np.radians(1) * LENS.fx
    assert pixels[[0, 1, 2, 3, 5, 6, 7, 8]].max() < 0.3


def test_motions_go_through_a_checkpoint():
    first, second = Motions(ring(), 3.0), Motions(ring(), 3.0)
    first.step(2, [1.0, 2, 3, 4, 5, 6], LENS, 0.3)
    second.load_state_dict(first.state_dict())
    for motions in (first, second):
        motions.step(2, [1.0, 0, 3, -4, 5, 6], LENS, 0.3)
    assert np.array_equal(first.poses, second.poses) and first.visits[2] == 2
    with pytest.raises(ValueError, match="refined poses: poses"):
        Motions(ring(5), 3.0).load_state_dict(first.state_dict())
