"""Exposure and white balance of photographs, from themselves: what they share was as bright for all of them.

A plane sweep compares photographs by a correlation that no exposure changes, and finds where one's pixels are in its
neighbours. Of each pair the middle ratio of these colours is the ratio of two exposures; all of them together give each
photograph's, by least squares on logarithms. No model is asked, which would take exposures for haze or for shine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.canvas import MAX_ANGLE
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.defaults import WHITE
from nerfvol.starts.choose import sweep_views
from nerfvol.starts.plane_sweep import SweepView, depth_maps, matched_pixels, sweep_factor
from nerfvol.starts.subject import subject_of

Float = NDArray[np.float64]
EVEN = 0.05
"""Standard deviation of the logarithms of the photographs' mean brightness, below which their exposures cannot differ much."""
FEWEST = 40
"""Pixels that a pair must share."""
DARK, SATURATED = 12, 245
"""Of 255: pixels outside say nothing of a ratio."""
COVERED = 0.8
"""Share of the photographs that must be compared with others."""
PRIOR = 1e-4
"""Weight of each logarithm's own square, next to a pair's 1."""


@dataclass(frozen=True, eq=False)
class Exposures:
    """``gains`` (n, 3): factor of each photograph to the mean by channel, 1 where it was not compared. ``spread``: how far
    photographs that stand next to each other are from one exposure, as a standard deviation of factors; what changes slowly
    along a walk a model's view dependence takes up, and shows rightly from between. ``error``: how far pairs are from what the
    gains say."""

    gains: Float
    spread: float
    error: float


def measure_exposures(dataset: Dataset, photographs: Photographs | None = None) -> Exposures | None:
    """Exposures of a dataset's photographs; None where they share too little. ``photographs``: those of the dataset, where they
    are there already."""
    n = len(dataset)
    if n < 3:
        return None
    if brightness_spread(dataset) < EVEN:
        return Exposures(np.ones((n, 3)), 0.0, 0.0)
    subject = subject_of(dataset)
    if photographs is None:
        sizes = [(c.intrinsics.width, c.intrinsics.height) for c in dataset.cameras]
        factor = max(1, sweep_factor(*(int(np.median(side)) for side in zip(*sizes, strict=True))) // 2)
        photographs = Photographs(dataset.smaller(factor, WHITE), max_angle=MAX_ANGLE)
    views = sweep_views(photographs)
    pairs, ratios = [], []
    for here, there, a, b in matched_pixels(
        views, depth_maps(views, subject.near, subject.far), subject.near, subject.far
    ):
        ratio = _ratio(views, here, there, a, b)
        if ratio is not None:
            pairs.append((here, there))
            ratios.append(ratio)
    if len(np.unique(np.array(pairs))) < COVERED * n:
        return None
    return solve(n, np.array(pairs), np.array(ratios))


def brightness_spread(dataset: Dataset) -> float:
    """Standard deviation of the logarithms of the photographs' mean brightness."""
    means = []
    for image in dataset.images:
        some = image[::4, ::4].reshape(-1, image.shape[2])
        some = some[some[:, 3] > 250] if some.shape[1] == 4 else some
        means.append(some[:, :3].mean() if len(some) else np.nan)
    return float(np.nanstd(np.log(np.maximum(means, 1.0))))


def _ratio(
    views: Sequence[SweepView], here: int, there: int, a: NDArray[np.int64], b: NDArray[np.int64]
) -> Float | None:
    """(3,) logarithm of what channels of view ``there`` are to those of ``here``, at the flat pixel numbers b and a."""
    first, second = (views[k].image.reshape(-1, 4)[p].astype(np.float64) for k, p in ((here, a), (there, b)))
    usable = (second[:, 3] > 250) & (first[:, 3] > 250)
    for colours in (first[:, :3], second[:, :3]):
        usable &= (colours > DARK).all(1) & (colours < SATURATED).all(1)
    if usable.sum() < FEWEST:
        return None
    return np.median(np.log(second[usable, :3] / first[usable, :3]), axis=0)


def solve(n: int, pairs: NDArray[np.int64], ratios: Float) -> Exposures:
    """Exposures of n photographs from logarithms ``ratios`` (m, 3) of pairs (m, 2): second over first."""
    normal, right = PRIOR * np.eye(n), np.zeros((n, 3))
    for (i, j), ratio in zip(pairs, ratios, strict=True):
        normal[[i, j], [i, j]] += 1
        normal[[i, j], [j, i]] -= 1
        right[j] += ratio
        right[i] -= ratio
    logs = np.linalg.solve(normal, right)
    left = ratios - (logs[pairs[:, 1]] - logs[pairs[:, 0]])
    gains = np.exp(logs)
    seen = np.unique(pairs)
    gains /= gains[seen].mean(0)
    unseen = np.setdiff1d(np.arange(n), seen)
    gains[unseen] = 1.0
    # Of robust deviations, for a pair that met a shadow is off by any factor.
    error = 1.4826 * float(np.median(np.abs(left.mean(1))))
    apart = (logs[pairs[:, 1]] - logs[pairs[:, 0]]).mean(1)
    return Exposures(gains, float(np.sqrt((apart * apart).mean() / 2)), error)
