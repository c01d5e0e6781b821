"""The region that a scene takes up, against its definition in words."""

import numpy as np

from nerfvol.region import SceneBounds, cube


def test_each_background_shell_has_one_level_less() -> None:
    center = np.array([3.0, -1.0, 0.5])
    scene = SceneBounds(cube(center, 2.0), cube(center, 16.0), has_alpha=False)  # doubles three times
    assert scene.n_shells == 3
    # Half edges of the cube and its shells are 2, 4, 8, 16: just inside and just outside each, along an edge and a corner.
    reach = np.array([0.0, 1.9, 2.1, 3.9, 4.1, 7.9, 8.1, 15.9])
    wanted = 5 + 3 - np.array([0, 0, 1, 1, 2, 2, 3, 3])
    for direction in (np.array([1.0, 0, 0]), np.array([0, -1.0, 0]), np.array([1.0, 0.2, -1.0])):
        assert scene.finest_levels(center + reach[:, None] * direction, 5).tolist() == wanted.tolist()


def test_a_scene_without_background_has_one_level_throughout() -> None:
    scene = SceneBounds(cube(np.zeros(3), 1.0), None, has_alpha=True)
    assert scene.n_shells == 0 and not scene.is_unbounded
    assert scene.finest_levels(np.array([[0.0, 0, 0], [0.9, -0.9, 0.9]]), 6).tolist() == [6, 6]
