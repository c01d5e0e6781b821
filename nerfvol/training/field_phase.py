"""What both trainers of a field share as phases of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from nerfvol.kernels.state import StepReport

FIELD_SHARE = 0.3
"""Of the time left in a run, the most that the field gets."""
SECONDS_TO_DISTILL = 2.0
"""Kept for the end of a run while a field is trained: what an octree takes to be written."""


@dataclass(frozen=True)
class FieldReport(StepReport):
    """squared_error: of the batch; samples: a ray; loss: with the regularisers; downscale: of the images in the batch."""

    loss: float
    n_rays: int
    downscale: int

    @property
    def psnr(self) -> float:
        """Of the batch, dB."""
        return -10 * math.log10(max(self.squared_error, 1e-12))
