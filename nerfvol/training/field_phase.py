"""What both trainers of a field share as phases of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nerfvol.errors import InputError
from nerfvol.field.layout import Domain
from nerfvol.kernels.state import StepReport

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds

NEAREST = 0.05
"""Sample to a camera among photographs, in units of half the inner cube's edge."""
FIELD_SHARE = 0.3
"""Of the time left in a run, the most that the field gets."""
SECONDS_TO_DISTILL = 5.0
"""What distilling at DISTILLED_LEVEL takes on two slow cores, of a field of an object; each level coarser a quarter of it."""
DISTILLED_LEVEL = 8
DISTILLING_SHARE = 0.4
"""Of the time that is left after a field, the most that distilling may take: a level is worth 0.15 dB before the octree is
trained, which finds it again."""
COARSEST_DISTILLED = 6
"""Below this, what is lost would not be found again in so short a time."""


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


def level_in_time(finest: int, left: float | None) -> int:
    """The level, at most ``finest``, that a field is distilled at with ``left`` seconds to go, None: no matter. A field of a
    second is haze, and takes more than what is reckoned with here rather than less."""
    level = finest
    while left is not None and level > COARSEST_DISTILLED:
        if SECONDS_TO_DISTILL * 4.0 ** (level - DISTILLED_LEVEL) <= DISTILLING_SHARE * left:
            break
        level -= 1
    return level


def domain_of(scene: SceneBounds) -> Domain:
    """The inner cube around the scene's bounds, and the background cube around it where there is one.

    Raises:
        InputError: the bounds are no box of positive, finite size.
    """
    aabb = np.asarray(scene.aabb, dtype=np.float64)
    center, half = aabb.mean(0), float((aabb[1] - aabb[0]).max() / 2)
    if not (math.isfinite(half) and half > 0):
        raise InputError(f"the scene bounds must be a box of positive size, got {aabb.tolist()}")
    outer = 1.0
    if scene.is_unbounded:
        outer = max(1.0, float(np.abs(np.asarray(scene.background_cube) - center).max() / half))
    return Domain(tuple(center.tolist()), half, outer)


def near_plane_of(domain: Domain) -> float:
    """How near to a camera a field is looked at, u: cameras stand in the scene where it has a background."""
    return NEAREST * domain.half if domain.outer > 1 else 0.0
