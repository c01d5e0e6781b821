"""The width of the leaves that are seen: of a wall whose distance is known."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.measure.leaf_width import visible_widths
from nerfvol.octree.tree import Octree

LEVEL, FOCAL, AWAY = 4, 200.0, 3.0


def wall(density: float) -> tuple[Octree, list[Camera]]:
    """Leaves of 1/16 that fill the unit cube, and a camera AWAY before the face z = 1, which fills its picture."""
    n = 1 << LEVEL
    cells = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(len(cells), LEVEL), cells, (0.0, 0.0, 0.0), 1.0, 0, 1.0)
    octree.density = density
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 0.5, 1 + AWAY
    return octree, [Camera(Intrinsics(60, 40, FOCAL, FOCAL, 30.0, 20.0), pose)]


def test_leaves_of_a_wall_are_as_wide_as_their_distance_says():
    octree, cameras = wall(1e4)
    widths = visible_widths(octree, cameras)
    assert len(widths) == 60 * 40
    tilted = np.hypot(FOCAL, np.hypot(30, 20)) / FOCAL  # how much longer the way to the picture's corner is
    side = 1 / (1 << LEVEL)
    assert widths.max() <= side * FOCAL / AWAY * (1 + 1e-5)
    assert widths.min() >= side * FOCAL / ((AWAY + side) * tilted)


def test_a_thinned_picture_says_the_same_of_the_whole_one():
    octree, (camera,) = wall(1e4)
    larger = Camera(Intrinsics(600, 400, 10 * FOCAL, 10 * FOCAL, 300.0, 200.0), camera.c2w)
    widths = visible_widths(octree, [larger])
    assert len(widths) < 10_000 and np.median(widths) == pytest.approx(
        10 * np.median(visible_widths(octree, [camera])), rel=0.02
    )


def test_haze_through_which_one_sees_counts_for_nothing():
    octree, cameras = wall(0.5)  # opacity 1 - exp(-0.5 e^-0.5..) stays below a half
    assert len(visible_widths(octree, cameras)) == 0
