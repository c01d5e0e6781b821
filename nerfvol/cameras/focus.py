"""The point that cameras look at, and cameras that stand or look where the others do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera

_LEAST_CERTAINTY = 1e-3  # optical axes within about 2 degrees of one another meet nowhere
_ROUNDS = 30
_OFF = 6.0  # medians of the axes' distances to the point, beyond which an axis has no say in it
_FAR = 20.0  # medians of the cameras' distances to their middle, beyond which one was put there by mistake
_FEW = 0.1  # ... where at most this share of them lies so far out


@dataclass(frozen=True, eq=False)
class Focus:
    """Where optical axes meet.

    ``point`` (3,): nearest to all axes, scene units. ``certainty``: how well they fix it, from 0 (parallel) to 2/3: about
    the mean squared sine between the axes. ``ahead``: the share of the cameras that have it before them. ``spread``: the
    median angle, radians, by which axes miss it.
    """

    point: NDArray[np.float64]
    certainty: float
    ahead: float
    spread: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Whether the axes meet, and not behind the cameras' backs."""
        return self.certainty >= _LEAST_CERTAINTY and self.ahead >= 0.5


def focus_point(cameras: Sequence[Camera]) -> Focus:
    """The point nearest to all optical axes in least squares (at least one camera), whatever a few of them do.

    Each axis o + t d contributes |(I - d d^T)(x - o)|^2; certainty is the smallest eigenvalue of the mean of I - d d^T.
    Axes that miss the point of least mean distance (by weights 1 / distance, Weiszfeld 1937) six times as far as the median
    axis are left out: one camera astray would move a least-squares point at will.
    """
    return focus_of(np.stack([camera.c2w for camera in cameras]))


def focus_of(poses: NDArray[np.float64]) -> Focus:
    """As :func:`focus_point`, of camera-to-world matrices (n, 4, 4)."""
    origins, axes = poses[:, :3, 3], -poses[:, :3, 2]
    middle = np.median(origins, axis=0)
    origins = origins - middle  # map coordinates would cost the squares their digits
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    kept = _agreeing(across, origins)
    matrix = across[kept].mean(axis=0)
    certainty = float(np.linalg.eigvalsh(matrix)[0])
    right = (across[kept] @ origins[kept][:, :, None]).mean(axis=0)[:, 0]
    point = np.linalg.lstsq(matrix, right, rcond=None)[0]
    along = ((point - origins) * axes).sum(axis=1)
    missed = np.linalg.norm(across @ (point - origins)[:, :, None], axis=1)[:, 0]
    return Focus(
        point + middle, certainty, float(np.mean(along > 0)), float(np.median(np.arctan2(missed, np.abs(along))))
    )


def _agreeing(across: NDArray[np.float64], origins: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which axes have a say, (n,) bool; all of them where fewer than five do, or where they meet nowhere."""
    everything = np.ones(len(origins), dtype=bool)
    if len(origins) < 5 or float(np.linalg.eigvalsh(across.mean(axis=0))[0]) < _LEAST_CERTAINTY:
        return everything
    weight = np.ones(len(origins))
    distance, point = weight, np.zeros(3)
    for _ in range(_ROUNDS):
        matrix = (across * weight[:, None, None]).sum(axis=0)
        right = ((across @ origins[:, :, None])[:, :, 0] * weight[:, None]).sum(axis=0)
        point = np.linalg.lstsq(matrix, right, rcond=None)[0]
        distance = np.linalg.norm(across @ (point - origins)[:, :, None], axis=1)[:, 0]
        weight = 1 / np.maximum(distance, 1e-6 * max(float(distance.max()), 1e-300))
    # Axes that meet exactly have a median of rounding errors: what is as near as that to the cameras' own size is no outlier.
    small = 1e-3 * float(np.median(np.linalg.norm(point - origins, axis=1)))
    kept = distance <= max(_OFF * float(np.median(distance)), small)
    return kept if kept.mean() >= 0.5 else everything


@dataclass(frozen=True, eq=False)
class Crowd:
    """Where most cameras stand: around ``middle`` (3,), half of them within ``radius``; scene units."""

    middle: NDArray[np.float64]
    radius: float

    def astray(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of ``positions`` (n, 3) lie twenty radii out or more, (n,) bool: no capture reaches so far with a few of its
        photographs. None where more than a tenth do."""
        far = np.linalg.norm(positions - self.middle, axis=1) > _FAR * self.radius
        return far if self.radius > 0 and far.mean() <= _FEW else np.zeros(len(positions), dtype=bool)


def crowd_of(positions: NDArray[np.float64]) -> Crowd:
    """The crowd of cameras at ``positions`` (n, 3), n > 0."""
    middle = np.median(positions, axis=0)
    return Crowd(middle, float(np.median(np.linalg.norm(positions - middle, axis=1))))
