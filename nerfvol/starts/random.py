"""Random points in a scene's box: enough for objects, whose cameras stand outside and see it whole."""

from __future__ import annotations

import numpy as np

from nerfvol.datasets.dataset import SceneBounds
from nerfvol.errors import InputError
from nerfvol.splats.points import PointCloud

POINTS = 3_000


def random_points(scene: SceneBounds, n: int = POINTS, seed: int = 0) -> PointCloud:
    """n points, uniform in the scene's region of detail, of mid-grey; the same ones for the same seed.

    Raises:
        InputError: n is below 1.
    """
    if n < 1:
        raise InputError(f"a start needs at least one random point, got {n}")
    low, high = scene.aabb
    positions = low + (high - low) * np.random.default_rng(seed).random((n, 3))
    return PointCloud(positions, np.full((n, 3), 0.5, np.float32))
