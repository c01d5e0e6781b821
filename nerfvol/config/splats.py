"""Settings of Gaussian splats and their optimisation; what depends on the kind of scene is None until it is known."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, Literal

from nerfvol.config.values import filled
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds


@dataclasses.dataclass
class SplatConfig:
    """Rates hold at the start and shrink exponentially with progress; docs/performance.md has what each choice is worth."""

    steps: int = 8000
    """Optimiser steps when no time budget is given: one view each."""
    max_splats: int | None = None
    """Most Gaussians. None: from the time (or steps) there is, see splat_schedule."""
    sh_degree: int | None = None
    """Spherical harmonics of the colours: 0 to 3. None: 1 in photographs, 2 for objects."""
    mode: Literal["mip", "plain"] = "mip"
    """How what is smaller than a pixel is drawn: "mip" holds its light at every size, "plain" is for viewers that cannot."""
    rate_means: float = 0.2
    """Adam's rate of the means, in units of a Gaussian's own size."""
    rate_scales: float = 0.12
    """... of the logarithms of the scales,"""
    rate_quats: float = 0.02
    rate_logits: float = 0.08
    rate_dc: float = 0.03
    rate_sh: float = 0.005
    rate_decay: float | None = None
    """Rates shrink to this factor over the run. None: 0.2 in photographs, 0.15 for objects."""
    rate_decay_means: float | None = None
    """... those of the means to this. None: 0.1 and 0.06."""
    beta2: float = 0.98
    """Memory, per step, of Adam's second moments; short, for a run on a CPU has thousands of steps, not tens of thousands."""
    ssim: float | None = None
    """Weight of 1 - SSIM of 4x4 blocks beside the mean squared error. None: 0.03 in photographs, 0.02 for objects."""
    scale: float = 0.0
    """Weight of the mean of the scales over the subject's distance: fewer large flat Gaussians behind everything."""
    grow_every: int = 60
    """Steps between two rounds of splitting and pruning."""
    prune_opacity: float = 0.02
    """Gaussians below this opacity are removed at each round."""
    early_stop_eps: float = 3e-3
    """Pixels end where their transmittance falls below."""

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"splats.{name} must lie between {low:g} and {high:g}, got {value:g}")

    def for_scene(self, scene: SceneBounds) -> SplatConfig:
        """The same with a number for each None that the kind of scene decides."""
        return filled(self, PHOTOGRAPHS if scene.is_unbounded else OBJECTS)


RANGES = {
    "steps": (1, math.inf), "max_splats": (1, 1 << 26), "sh_degree": (0, 3), "rate_means": (0, 1e3), "rate_scales": (0, 1e3),
    "rate_quats": (0, 1e3), "rate_logits": (0, 1e3), "rate_dc": (0, 1e3), "rate_sh": (0, 1e3), "rate_decay": (1e-9, 1),
    "rate_decay_means": (1e-9, 1), "beta2": (0.5, 0.99999), "ssim": (0, 1e3), "scale": (0, 1e3), "grow_every": (1, math.inf),
    "prune_opacity": (0, 1), "early_stop_eps": (0, 0.999),
}  # fmt: skip
PHOTOGRAPHS: dict[str, Any] = {"sh_degree": 1, "rate_decay": 0.2, "rate_decay_means": 0.1, "ssim": 0.03}
OBJECTS: dict[str, Any] = {"sh_degree": 2, "rate_decay": 0.15, "rate_decay_means": 0.06, "ssim": 0.02}
"""Settings of splats where nothing else is said."""
