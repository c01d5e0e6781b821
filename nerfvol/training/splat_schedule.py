"""How many Gaussians, at which size of the photographs and when: what the seconds of a run can pay for.

Measured on two cores (docs/experiments.md): small sizes first, for a step at an eighth of the size costs a twentieth and
teaches the same; growth early, for a Gaussian must still be optimised; and no more of them than the seconds can optimise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

SECONDS_PER_STEP = 1 / 80
"""Of a run without a time budget: what its steps would take on two cores, for the tables below."""
COARSEST_SIDE = 100
"""Pixels along the longer side, at least, of the smallest photographs trained on."""
PIXELS_PER_SPLAT = 8
"""Of all training images together: more Gaussians than that have nothing to learn from."""

_SECONDS = (3.0, 5.0, 8.0, 15.0, 30.0, 60.0, 120.0, 270.0, 600.0, 1800.0)
_ENDS = {  # share of progress at which 1/8, 1/4 and 1/2 of the size end
    8: (0.10, 0.10, 0.10, 0.08, 0.06, 0.04, 0.02, 0.015, 0.008, 0.004),
    4: (0.40, 0.40, 0.40, 0.35, 0.25, 0.20, 0.12, 0.07, 0.04, 0.02),
    2: (0.85, 0.85, 0.85, 0.80, 0.70, 0.60, 0.45, 0.33, 0.25, 0.20),
}
_STEPS = {True: {8: 600, 4: 2000, 2: 4000}, False: {8: 300, 4: 500, 2: 1500}}  # of photographs and objects, in 30 s
_GROWN = {
    True: (0.40, 0.40, 0.40, 0.40, 0.35, 0.30, 0.25, 0.20, 0.20, 0.15),
    False: (0.60, 0.60, 0.60, 0.60, 0.45, 0.30, 0.25, 0.20, 0.20, 0.15),
}
_MOST = {
    True: (25e3, 25e3, 25e3, 35e3, 50e3, 80e3, 130e3, 180e3, 220e3, 300e3),
    False: (14e3, 20e3, 28e3, 48e3, 75e3, 105e3, 155e3, 172e3, 200e3, 250e3),
}


@dataclass(frozen=True)
class Schedule:
    """factors: of the photographs' reduction, one a stage, the last 1. ends: progress at which each stage ends. most: Gaussians
    at the end of growth, which lasts from ``GROWTH_STARTS`` to ``grown``. steps: at which each stage but the last ends before
    that; none: no bound."""

    factors: tuple[int, ...]
    ends: tuple[float, ...]
    most: int
    grown: float
    steps: tuple[int, ...] = ()

    def is_over(self, stage: int, progress: float, steps: int) -> bool:
        """Whether ``stage`` ends at ``progress`` in [0, 1], after ``steps`` steps in it; the last one never does."""
        if stage + 1 >= len(self.factors):
            return False
        return progress >= self.ends[stage] or bool(self.steps) and steps >= self.steps[stage]

    def of_surfaces(self) -> Schedule:
        """The same without sizes below a half, which surfaces that splats begin with are finer than."""
        return replace(self, factors=self.factors[-2:], ends=self.ends[-2:], steps=self.steps[-1:])

    def grow_every(self, most: int) -> int:
        """Steps between two rounds of growth, at most ``most``: a short run has few steps before its last size, in which what
        is new must still be optimised, and then one large round is worth less than several small ones."""
        if not self.steps:
            return most
        return min(most, max(FEWEST_BETWEEN_ROUNDS, sum(self.steps) // ROUNDS))

    def planned(self, start: int, progress: float) -> int:
        """Gaussians that there should be at ``progress`` where ``start`` were there first: exponential growth."""
        share = min(1.0, max(0.0, (progress - GROWTH_STARTS) / (self.grown - GROWTH_STARTS)))
        return int(start * (max(self.most, start) / start) ** share)


GROWTH_STARTS = 0.03
"""Share of progress."""
ROUNDS = 20
"""Of growth and pruning, at least, before the last size; but each round moves all splats in memory, and needs ..."""
FEWEST_BETWEEN_ROUNDS = 30
"""... that many steps to pay."""


def make_schedule(
    seconds: float, sizes: Sequence[tuple[int, int]], photographs: bool, most: int | None = None
) -> Schedule:
    """The schedule of ``seconds`` of training on views of ``sizes`` (width, height).

    most: Gaussians at the end; None: as many as the seconds can optimise.
    """
    longest = max(max(size) for size in sizes)
    coarsest = 1
    while longest / (2 * coarsest) >= COARSEST_SIDE and coarsest < 64:
        coarsest *= 2
    factors = tuple(2**k for k in range(int(math.log2(coarsest)), -1, -1))
    ends, steps = [], []
    for factor in factors[:-1]:
        # On small pictures a fast machine makes thousands of steps in a share of the time that teach nothing new.
        steps.append(int(_STEPS[photographs][min(factor, 8)] * (seconds / 30) ** 0.7))
        end = _at(_ENDS[min(factor, 8)], seconds)
        ends.append(end * (8 / factor) ** 2 if factor > 8 else end)
    pixels = sum(width * height for width, height in sizes)
    affordable = int(_at(_MOST[photographs], seconds))
    wanted = most if most is not None else min(affordable, max(1000, pixels // PIXELS_PER_SPLAT))
    return Schedule(factors, (*ends, 1.0), wanted, _at(_GROWN[photographs], seconds), tuple(steps))


def saved_schedule(state: Mapping[str, Any]) -> Schedule:
    """The schedule in a trainer's state; LookupError, TypeError or ValueError where there is none."""
    factors, ends = tuple(int(f) for f in state["factors"]), tuple(float(e) for e in state["ends"])
    steps = tuple(int(n) for n in state["steps_of_stages"])
    schedule = Schedule(factors, ends, int(state["most"]), float(state["grown"]), steps)
    halved = tuple(2**k for k in range(len(factors) - 1, -1, -1))
    in_order = all(0 <= a <= b <= 1 for a, b in zip((0.0, *ends), ends, strict=False))
    if not 1 <= len(factors) == len(ends) <= 7 or factors != halved or not in_order or ends[-1] != 1:
        raise ValueError(f"sizes {factors} until {ends} are no schedule")
    if steps and (len(steps) != len(factors) - 1 or min(steps) < 0):
        raise ValueError(f"stages of {steps} steps are no schedule")
    if schedule.most < 1 or not schedule.grown > GROWTH_STARTS:
        raise ValueError(f"growth to {schedule.most} until {schedule.grown} is no schedule")
    return schedule


def _at(values: Sequence[float], seconds: float) -> float:
    """Interpolated over the logarithm of the seconds; constant beyond the table."""
    x = math.log(min(max(seconds, _SECONDS[0]), _SECONDS[-1]))
    at = [math.log(s) for s in _SECONDS]
    k = max(i for i in range(len(at) - 1) if at[i] <= x)
    share = (x - at[k]) / (at[k + 1] - at[k])
    return values[k] + share * (values[k + 1] - values[k])
