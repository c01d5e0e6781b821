"""Whether a camera only turned: matches of all pairs that one rotation each explains say nothing of depth.

A rotation between two pictures is the one that best turns the rays of the first onto those of the second (Kabsch 1976);
what it leaves is parallax. Neighbours of a slow walk have little of it, pairs further apart have it, and a camera that
turned on the spot has none in any pair. The focal length is not known yet: the one that leaves least is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
FOCALS = (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
"""Of the longer side."""
MOST_PAIRS = 60


def parallax(pairs: Sequence[tuple[Points, Points]], focals: Sequence[float] = FOCALS) -> float:
    """Parallax of the pairs that have most (their 90th percentile), as a share of a picture's longer side; -1 without pairs.

    ``pairs``: matched positions (n, 2) each, relative to the middle of their pictures, in longer sides.
    """
    chosen = np.unique(np.linspace(0, len(pairs) - 1, MOST_PAIRS).round().astype(int)) if pairs else []
    if not len(chosen):
        return -1.0
    return min(
        float(np.quantile([_left_by_rotation(pairs[i][0], pairs[i][1], focal) for i in chosen], 0.9))
        for focal in focals
    )


def _left_by_rotation(a: Points, b: Points, focal: float) -> float:
    """Median distance of matches after the best rotation, in longer sides."""
    rays_a, rays_b = (_rays(points, focal) for points in (a, b))
    keep = np.ones(len(a), bool)
    left = np.zeros(len(a))
    for _ in range(2):  # the second time without the half that fits worst: near things, where there is depth
        u, _, vt = np.linalg.svd(rays_b[keep].T @ rays_a[keep])
        rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
        turned = rays_a @ rotation.T
        seen = focal * turned[:, :2] / np.maximum(turned[:, 2:], 1e-3)
        left = np.linalg.norm(seen - b, axis=1)
        keep = left <= np.quantile(left, 0.8)
    return float(np.median(left))


def _rays(points: Points, focal: float) -> Points:
    rays = np.concatenate([points / focal, np.ones((len(points), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
