"""Leaves as Gaussians, and splats in turned axes, drawn by the tests' own rasteriser."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.octree.points import leaf_density
from nerfvol.rotations import rotations
from nerfvol.splats.turn import turned
from nerfvol.starts.gaussians import splats_of_leaves
from nerfvol.views import OctreeModel, SplatModel
from tests.export.rasteriser import harmonics, rasterise
from tests.export.shapes import BLUE, CENTER, RED, ball, box
from tests.splats.scenes import ORIGIN, random_splats


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


def test_a_leaf_keeps_its_optical_depth():
    """What a Gaussian stops of the light through the leaf's face, in closed form: opacity x 2 pi s^2 = opacity x h^2 x
    1.005."""
    octree = box()
    splats = splats_of_leaves(octree)
    side, opacity = octree.leaf_sizes(), 1 / (1 + np.exp(-splats.logits.astype(float)))
    scale = np.exp(splats.log_scales.astype(float))
    assert splats.n == octree.n_leaves and np.allclose(2 * np.pi * scale**2, side[:, None] ** 2, rtol=0.006)
    assert np.allclose(opacity, np.minimum(1 - np.exp(-leaf_density(octree) * side), 0.999), atol=1e-6)
    assert np.allclose(splats.means + splats.origin, octree.leaf_centers(), atol=1e-6)


def test_leaves_look_like_the_octree(tmp_path):
    """The cube at leaves of four pixels: soft edges, the same place and colours."""
    model = OctreeModel(box(mixed=False))
    export_model(model, tmp_path / "s.ply", "splats")
    camera = Camera(Intrinsics(64, 64, 80.0, 80.0, 32.0, 32.0), look_at((0.4, -2.2, 1.0), (0, 0.5, -0.25)))
    ours = model.render(camera, (1, 1, 1))["rgb"]
    theirs = rasterise(tmp_path / "s.ply", camera.c2w, 80.0, 64, 64, (1, 1, 1))
    assert psnr(ours, theirs) > 22
    for half, colour in ((ours[..., 0] > 0.6, RED), (ours[..., 2] > 0.6, BLUE)):
        inner = half & (np.abs(ours - colour).max(-1) < 0.01)
        assert inner.sum() > 50 and np.abs(np.median(theirs[inner], axis=0) - colour).max() < 0.03


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_scene_looks_the_same_from_turned_cameras(degree):
    splats = random_splats(300, (degree + 1) ** 2, degree, "plain", size=0.08)
    turn = rotations([[0.3, -0.5, 0.7, 0.4]])[0]
    pose = look_at(ORIGIN + (0.3, -3.0, 0.8), ORIGIN)
    moved = np.eye(4)
    moved[:3] = turn @ pose[:3]
    lens = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    before = SplatModel(splats).render(Camera(lens, pose), (1, 0.5, 0.2), early_stop_eps=0.0)["rgb"]
    after = SplatModel(turned(splats, turn)).render(Camera(lens, moved), (1, 0.5, 0.2), early_stop_eps=0.0)["rgb"]
    assert psnr(before, after) > 60


def test_the_harmonics_turn_by_another_evaluation():
    """f'(R d) = f(d) with the rasteriser's own polynomials."""
    splats = random_splats(5, 9, 1)
    turn = rotations([[0.9, 0.1, -0.4, 0.3]])[0]
    d = np.random.default_rng(0).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before, after = splats.sh @ harmonics(d, 2).T, turned(splats, turn).sh @ harmonics(d @ turn.T, 2).T
    assert np.abs(before - after).max() < 1e-5


def test_up_and_what_cannot_be(tmp_path):
    model = OctreeModel(ball(4))
    export_model(model, tmp_path / "a.ply", "splats")
    export_model(model, tmp_path / "b.ply", "splats", up="-y")
    places = [SplatModel.load(tmp_path / name).splats.means for name in ("a.ply", "b.ply")]
    assert np.allclose(places[1], places[0] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-6)  # (x, -z, y)
    assert np.allclose(places[0].mean(0), CENTER, atol=0.02)
    clear = ball(3)
    clear.density = -20.0
    with pytest.raises(InputError, match="no leaf .* dense enough"):
        export_model(OctreeModel(clear), tmp_path / "c.ply", "splats")
