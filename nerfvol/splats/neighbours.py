"""The nearest of many points, exactly: a compiled k-d tree, or numpy over all pairs where nothing is compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.native import native

_PAIRS = 1 << 22  # distances that numpy holds at a time


def nearest(
    points: ArrayLike, k: int, queries: ArrayLike | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Squared distances (m, k) float64 and numbers (m, k) int32 of the k points (n, 3) nearest to queries (m, 3).

    Nearest first, equal distances by number; infinity and -1 where there are fewer than k. Without ``queries`` the points
    themselves are asked and none finds itself. The result is the same for any number of threads.

    Raises:
        ValueError: k below 1, shapes other than (n, 3), or coordinates that are not finite.
    """
    p = np.ascontiguousarray(points, np.float64)
    q = None if queries is None else np.ascontiguousarray(queries, np.float64)
    if k < 1:
        raise ValueError(f"k must be at least 1, got {k}")
    for name, a in (("points", p), ("queries", q)):
        if a is not None and (a.ndim != 2 or a.shape[1] != 3 or not np.isfinite(a).all()):
            raise ValueError(f"{name} must be finite numbers of shape (n, 3), got shape {a.shape}")
    m = len(p) if q is None else len(q)
    squared, index = np.empty((m, k)), np.empty((m, k), np.int32)
    compiled = native()
    if compiled is not None:
        compiled.nearest(p, q, squared, index)
    else:
        _all_pairs(p, q, squared, index)
    return squared, index


def _all_pairs(
    points: NDArray[np.float64],
    queries: NDArray[np.float64] | None,
    squared: NDArray[np.float64],
    index: NDArray[np.int32],
) -> None:
    """The same in numpy: time grows with the square of the points."""
    k, asked = squared.shape[1], points if queries is None else queries
    squared[:], index[:] = np.inf, -1
    found = min(k, len(points))
    if not found:
        return
    run = max(1, _PAIRS // len(points))
    for at in range(0, len(asked), run):
        part = asked[at : at + run]
        x, y, z = ((part[:, None, axis] - points[None, :, axis]) ** 2 for axis in range(3))
        distance = x + y + z
        if queries is None:
            distance[np.arange(len(part)), at + np.arange(len(part))] = np.inf
        order = np.argsort(distance, axis=1, kind="stable")[:, :found]
        squared[at : at + run, :found] = np.take_along_axis(distance, order, 1)
        index[at : at + run, :found] = order
    index[np.isinf(squared)] = -1
