"""The losses and learning rates of an octree's step at a moment of its schedule, and the colour behind photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerfvol.config.octree import OctreeConfig, SceneChoices
from nerfvol.kernels import ops

BACKGROUND_STREAM = 2
"""Stream of random numbers of the random background of photographs; TileBank has 0 and 1."""
BETA = 0.95
"""Memory, per step, of RMSprop's second moments: a vertex moves some fifty times in a minute, and 0.98 remembers as many
(docs/experiments.md: +0.1 to 0.4 dB at equal steps)."""


def losses_at(
    progress: float, config: OctreeConfig, chosen: SceneChoices, background: Sequence[float], smooth: bool
) -> ops.LossOptions:
    """Regularisers that fade over the run, ``progress`` in [0, 1], and one that rises until the rates fall; ``smooth``: with
    total variation."""
    fade = config.regulariser_decay**progress
    return ops.LossOptions(
        background=tuple(background),
        colour=config.colour_weight * fade,
        distortion=config.distortion * fade,
        sparsity=chosen.sparsity * min(1.0, progress / max(chosen.decay_from, 1e-9)),
        tv_density=chosen.tv_density * fade * smooth,
        tv_sh=chosen.tv_sh * fade * smooth,
        early_stop_eps=config.early_stop_eps,
    )


def rates_at(progress: float, config: OctreeConfig, chosen: SceneChoices) -> ops.Rates:
    """Those that were set until ``decay_from`` of the run, then falling."""
    late = max(0.0, progress - chosen.decay_from) / (1 - chosen.decay_from)
    rate = chosen.rate_decay**late
    return ops.Rates(density=config.rate_density * rate, dc=config.rate_dc * rate, sh=config.rate_sh * rate, beta=BETA)


def random_background(seed: int, step: int) -> tuple[float, ...]:
    """A colour, of its own each step."""
    random = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, BACKGROUND_STREAM, step])))
    return tuple(random.random(3).tolist())
