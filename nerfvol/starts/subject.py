"""How far the subject is, and between which depths a scene lies: the lengths that starting points are measured by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.focus import focus_point
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.llff import POSES

NEAR, FAR = 0.3, 4.0
"""Of the subject's distance: between what depths points are looked for where no file says."""
_MEETING = 0.05  # certainty of the point that all axes meet in, below which it is no subject (datasets/bounds.py)


@dataclass(frozen=True)
class Subject:
    """``distance``: the median camera's to the subject; ``near``, ``far``: depths to look for points at; scene units."""

    distance: float
    near: float
    far: float


def subject_of(dataset: Dataset) -> Subject:
    """The subject of a dataset: the point nearest to all optical axes, or the middle of its bounds where they do not meet.

    LLFF files state depths themselves: the subject is then at their harmonic mean, the middle in inverse depth.
    """
    stated = _llff_depths(dataset)
    if stated is not None:
        near, far = stated
        return Subject(2 / (1 / near + 1 / far), near, far)
    distance = subject_distance(dataset.cameras, dataset.scene.center)
    return Subject(distance, NEAR * distance, FAR * distance)


def subject_distance(cameras: Sequence[Camera], otherwise: NDArray[np.float64]) -> float:
    """The median distance of the cameras to the point nearest to all their axes; ``otherwise`` (3,) where none is ahead."""
    positions = np.stack([camera.position for camera in cameras])
    focus = focus_point(cameras)
    point = otherwise if focus.certainty < _MEETING or focus.ahead < 0.5 else focus.point
    distance = float(np.median(np.linalg.norm(positions - point, axis=1)))
    return distance if distance > 1e-9 else 1.0


def _llff_depths(dataset: Dataset) -> tuple[float, float] | None:
    """The nearest and farthest depth that an LLFF file states, (near, far)."""
    source = Path(dataset.source)
    if source.name != POSES or not source.is_file():
        return None
    rows = np.load(source, allow_pickle=False)  # its reader has checked it
    unit = 1.0 if dataset.frame is None else dataset.frame.scale
    near, far = float(np.nanmin(rows[:, 15])) / unit, float(np.nanmax(rows[:, 16])) / unit
    return (near, far) if 0 < near < far else None
