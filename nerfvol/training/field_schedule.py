"""What changes from step to step while the compiled kernels train a field: functions of the step's number, the progress and the
settings alone. What each row is worth: docs/experiments.md."""

from __future__ import annotations

from nerfvol.config.field import FieldConfig
from nerfvol.kernels.field_ops import FieldLoss, FieldRates

LONGER = ((32, 6.0), (128, 3.0), (700, 2.0), (2500, 1.5))
"""Until so many steps are done, steps along rays are so many times longer: all cells are occupied at first, and while the field
is blurred more rays teach it more than finer steps."""
COARSE_LEVELS = ((32, 4), (128, 6))
"""Until so many steps are done, only so many levels of the grid are in use: haze of all space would move all entries of finer
ones, and nothing is known that fine."""
NEGLIGIBLE = 0.25
"""Samples whose gradient is below this share of the mean one play Russian roulette: half of the samples have a fiftieth of the
gradient, and the backward pass is half of a step."""
SLOW_LEVELS, SLOW_EVERY = 3, 2
"""Levels of the grid from this one on are moved at every second step, by the gradient of both: half the work of Adam."""
NETWORK_DECAY = 1e-6
EPS = 1e-6
"""Of Adam: entries that only samples of no weight were in hardly move, which 1e-15 would send a full step at random."""
WARM_UP = 20
"""Steps over which the rate rises."""


def march_steps(config: FieldConfig, stage: int, step: int) -> int:
    """Steps along the diagonal of the inner cube."""
    longer = next((factor for until, factor in LONGER if step < until), 1.0)
    return max(8, int(config.march_steps[stage] / longer))


def levels_in_use(n_levels: int, step: int) -> int:
    """Of the grid's ``n_levels``, the coarsest so many."""
    return min(n_levels, next((n for until, n in COARSE_LEVELS if step < until), n_levels))


def moves(n_levels: int, step: int) -> list[bool]:
    """For each level of the grid whether Adam moves it in this step."""
    return [level < SLOW_LEVELS or step % SLOW_EVERY == 1 for level in range(n_levels)]


def loss_at(config: FieldConfig, few: bool, background: tuple[float, float, float], progress: float) -> FieldLoss:
    """The loss's terms; ``few``: there are few training views."""
    fading = 0.1**progress
    entropy = config.few_entropy if few else config.entropy_weight
    colour, distortion = fading * config.colour_weight, fading * config.distortion_weight
    return FieldLoss(background, colour, distortion, entropy, negligible=NEGLIGIBLE)


def rates_at(config: FieldConfig, few: bool, step: int, progress: float) -> FieldRates:
    """Adam's rates: constant to a third of the run, then falling."""
    warm = min(1.0, (step + 1) / WARM_UP)
    decay = config.rate_decay ** max(0.0, (progress - 1 / 3) * 1.5)
    table_decay = config.few_decay if few else config.table_decay
    return FieldRates(config.rate * warm * decay, eps=EPS, table_decay=table_decay, network_decay=NETWORK_DECAY)
