"""Where the scene is when the cameras' axes do not tell: what a plane sweep finds several photographs to agree on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.canvas import MAX_ANGLE
from nerfvol.datasets.bounds import bounds_of_points
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.region import SceneBounds
from nerfvol.starts.choose import sweep_views
from nerfvol.starts.plane_sweep import DepthMap, SweepView, depth_maps

NEAREST, FARTHEST = 0.3, 60.0
"""Of half the cameras' spread: depths at which places are looked for."""
FEWEST = 300
"""Places that must be found, or a guess is as good."""
MOST_VIEWS = 48


def region_of_sweep(dataset: Dataset) -> tuple[SceneBounds, str] | None:
    """The dataset's bounds with the region of detail around what its photographs agree on, and a sentence; None where they
    agree on too little."""
    few = dataset.evenly(MOST_VIEWS)
    spread = _spread(few.cameras)
    if not spread > 0:
        return None
    views = sweep_views(Photographs(few, max_angle=MAX_ANGLE))
    maps = depth_maps(views, NEAREST * spread, FARTHEST * spread)
    points = np.concatenate([_places(views[m.view], m) for m in maps])
    if len(points) < FEWEST:
        return None
    bounds = bounds_of_points(points, dataset.scene)
    low, high = (" ".join(f"{x:.4g}" for x in corner) for corner in bounds.aabb)
    return bounds, f"scene bounds: {low} to {high}, around {len(points):,} places that several photographs agree on"


def _spread(cameras: list[Camera]) -> float:
    """The median distance of the cameras from their middle."""
    positions = np.stack([camera.position for camera in cameras])
    return float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))


def _places(view: SweepView, found: DepthMap) -> NDArray[np.float64]:
    """The points (n, 3), scene units, of a depth map's confident pixels."""
    rows, columns = np.nonzero(found.confident)
    origin, directions = view.camera.rays_at(np.stack([columns + 0.5, rows + 0.5], axis=1))
    depth = 1 / found.inverse_depth[rows, columns].astype(np.float64)
    return origin + directions * (depth / (directions @ view.camera.forward))[:, None]
