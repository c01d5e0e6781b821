"""Settings of a medium that is fitted under known light (``nerfvol train --light``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from nerfvol.config.values import (
    Checked,
    Count,
    Decay,
    Rate,
    Share,
    Weight,
    above,
    increasing_to_one,
    same_length,
    within,
)


@dataclass
class MediumConfig(Checked):
    """Vertices, steps and rates; docs/experiments.md has what each choice is worth."""

    section: ClassVar[str] = "medium"

    steps: Count = 400
    """Optimiser steps when no time budget is given."""
    resolutions: tuple[Annotated[int, within(4, 512)], ...] = (16, 32, 64)
    """Vertices along the longest side of the region, one a stage."""
    stage_ends: tuple[Share, ...] = (0.15, 0.4, 1.0)
    """Share of progress at which each stage ends."""
    rays: Count = 4096
    """Of a step."""
    lights: Count = 2
    """That share the rays of a step: each needs a deep shadow map of its own."""
    step_voxels: Annotated[float, above(0, 8)] = 1.0
    """Length of the steps along rays, in distances of vertices."""
    first_depth: Annotated[float, above(0, 100)] = 0.5
    """Optical depth of the longest side at the start: low density everywhere."""
    first_albedo: Annotated[float, within(0.01, 0.99)] = 0.7
    """Albedo everywhere at the start."""
    rate: Rate = 0.15
    """Adam's rate of densities and albedos, before their softplus and sigmoid."""
    rate_decay: Decay = 0.1
    """Rates shrink exponentially to this factor over the run."""
    smooth_albedo: Weight = 1e-3
    """Weight of squared differences of neighbours' albedos: what no light reaches takes on what its neighbours have."""
    smooth_density: Weight = 0.0
    """... of optical depths of a vertex's distance."""

    def check(self) -> None:
        same_length(self, "resolutions", "stage_ends")
        increasing_to_one(self, "stage_ends")

    def stage_at(self, progress: float) -> int:
        """The stage at ``progress`` in [0, 1]."""
        return next((k for k, end in enumerate(self.stage_ends) if progress < end), len(self.stage_ends) - 1)
