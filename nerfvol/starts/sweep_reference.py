"""The plane sweep of csrc/sweep.cpp in numpy: what runs where nothing is compiled, and what the kernel is tested against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
RADIUS = 3
FLOOR = 4e-5


@dataclass(frozen=True, eq=False)
class SweepTask:
    """What a sweep works on, in the order in which the kernel takes it.

    ``greys``: (h, w) float32 in [0, 1]; ``masks``: (h, w) uint8 or None; ``picture`` (m,) int32: which are references;
    ``others`` (m, k) int32: what each is compared with, -1 for nothing; ``maps`` (m, k, 12) float32: how (A and b);
    ``apart`` (m,) int32: planes between the best and its rival; ``planes`` of them, inverse depths ``first`` + i ``step``.
    """

    greys: Sequence[Float]
    masks: Sequence[NDArray[np.uint8] | None]
    picture: NDArray[np.int32]
    others: NDArray[np.int32]
    maps: Float
    apart: NDArray[np.int32]
    planes: int
    first: float
    step: float


def plane_sweep(
    task: SweepTask, inverse_depth: Sequence[Float], score: Sequence[Float], rival: Sequence[Float]
) -> None:
    """Writes three pictures a reference, of its size: inverse depth, its score (-1: none) and the best rival's."""
    for r, p in enumerate(task.picture):
        grey, mask = task.greys[p], task.masks[p]
        scores = np.full((task.planes, *grey.shape), -1.0)
        compared = [(int(j), task.maps[r, k]) for k, j in enumerate(task.others[r]) if j >= 0]
        for plane in range(task.planes):
            w = task.first + task.step * plane
            zncc = [_zncc(grey, *_seen(task.greys[j], task.masks[j], m, w, grey.shape)) for j, m in compared]
            if zncc:
                best_two = np.sort(np.stack(zncc), axis=0)[-2:]
                scores[plane] = np.where(best_two[0] > -1, best_two.mean(axis=0), -1.0)  # both must see the pixel
        best = scores.argmax(axis=0)
        away = np.abs(np.arange(task.planes)[:, None, None] - best) >= task.apart[r]
        rival[r][:] = np.where(away, scores, -1.0).max(axis=0)
        inverse_depth[r][:] = task.first + task.step * (best + _shift(scores, best))
        top = np.take_along_axis(scores, best[None], 0)[0]
        score[r][:] = top if mask is None else np.where(mask > 0, top, -1.0)


def _seen(
    grey: Float, mask: NDArray[np.uint8] | None, m: NDArray[Any], w: float, shape: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The greys of a picture seen through plane w, and where they are on it."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    m = m.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = m[6] * x + m[7] * y + m[8] + w * m[11]
        u, v = (m[0] * x + m[1] * y + m[2] + w * m[9]) / z, (m[3] * x + m[4] * y + m[5] + w * m[10]) / z
    height, width = grey.shape
    inside = (z > 1e-6) & (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
    u, v = (np.clip(np.nan_to_num(a) - 0.5, 0, n - 1) for a, n in ((u, width), (v, height)))
    i, j = np.minimum(u.astype(int), max(width - 2, 0)), np.minimum(v.astype(int), max(height - 2, 0))
    i1, j1, au, av = np.minimum(i + 1, width - 1), np.minimum(j + 1, height - 1), u - i, v - j
    top, low = (grey[row, i] + au * (grey[row, i1] - grey[row, i]) for row in (j, j1))
    if mask is not None:
        inside &= mask[(v + 0.5).astype(int), (u + 0.5).astype(int)] > 0
    return top + av * (low - top), inside


def _window_sums(a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over the 7x7 pixels around each that are on the picture."""
    total = np.pad(a, ((RADIUS + 1, RADIUS), (RADIUS + 1, RADIUS))).cumsum(0).cumsum(1)
    size = 2 * RADIUS + 1
    return total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]


def _zncc(a: Float, b: NDArray[np.float64], inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    d, b = a.astype(np.float64) - 0.5, b - 0.5
    n, sa, sb, saa, sbb, sab = (_window_sums(x) for x in (np.ones_like(d), d, b, d * d, b * b, d * b))
    deviations = np.sqrt((np.maximum(saa - sa * sa / n, 0) + FLOOR) * (np.maximum(sbb - sb * sb / n, 0) + FLOOR))
    return np.where(inside, (sab - sa * sb / n) / deviations, -1.0)


def _shift(scores: NDArray[np.float64], best: NDArray[np.int64]) -> NDArray[np.float64]:
    """The top of the parabola through the best plane's score and its neighbours', in planes from the best."""
    planes = len(scores)
    before, top, after = (np.take_along_axis(scores, np.clip(best + k, 0, planes - 1)[None], 0)[0] for k in (-1, 0, 1))
    bend = before - 2 * top + after
    between = (best > 0) & (best < planes - 1) & (before > -1) & (after > -1) & (bend < 0)
    return np.where(between, np.clip(0.5 * (before - after) / np.where(between, bend, 1), -0.5, 0.5), 0.0)
