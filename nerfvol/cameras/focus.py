"""The point that cameras look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera

_LEAST_CERTAINTY = 1e-3  # optical axes within about 2 degrees of one another meet nowhere


@dataclass(frozen=True, eq=False)
class Focus:
    """Where optical axes meet.

    ``point`` (3,): nearest to all axes, scene units. ``certainty``: how well they fix it, from 0 (parallel) to 2/3: about
    the mean squared sine between the axes. ``ahead``: the share of the cameras that have it before them.
    """

    point: NDArray[np.float64]
    certainty: float
    ahead: float

    @property
    def is_clear(self) -> bool:
        """Whether the axes meet, and not behind the cameras' backs."""
        return self.certainty >= _LEAST_CERTAINTY and self.ahead >= 0.5


def focus_point(cameras: Sequence[Camera]) -> Focus:
    """The point nearest to all optical axes in least squares (at least one camera).

    Each axis o + t d contributes |(I - d d^T)(x - o)|^2; certainty is the smallest eigenvalue of the mean of I - d d^T.
    """
    origins = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.forward for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = across.mean(axis=0)
    certainty = float(np.linalg.eigvalsh(matrix)[0])
    right = (across @ origins[:, :, None]).mean(axis=0)[:, 0]
    point = np.linalg.lstsq(matrix, right, rcond=None)[0]
    ahead = [(point - camera.position) @ camera.forward > 0 for camera in cameras]
    return Focus(point, certainty, float(np.mean(ahead)))
