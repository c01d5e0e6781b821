"""Settings of Gaussian splats and their optimisation; what depends on the kind of scene is None until it is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from nerfvol.config.values import Checked, Count, Decay, Rate, Share, Weight, filled, within

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds


@dataclass
class SplatConfig(Checked):
    """Rates hold at the start and shrink exponentially with progress; docs/experiments.md has what each choice is worth."""

    section: ClassVar[str] = "splats"

    steps: Count = 8000
    """Optimiser steps when no time budget is given: one view each."""
    max_splats: Annotated[int, within(1, 1 << 26)] | None = None
    """Most Gaussians. None: from the time (or steps) there is, see splat_schedule."""
    sh_degree: Annotated[int, within(0, 3)] | None = None
    """Spherical harmonics of the colours: 0 to 3. None: 1 in photographs, 2 for objects, 1 for those that few views show
    (field.few_views)."""
    two_backgrounds: bool | None = None
    """Cut-out pictures are seen before the colour farthest from their background as well, in one step of four, so that what
    has the background's colour is not for nothing. None: yes, where an object's pictures are all cut out."""
    mode: Literal["mip", "plain"] = "mip"
    """How what is smaller than a pixel is drawn: "mip" holds its light at every size, "plain" is for viewers that cannot."""
    rate_means: Rate | None = None
    """Adam's rate of the means, in units of a Gaussian's own size. None: 0.2 in photographs, 0.25 for objects."""
    rate_scales: Rate | None = None
    """... of the logarithms of the scales (None: 0.12 and 0.16),"""
    rate_quats: Rate = 0.02
    """... of the rotations, as unit quaternions,"""
    rate_logits: Rate = 0.08
    """... of the opacities' logits,"""
    rate_dc: Rate = 0.03
    """... of the colours' constant coefficients,"""
    rate_sh: Rate = 0.005
    """... and of the others."""
    rate_decay: Decay | None = None
    """Rates shrink to this factor over the run. None: 0.2 in photographs, 0.15 for objects."""
    rate_decay_means: Decay | None = None
    """... those of the means to this. None: 0.1 and 0.06."""
    beta2: Annotated[float, within(0.5, 0.99999)] | None = None
    """Memory, per step, of Adam's second moments; short, for a run on a CPU has thousands of steps, not tens of thousands.
    None: 0.98 in photographs, 0.97 for objects."""
    ssim: Weight | None = None
    """Weight of 1 - SSIM of 4x4 blocks next to the mean squared error. None: 0.03 in photographs, 0.02 for objects."""
    scale: Weight = 0.0
    """Weight of the mean of the scales over the subject's distance: fewer large flat Gaussians behind everything."""
    most_ratio: Annotated[float, within(1.5, 1e6)] = 12.0
    """A Gaussian's longest scale over its second, at most: needles fit a photograph and spoil the views between."""
    grow_every: Count = 60
    """Steps between two rounds of splitting and pruning; short runs take fewer, see splat_schedule."""
    prune_opacity: Share = 0.02
    """Gaussians below this opacity are removed at each round."""
    early_stop_eps: Annotated[float, within(0, 0.999)] = 3e-3
    """Pixels end where their transmittance falls below."""

    def for_scene(self, scene: SceneBounds) -> SplatConfig:
        """The same with a number for each None that the kind of scene decides."""
        return filled(self, PHOTOGRAPHS if scene.is_unbounded else OBJECTS)


PHOTOGRAPHS: dict[str, Any] = {
    "sh_degree": 1, "rate_means": 0.2, "rate_scales": 0.12, "rate_decay": 0.2, "rate_decay_means": 0.1, "beta2": 0.98,
    "ssim": 0.03, "two_backgrounds": False,
}  # fmt: skip
OBJECTS: dict[str, Any] = {
    "sh_degree": 2, "rate_means": 0.25, "rate_scales": 0.16, "rate_decay": 0.15, "rate_decay_means": 0.06, "beta2": 0.97,
    "ssim": 0.02, "two_backgrounds": True,
}  # fmt: skip
"""Settings of splats where nothing else is said."""
FEW_VIEWS: dict[str, Any] = {"sh_degree": 1}
"""... and of an object that few views show (docs/experiments.md)."""
