"""Which stages an octree's run has the steps for, at the pace that was measured so far.

Shares of progress alone decide nothing on a slow machine: pictures must have been seen before a pruning, and that takes steps
which a short run does not have. Where they do not suffice the coarse stages have fewer prunings, then fewer stages, so that the
full pictures are reached with most of the run ahead; where they do, the schedule is the one that was set. What is decided
depends on nothing but steps, progress and settings, all of which a checkpoint holds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from nerfvol.config.octree import OctreeConfig
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds

COVERAGE = 0.5
"""Share of the foreground tiles that were seen before leaves are pruned, ..."""
ENOUGH_TILES, ENOUGH_TILES_OF_PHOTOGRAPHS = 20_000, 80_000
"""... and so many at most: around photographs much is seen at the rim of a few of them only, which takes more tiles to meet."""
FINE_LEVEL = 9
"""From this level on a stage splits leaves once, and ..."""
FINE_STEPS, FINER_STEPS = 800, 2500
"""... is left out where fewer steps would be left for it: the first number at that level, the second at those beyond."""
PRUNE_SHARE, FEWEST_PRUNE_STEPS = 0.05, 10
"""Of the steps that a run will make, what comes before a pruning at most, and the fewest: a run that has no time for
``prune_steps`` in each stage had better be rough in all of them than stay in the first."""
FULL_BY = 0.35
"""Share of a run by whose end the full pictures are reached: in the schedule as set, where they begin at 0.1, the first of
their stages ends there."""


@dataclass(frozen=True)
class Stages:
    """Those of a run, in order from ``kept[0]``, the one it begins in. prunes: of each stage of the settings. wait: steps
    that a pruning waits at most for tiles to be seen."""

    kept: tuple[int, ...]
    prunes: tuple[int, ...]
    wait: float

    def after(self, stage: int) -> int | None:
        """The next one; None: ``stage`` is the last."""
        return next((other for other in self.kept if other > stage), None)


def prune_steps(config: OctreeConfig, steps: float) -> float:
    """Steps before a pruning of a run of ``steps``: those set, fewer where it is short."""
    return min(config.prune_steps, max(FEWEST_PRUNE_STEPS, PRUNE_SHARE * steps))


def enough_tiles(foreground: float, is_unbounded: bool) -> float:
    """How many tiles tell what no ray needs, of ``foreground`` foreground tiles."""
    return min(COVERAGE * foreground, ENOUGH_TILES_OF_PHOTOGRAPHS if is_unbounded else ENOUGH_TILES)


def stages_for(
    config: OctreeConfig, first: int, steps: float, foreground: Sequence[float], is_unbounded: bool
) -> Stages:
    """The stages of a run of ``steps`` steps that begins in stage ``first``.

    The schedule as set where it reaches the full pictures by FULL_BY; else the first of these that does: one pruning in each
    stage before them; waiting for it no longer than there is time; that in every other stage; in the first alone.
    Of photographs it stays as set: what is between the cameras is haze until it was pruned often enough, each step through haze
    takes several times as long, and a pace so slow would have called for fewer prunings yet.

    Args:
        config: the settings, a stage an entry.
        first: the stage that the run begins in.
        steps: of the whole run at the pace so far; infinity before there is a pace.
        foreground: foreground tiles of each stage's pictures.
        is_unbounded: whether the scene is one of photographs.
    """
    full = max(first, config.downscales.index(min(config.downscales)))
    before, after = list(range(first, full)), tuple(range(full, len(config.levels)))
    as_set = Stages((*before, *after), tuple(config.prunes), math.inf)
    if is_unbounded:
        return as_set
    once = tuple(min(n, 1) if stage < full else n for stage, n in enumerate(config.prunes))
    shortest = prune_steps(config, steps)
    waits = [max(shortest, enough_tiles(n, is_unbounded) / batch)
             for n, batch in zip(foreground, config.tiles, strict=True)]  # fmt: skip
    for prunes in (config.prunes, once):
        if sum((prunes[stage] + 1) * waits[stage] for stage in before) <= FULL_BY * steps:
            return replace(as_set, prunes=tuple(prunes))
    stages = as_set
    for kept in (before, before[::2], before[:1]):
        wait = FULL_BY * steps / sum(once[stage] + 1 for stage in kept)
        stages = Stages((*kept, *after), once, max(wait, FEWEST_PRUNE_STEPS))
        if wait >= FEWEST_PRUNE_STEPS:
            break
    return stages


def is_worth_it(config: OctreeConfig, stage: int, steps: float, progress: float) -> bool:
    """Whether ``stage`` would have the steps that it needs, a coarse one for its prunings, in a run of ``steps``."""
    left = steps * (1 - progress)
    level = config.levels[stage]
    if level < FINE_LEVEL:
        return left >= config.prunes[stage] * prune_steps(config, steps)
    return left >= (FINE_STEPS if level == FINE_LEVEL else FINER_STEPS)


def first_stage(config: OctreeConfig, octree: Octree, scene: SceneBounds) -> int:
    """The first stage whose finest level is the octree's, or the last one."""
    finest = octree.max_level - scene.n_shells
    reached = [i for i, level in enumerate(config.levels) if level >= finest]
    return reached[0] if reached else len(config.levels) - 1
