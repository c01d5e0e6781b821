"""The points that structure from motion found with the cameras: where splats may begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """Points of a model, in the scene's units and axes.

    ``positions`` (n, 3) float64, finite. ``colours`` (n, 3) uint8, sRGB as in the photographs. ``track_lengths`` (n,)
    int64: in how many images a point was found. ``errors`` (n,) float64: its mean reprojection error in pixels, as the
    file states it (COLMAP writes -1 where it worked out none). ``source``: the file.
    """

    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    track_lengths: NDArray[np.int64]
    errors: NDArray[np.float64]
    source: str

    def __len__(self) -> int:
        return len(self.positions)
