"""Settings of an octree's optimisation; what depends on the kind of scene is None until it is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from nerfvol.config.values import (
    Checked,
    Count,
    Decay,
    Rate,
    Share,
    Weight,
    at_least,
    filled,
    increasing_to_one,
    same_length,
    within,
)

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds

SMALLEST_PICTURE = 24
"""Pixels along the shorter side, below which no stage averages pictures by itself."""
FINEST_LEVEL = 16
"""Of a stage's leaves, where the numbers of octree.topology end."""
Degree = Annotated[int, within(0, 3)]
Level = Annotated[int, within(1, FINEST_LEVEL)]
Downscale = Annotated[int, within(1, 256)]


@dataclass
class OctreeConfig(Checked):
    """Settings of the octree's optimisation. Shares of progress lie in [0, 1]; levels count along the inner cube."""

    section: ClassVar[str] = "octree"
    former: ClassVar[Mapping[str, str]] = {
        "until": "stage_ends",
        "rich_share": "foreground_share",
        "colour": "colour_weight",
        "smooth_density": "tv_density",
        "smooth_colour": "tv_sh",
        "smooth_from": "tv_from",
        "coverage": "pruning always waits until half of the foreground tiles were seen",
        "beta": "it is always 0.95",
        "final_prune_weights": "they are always 0.04, 0.02 and 0.01, and final_prune_loss chooses among them",
        "fine_from": "stages from level 9 on split leaves once",
        "fine_steps": "a stage from level 9 on is always left out where fewer than 2500 steps would be left for it",
    }

    steps: Count = 15000
    """Optimiser steps of the whole schedule when no time budget is given."""
    most_epochs: Annotated[float, at_least(0.1)] = 60.0
    """... and when one is given, as many as draw each tile so often at most: a run that comes to them ends early, for more
    would overfit (docs/experiments.md)."""
    levels: list[Level] = dataclasses.field(default_factory=lambda: [5, 6, 7, 8, 8, 9, 10])
    """Finest level of each stage: level 8 means 256 cells along the inner cube."""
    downscales: list[Downscale] = dataclasses.field(default_factory=lambda: [16, 8, 4, 2, 1, 1, 1])
    """Images are area-averaged by these factors, one a stage."""
    stage_ends: list[Share] = dataclasses.field(default_factory=lambda: [0.003, 0.008, 0.03, 0.10, 0.35, 0.60, 1.0])
    """Share of progress at which each stage ends."""
    tiles: list[Annotated[int, within(1, 1 << 20)]] = dataclasses.field(
        default_factory=lambda: [64, 96, 128, 128, 192, 320, 320]
    )
    """8x8 tiles in a batch, per stage: about equal work a step, so that shares of steps are shares of time."""
    prunes: list[Annotated[int, at_least(0)]] = dataclasses.field(default_factory=lambda: [3, 3, 2, 2, 2, 2, 2])
    """Prunings inside each stage, evenly spaced."""
    prune_steps: Annotated[int, at_least(0)] = 20
    """Steps before each pruning, at least: a low-density start needs some to become visible at all, however few the
    pictures."""
    sh_degree: Degree | None = None
    """Spherical harmonics of the colours: 0 to 3. None: 1, and 2 in photographs, whose surfaces shine."""
    final_sh_degree: Degree = 1
    """... in the last stage, where it is more: for shiny scenes. It costs memory and steps (docs/experiments.md)."""
    foreground_share: Share = 0.8
    """Share of a batch drawn from foreground tiles: those that show more than the background."""
    colour_weight: Weight = 0.06
    """Weight of the per-sample colour term at the start."""
    distortion: Weight = 0.05
    """Weight of the distortion term at the start."""
    sparsity: Weight | None = None
    """Weight of the logarithms of the segments' weights, reached where the rates begin to fall: haze on a ray costs as much as
    a surface, so that what is left are surfaces, and rays with fewer segments. None: 0, and 1.2e-3 in photographs."""
    tv_density: Weight | None = None
    """Weight of differences of raw density between the corners of leaves (reference.roughness). None: 6e-5, and 2e-5 in
    photographs."""
    tv_sh: Weight | None = None
    """... and of their colours' coefficients. None: 6e-5, and 4e-5 in photographs."""
    tv_from: Annotated[int, at_least(0)] | None = None
    """The step from which on both count. None: 1000, for at first objects have nothing that could overfit; 0 in photographs."""
    two_backgrounds: bool | None = None
    """Cut-out pictures are seen before their background and the colour farthest from it in turn, so that what has the
    background's colour is not for nothing. None: where few views show an object (field.few_views), by which alone a field has
    both."""
    regulariser_decay: Decay = 0.1
    """The weights of all four terms shrink exponentially to this factor over the run."""
    rate_density: Rate = 0.3
    """RMSprop's rate of the raw density at the start, a step,"""
    rate_dc: Rate = 0.07
    """... of the colours' constant coefficients,"""
    rate_sh: Rate = 0.006
    """... and of the others."""
    rate_decay: Decay | None = None
    """Rates shrink exponentially to this factor at the end. None: 0.04, and 0.02 in photographs."""
    decay_from: Annotated[float, within(0, 0.999)] | None = None
    """... from this share of progress on. None: 0.8, and 0.35 in photographs, whose noise takes longer to average."""
    prune_weight: Weight = 0.005
    """Leaves whose largest rendering weight since the last pruning is below are removed."""
    final_prune_loss: Weight = 0.005
    """Share by which the squared error of training tiles may grow at the last pruning (0.005 is 0.02 dB); what it takes from
    the octree is speed and bytes that nobody sees, in thin shells about a tenth, in thick media nothing."""
    whole_pixels: Weight = 2.5
    """A stage begins by splitting leaves larger than this many pixels of its images in some view, down to its level, ..."""
    coarse_error: Share | None = None
    """... that are among the fewest to hold this share of the squared error. None: 0.9, and 0.5 in photographs, where much
    of what rays cross is haze that will be pruned."""
    subdivide_pixels: Weight = 1.5
    """A stage from level 9 on splits leaves once: those larger than this many pixels ..."""
    subdivide_error: Share = 0.7
    """... that are among the fewest to hold this share of the squared error."""
    growing_error: Share | None = None
    """Each pruning inside a stage splits leaves too, once, by this share of the squared error. None: 0 (none), and 0.5 in
    photographs."""
    early_stop_eps: Annotated[float, within(0, 0.999)] = 4e-3
    """Training rays end when their transmittance falls below."""

    def check(self) -> None:
        same_length(self, "levels", "downscales", "stage_ends", "tiles", "prunes")
        increasing_to_one(self, "stage_ends")

    def for_scene(self, scene: SceneBounds) -> OctreeConfig:
        """The same with a number for each None; photographs are scenes with background shells."""
        return filled(self, BOUNDED if not scene.is_unbounded else PHOTOGRAPHS)

    def from_surfaces(self, scene: SceneBounds) -> OctreeConfig:
        """The same for an octree that begins with the surfaces of splats, where nothing else is said."""
        return filled(self, PHOTOGRAPHS_FROM_SURFACES if scene.is_unbounded else {})

    def for_pictures(self, side: int) -> OctreeConfig:
        """The same with stages that suit pictures of ``side`` pixels along their shorter side.

        Where nobody chose the stages, none averages pictures below SMALLEST_PICTURE: the rays of a tile of 4x4-pixel pictures
        cover the whole field of view, which makes a step ten times as long and teaches nothing. Nor are leaves asked for that
        are smaller than half a pixel, and of stages that become alike the last is left, with one pruning each before it. Larger
        pictures than the stages were made for have stages of finer leaves after them, in a half of what the last one had, each.
        """
        plain = OctreeConfig()
        names = ("levels", "downscales", "stage_ends", "tiles", "prunes")
        most = max(1, side // SMALLEST_PICTURE)
        if any(getattr(self, name) != getattr(plain, name) for name in names):
            return self
        if most >= max(self.downscales):
            return self._with_levels_to(min(finest_level(side), FINEST_LEVEL))
        factor, level = 1 << (most.bit_length() - 1), max(self.levels[0], finest_level(side))
        rows = [(min(row[0], level), min(row[1], factor), *row[2:])
                for row in zip(*(getattr(self, name) for name in names), strict=True)]  # fmt: skip
        kept = [
            row for row, after in zip(rows, [*rows[1:], None], strict=True) if after is None or row[:2] != after[:2]
        ]
        columns = {name: [row[i] for row in kept] for i, name in enumerate(names)}
        columns["prunes"] = [min(n, 1) for n in columns["prunes"][:-1]] + columns["prunes"][-1:]
        return dataclasses.replace(self, **columns)

    def no_finer_than(self, level: int) -> OctreeConfig:
        """The same with stages that split no leaf beyond ``level``."""
        return dataclasses.replace(self, levels=[min(each, level) for each in self.levels])

    def _with_levels_to(self, finest: int) -> OctreeConfig:
        """The same with one more stage for each level after the last one's, to ``finest``."""
        levels, ends = [*self.levels], [*self.stage_ends]
        for level in range(levels[-1] + 1, finest + 1):
            levels.append(level)
            ends[-1:] = [(([0.0, *ends])[-2] + 1) / 2, 1.0]
        more = len(levels) - len(self.levels)
        again = {
            name: [*getattr(self, name), *getattr(self, name)[-1:] * more] for name in ("downscales", "tiles", "prunes")
        }
        return dataclasses.replace(self, levels=levels, stage_ends=ends, **again) if more else self


def finest_level(side: int) -> int:
    """Of leaves that pictures of ``side`` pixels along their shorter side can show: no smaller than half a pixel."""
    return (2 * side).bit_length() - 1


BOUNDED = {"sh_degree": 1, "rate_decay": 0.04, "decay_from": 0.8, "coarse_error": 0.9, "growing_error": 0.0,
           "sparsity": 0.0, "tv_density": 6e-5, "tv_sh": 6e-5, "tv_from": 1000, "two_backgrounds": False}  # fmt: skip
PHOTOGRAPHS = {"sh_degree": 2, "rate_decay": 0.02, "decay_from": 0.35, "coarse_error": 0.5, "growing_error": 0.5,
               "sparsity": 1.2e-3, "tv_density": 2e-5, "tv_sh": 4e-5, "tv_from": 0, "two_backgrounds": False}  # fmt: skip
"""Settings of an octree where nothing else is said."""
PHOTOGRAPHS_FROM_SURFACES = {"sparsity": 3e-4, "decay_from": 0.6}
"""... of photographs where it begins with surfaces, so that little haze is to be forbidden, and rates need not fall early
(docs/experiments.md)."""
FEW_VIEWS = {"tv_density": 3e-4, "tv_sh": 3e-4, "tv_from": 0, "two_backgrounds": True}
"""... and of an object that few views show, which begins as a field (docs/experiments.md)."""


@dataclass(frozen=True)
class SceneChoices:
    """The settings of an octree that the kind of scene decides, as numbers: in OctreeConfig each may be None."""

    sh_degree: int
    rate_decay: float
    decay_from: float
    coarse_error: float
    growing_error: float
    sparsity: float
    tv_density: float
    tv_sh: float
    tv_from: int
    two_backgrounds: bool

    @classmethod
    def of(cls, config: OctreeConfig, scene: SceneBounds) -> SceneChoices:
        """Those of ``config`` for ``scene``."""
        settings = config.for_scene(scene)
        return cls(**{field.name: getattr(settings, field.name) for field in dataclasses.fields(cls)})
