"""Scene bounds follow from the cameras and scale with them; alpha's values play no part."""

import math

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at, orbit
from nerfvol.cameras.focus import focus_point
from nerfvol.datasets.bounds import BoundsHint, estimate_bounds, require_seen
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds

NERF_SYNTHETIC = Intrinsics(800, 800, 400 / math.tan(0.3455555), 400 / math.tan(0.3455555), 400.0, 400.0)


def hemisphere(n=40, radius=4.031, center=(0.0, 0.0, 0.0), jitter=0.0, seed=0):
    generator = np.random.default_rng(seed)
    cameras = []
    for _ in range(n):
        v = generator.normal(size=3) * (1, 1, 0.7)
        v[2] = abs(v[2])
        eye = np.asarray(center) + radius * v / np.linalg.norm(v)
        target = np.asarray(center) + jitter * generator.normal(size=3)
        cameras.append(Camera(NERF_SYNTHETIC, look_at(eye, target)))
    return cameras


def test_the_focus_is_what_the_cameras_look_at():
    center = np.array([3.0, -1.0, 2.0])
    focus = focus_point(hemisphere(center=center))
    np.testing.assert_allclose(focus.point, center, atol=1e-12)
    assert 0.3 < focus.certainty < 2 / 3 and focus.ahead == 1 and focus.is_clear
    shaken = focus_point(hemisphere(center=center, jitter=0.1, n=400))
    assert np.linalg.norm(shaken.point - center) < 0.03  # 0.1 / sqrt(400), three axes, times a few sigma


def test_parallel_axes_have_no_focus():
    cameras = [Camera(NERF_SYNTHETIC, look_at([x, 0, 5], [x, 0, 0], [0, 1, 0])) for x in range(4)]
    focus = focus_point(cameras)
    assert focus.certainty < 1e-12 and not focus.is_clear


def test_nerf_synthetic_gives_the_classical_box():
    scene, sentence = estimate_bounds(hemisphere(), has_alpha=True)
    np.testing.assert_allclose(scene.aabb, [[-1.495] * 3, [1.495] * 3], atol=0.001)
    assert not scene.is_unbounded and "half side 1.495" in sentence


@pytest.mark.parametrize("has_alpha", [True, False])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_bounds_scale_and_move_with_the_scene(has_alpha, scale):
    center = np.array([3.0, -1.0, 2.0])
    plain, _ = estimate_bounds(hemisphere(), has_alpha)
    moved, _ = estimate_bounds(hemisphere(radius=4.031 * scale, center=center * scale), has_alpha)
    np.testing.assert_allclose(moved.aabb, scale * (plain.aabb + center), rtol=1e-9)


def test_photographs_reach_to_the_cameras_and_have_background_shells():
    scene, _ = estimate_bounds(hemisphere(), has_alpha=False)
    np.testing.assert_allclose(scene.aabb, [[-4.031] * 3, [4.031] * 3], rtol=1e-9)
    np.testing.assert_allclose(scene.background_cube, 16 * scene.aabb)


def test_one_far_camera_does_not_blow_up_the_scene():
    cameras = hemisphere() + [Camera(NERF_SYNTHETIC, look_at([400, 0, 10], [0, 0, 0]))]
    for has_alpha, half in ((True, 1.495), (False, 4.031)):
        scene, _ = estimate_bounds(cameras, has_alpha)
        np.testing.assert_allclose(scene.aabb[1], half, rtol=0.02)


def test_what_the_file_says_is_heeded():
    box = [[-1, -2, -3], [4, 5, 6]]
    scene, sentence = estimate_bounds(hemisphere(), False, BoundsHint(aabb=np.array(box)))
    np.testing.assert_array_equal(scene.aabb, box)
    np.testing.assert_allclose(scene.background_cube, [[-70.5] * 3, [73.5] * 3])
    assert "of the file" in sentence
    small, _ = estimate_bounds(hemisphere(), False, BoundsHint(aabb_scale=1.0))
    np.testing.assert_allclose(small.aabb[1], 0.5 / 0.33)  # instant-ngp's unit cube
    wide, _ = estimate_bounds(hemisphere(), False, BoundsHint(aabb_scale=16.0))
    np.testing.assert_allclose(wide.aabb[1], 4.031)
    around, _ = estimate_bounds(hemisphere(), False, BoundsHint(near_far=(2.0, 6.0)))
    np.testing.assert_allclose(around.aabb[1], 4.031)  # near and far matter to forward-facing cameras alone


@pytest.mark.parametrize("n", [1, 4])
def test_cameras_that_say_nothing_give_a_stated_guess(n):
    cameras = [Camera(NERF_SYNTHETIC, look_at([0.1 * x, 0, 5], [0.1 * x, 0, 0], [0, 1, 0])) for x in range(n)]
    scene, sentence = estimate_bounds(cameras, has_alpha=True)
    assert "a guess" in sentence
    require_seen(scene, cameras)


def test_cameras_that_look_away_give_a_guess():
    outward = [Camera(NERF_SYNTHETIC, look_at(c.position, 2 * c.position)) for c in hemisphere()]
    assert "a guess" in estimate_bounds(outward, has_alpha=False)[1]


def box_at(center, half):
    return SceneBounds(np.array([np.array(center) - half, np.array(center) + half]), None, True)


def test_bounds_must_be_seen_by_somebody():
    cameras = orbit(3, center=(0, 0, 0), radius=4, elevation_deg=0, intrinsics=NERF_SYNTHETIC)
    require_seen(box_at((0, 0, 0), 1.5), cameras)
    require_seen(box_at((0, 0, 0), 100), cameras)  # cameras inside
    require_seen(box_at((0.137, 0.211, 0.173), 1e-4), cameras)  # smaller than a pixel
    close = [Camera(NERF_SYNTHETIC, look_at([7, -100.1, 11], [7, 0, 11]))]
    require_seen(SceneBounds([[-100, -100, -100], [100, -99.9, 100]], None, True), close)  # a wall that fills the view
    with pytest.raises(InputError, match="seen by none of the 3 cameras"):
        require_seen(box_at((0, 0, 50), 1), cameras)
    behind = [Camera(NERF_SYNTHETIC, look_at([0, -4, 0], [0, -8, 0]))]
    with pytest.raises(InputError, match="seen by none of the 1 cameras, the nearest 4 away"):
        require_seen(box_at((0, 0, 0), 1), behind)
