"""Optimising the octree: stages from coarse to fine, pruning, subdivision where it pays.

The recipe (docs/experiments.md has what each choice is worth): images from small to full size, an octree that starts
nearly transparent and uniform, loses what no ray needs and splits what rays see at more than a pixel and holds most of
the error; per-sample colour and distortion terms that empty space, total variation that fades; RMSprop on touched vertices.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.config.octree import OctreeConfig, SceneChoices, finest_level
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.store import Corrected
from nerfvol.datasets.tiles import Cursors, TileBank
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.machine import return_free_memory
from nerfvol.measure.leaf_width import visible_widths
from nerfvol.octree.topology import MAX_LEVEL, Transfer
from nerfvol.octree.tree import Octree
from nerfvol.starts.fog import low_density_octree
from nerfvol.starts.visible import ENOUGH_VIEWS, solid
from nerfvol.training.appearance import Appearance, small_picture
from nerfvol.training.backgrounds import is_second, second_background
from nerfvol.training.growing_octree import GrowingOctree
from nerfvol.training.memory import OctreePlan
from nerfvol.training.octree_end import FINAL_PRUNE_WEIGHTS, FINAL_TILES, outcome, pruned_at_the_end, seconds_to_write
from nerfvol.training.octree_schedule import (
    FINE_LEVEL,
    Stages,
    enough_tiles,
    first_stage,
    is_worth_it,
    prune_steps,
    stages_for,
)
from nerfvol.training.octree_step import losses_at, random_background, rates_at
from nerfvol.views import OctreeModel, render_image

FEWEST_STEPS = 5000
"""Before a run with a time budget may end early, however few its tiles."""
WORTH_PRUNING = 0.05
"""Share of the leaves below which a pruning inside a stage is left out: two octrees are in memory while one is made."""
DRAWN_SHARE = 0.3
"""Of a step's time: drawing its tiles."""
MOST_LEVELS_AT_ONCE = 2
"""Where stages are left out: more would split haze that was never pruned."""


class OctreeTrainer(GrowingOctree):
    """Optimises an octree on a dataset, from a given one or one of low density; a phase (training.phase.Phase).

    ``progress`` runs from 0 to 1 and drives every schedule. ``plan``: how large the octree may become; None: no bound.
    """

    name = "octree"
    rates = "octree.rate_density, octree.rate_dc and octree.rate_sh"
    previews = (0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
    preview_width = 200
    timed_at = 1

    def __init__(
        self,
        dataset: Dataset,
        background: Sequence[float],
        config: OctreeConfig,
        seed: int = 0,
        octree: Octree | None = None,
        plan: OctreePlan | None = None,
        appearance: Appearance | None = None,
    ):
        config, self.chosen = config.for_scene(dataset.scene), SceneChoices.of(config, dataset.scene)
        self.dataset, self.background, self.config, self.seed = dataset, tuple(background), config, seed
        self.second = second_background(dataset, background, self.chosen.two_backgrounds)
        self.appearance = appearance or Appearance(len(dataset), "off")
        start = low_density_octree(dataset, config.levels[0], self.chosen.sh_degree) if octree is None else octree
        super().__init__(start, plan.max_leaves if plan else None)
        # A given octree enters at the stage whose finest level it has, where full progress of that stage is still ahead.
        self.stage = 0 if octree is None else first_stage(config, octree, dataset.scene)
        self.first_stage = self.stage
        if octree is not None and self.stage + 1 == len(config.levels):
            self._grow_sh_at_last()
        self.keeps_solid = octree is not None and len(dataset) < ENOUGH_VIEWS
        self.steps_done, self._progress = 0, 0.0
        self.stage_steps = np.zeros(len(config.levels), np.int64)
        self.cursors = Cursors()
        self.prunings = 0
        self.seconds_a_leaf, self.seconds_a_tile = 0.0, 0.0  # of the last pruning and step: only seconds_to_write asks
        self.bank: TileBank | None = None
        self.plan = plan
        self.steps = config.steps
        drawn = config.tiles[-1] * (config.foreground_share or 1.0)
        self.most_steps = max(FEWEST_STEPS, config.most_epochs * plan.foreground_tiles / drawn) if plan else math.inf

    # ------------------------------------------------------------------ what a run asks of a phase
    @property
    def stages_left(self) -> int:
        """See Phase; without those whose leaves are smaller than the pictures can show."""
        lens = [camera.intrinsics for camera in self.dataset.cameras]
        finest = finest_level(max(min(each.width, each.height) for each in lens))
        c, stage = self.config, self.stage
        after = zip(c.levels[stage + 1 :], c.downscales[stage + 1 :], strict=True)
        return sum(level <= finest or downscale < c.downscales[stage] for level, downscale in after)

    def share_of(self, seconds: float) -> float:
        """All of the time left: nothing comes after the octree."""
        return seconds

    def picture(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) as the camera sees the leaves: prefiltered nodes would be made again for each picture."""
        return render_image(self.octree, camera, self.background, outputs=("rgb",), lod=0.0)["rgb"]

    def size(self) -> str:
        """See Phase."""
        return f"{self.octree.n_leaves:,} leaves"

    def seconds_to_write(self) -> float:
        """See Phase: the last pruning, as long as the run's own took a leaf, its judgement, as long as steps take a tile, and
        what the octree takes that it leaves."""
        tries = len(FINAL_PRUNE_WEIGHTS)
        judging = (tries + 1) * FINAL_TILES * DRAWN_SHARE * self.seconds_a_tile
        return tries * self.seconds_a_leaf * self.octree.n_leaves + judging + seconds_to_write(self.octree)

    def needs_images(self) -> bool:
        """Until the tiles at hand serve to the end."""
        more_stages = len(set(self.config.downscales[self.stage :])) > 1
        return self.bank is None or more_stages or self.appearance.may_change

    def outgrown(self) -> str | None:
        """See Phase."""
        return self.plan.outgrown(self.octree) if self.plan else None

    def refined(self) -> None:
        """The cameras stay."""

    def outcome(self) -> str | None:
        """See Phase: the steps on each size of the images, and how wide the leaves are that the views show in the end."""
        widths = visible_widths(self.octree, self.dataset.cameras)
        if not len(widths):
            return None
        return outcome(widths, self.config.downscales, self.stage_steps)

    def take_model(self, metadata: dict[str, Any]) -> OctreeModel:
        """The finished octree; tiles, moments and statistics are released."""
        octree = self.finish()
        vars(self).pop("octree")
        return_free_memory()
        return OctreeModel(octree, metadata)

    # ------------------------------------------------------------------ the schedule
    @property
    def _start(self) -> float:
        """The share of the schedule that a given octree skips."""
        return self.config.stage_ends[self.first_stage - 1] if self.first_stage else 0.0

    def state_dict(self) -> dict:
        """Everything an exact continuation needs: arrays, numbers and strings."""
        return {
            **self.leaves_saved(),
            "stage": self.stage, "first_stage": self.first_stage, "steps_done": self.steps_done,
            "progress": self._progress, "stage_steps": self.stage_steps,
            "keeps_solid": self.keeps_solid, "prunings": self.prunings,
            "cursors": dataclasses.asdict(self.cursors), "appearance": self.appearance.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: dict) -> None:
        """Continues from :meth:`state_dict` as if nothing had happened.

        Raises:
            InputError: its arrays do not fit each other.
        """
        self.load_leaves(state)
        for name in ("stage", "first_stage", "steps_done", "prunings"):
            setattr(self, name, int(state[name]))
        self._progress = float(state.get("progress", 0.0))  # the pace, by which a run without a step left is finished
        if not 0 <= self._progress < math.inf:
            raise ValueError(f"progress {self._progress}")
        self.keeps_solid = bool(state.get("keeps_solid", False))
        self.stage_steps = np.array(state.get("stage_steps", self.stage_steps), np.int64)
        if self.stage_steps.shape != (len(self.config.levels),):
            raise InputError(
                f"the checkpoint counts the steps of {self.stage_steps.size} stages, and the settings have "
                f"{len(self.config.levels)}: earlier versions had fewer for pictures of 1,024 pixels and more; begin the "
                "run again"
            )
        self.cursors = Cursors.of(state["cursors"])
        self.appearance.load_state_dict(state["appearance"])
        # The bank says when enough was seen to prune: where there was one, there must be one at once.
        self.bank = None if self.steps_done == 0 else self._make_bank()

    def step(self, progress: float) -> ops.StepReport:
        """One step at ``progress`` in [0, 1] of the run."""
        c = self.config
        progress = self._progress = self._start + progress * (1 - self._start)
        if progress >= c.stage_ends[self.stage] and (after := self._stages().after(self.stage)) is not None:
            pruned = self.prunings >= self._stages().prunes[self.stage]
            if pruned and self._seen_enough() and is_worth_it(c, after, self._steps_in_all(), progress):
                self.next_stage(after)
        self._prune_inside_stage(progress)
        if self.appearance.due(progress) and self.fit_appearance(progress):
            self.bank = None
        if self.bank is None:
            self.bank = self._make_bank()
        smooth = self.steps_done >= self.chosen.tv_from
        options = losses_at(progress, c, self.chosen, self._behind(), smooth)
        rates = rates_at(progress, c, self.chosen)
        second = is_second(self.second, self.steps_done)
        batch = self.bank.draw(c.tiles[self.stage], c.foreground_share, self.seed, self.cursors, second)
        started = time.perf_counter()
        report = ops.train_step(self.octree, self.state, batch, options, rates, self.bank.pixel_angle)
        self.seconds_a_tile = (time.perf_counter() - started) / c.tiles[self.stage]
        self.steps_done += 1
        self.stage_steps[self.stage] += 1
        self.tiles_seen += c.tiles[self.stage]
        return report

    def _behind(self) -> tuple[float, ...]:
        """What this step's rays see where they leave the octree: the background of objects, or the second one.

        In photographs another colour each step, for they have none, and nothing in them may rely on one.
        """
        if self.dataset.scene.is_unbounded:
            return random_background(self.seed, self.steps_done)
        return self.second if self.second and is_second(self.second, self.steps_done) else self.background

    def _make_bank(self) -> TileBank:
        dataset, seen = self.dataset, self.appearance
        if seen.active:
            images = Corrected(dataset.images, seen.corrected_colours)
            dataset = dataclasses.replace(dataset, images=images)
        return TileBank(dataset, self.background, self.config.downscales[self.stage], self.second)

    def fit_appearance(self, progress: float) -> bool:
        """Fits the photographs' colour maps to what the octree shows of small pictures of them; whether they are used."""
        return self.appearance.fit(self.seen, progress)

    def seen(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See FinalPhase."""
        return small_picture(self.dataset, i, self.picture)

    def next_stage(self, stage: int | None = None) -> None:
        """Prunes, splits the leaves that ``stage`` wants finer, and turns to its images; None: the next one."""
        c = self.config
        old, self.stage, self.prunings = self.stage, self.stage + 1 if stage is None else stage, 0
        error, footprint = self.prune()
        footprint = footprint * (c.downscales[old] / c.downscales[self.stage])  # in pixels of the next stage's images
        fine = c.levels[self.stage] >= FINE_LEVEL
        for _ in range(1 if fine else c.levels[self.stage] if self.stage == old + 1 else MOST_LEVELS_AT_ONCE):
            transfer = self._split(error, footprint, c.subdivide_error if fine else self.chosen.coarse_error)
            if transfer is None:
                break
            error, footprint = error[transfer.parent] / 8, footprint[transfer.parent] / 2
        if self.stage + 1 == len(c.levels):
            self._grow_sh_at_last()
        if c.downscales[old] != c.downscales[self.stage]:
            self.bank = None
            self.cursors = Cursors()

    def _grow_sh_at_last(self) -> None:
        """What the last stage begins with, which may be a given octree's first."""
        if self.config.final_sh_degree > self.octree.sh_degree:
            self.grow_sh(self.config.final_sh_degree)

    def _split(self, error: np.ndarray, footprint: np.ndarray, share: float) -> Transfer | None:
        """Splits the leaves that this stage wants finer, among those that hold ``share`` of the error; None: there are none.

        error, footprint (in pixels of this stage's images): (n_leaves,).
        """
        c, level = self.config, self.config.levels[self.stage]
        split = footprint > (c.subdivide_pixels if level >= FINE_LEVEL else c.whole_pixels)
        finest = self.dataset.scene.finest_levels(self.octree.leaf_centers(), level)
        return self.split(split & (self.octree.leaf_level < np.minimum(finest, MAX_LEVEL)), error, share)

    def _stages(self) -> Stages:
        """Those that the run has the steps for at the pace so far; pictures of half the size have a quarter of the tiles."""
        c = self.config
        known = 0 if self.bank is None else len(self.bank.foreground_tiles) * c.downscales[self.stage] ** 2
        tiles = [known / downscale**2 for downscale in c.downscales]
        return stages_for(c, self.first_stage, self._steps_in_all(), tiles, self.dataset.scene.is_unbounded)

    def _steps_in_all(self) -> float:
        """Steps of a whole run at the pace so far; there is no pace before the first."""
        made = self._progress - self._start
        return self.steps_done / made if made > 0 else math.inf

    def _seen_enough(self) -> bool:
        """Whether the rays since the last pruning can tell what no ray needs."""
        if self.bank is None:
            return False
        fewest = prune_steps(self.config, self._steps_in_all())
        enough = enough_tiles(len(self.bank.foreground_tiles), self.dataset.scene.is_unbounded)
        batch = self.config.tiles[self.stage]
        return self.tiles_seen >= min(max(fewest * batch, enough), self._stages().wait * batch)

    def _prune_inside_stage(self, progress: float) -> None:
        """Prunes where it is due, and splits where that pays."""
        c = self.config
        start = c.stage_ends[self.stage - 1] if self.stage else 0.0
        prunes = self._stages().prunes[self.stage]
        due = (self.prunings + 1) / (prunes + 1)
        if (
            self.prunings < prunes
            and progress >= start + due * (c.stage_ends[self.stage] - start)
            and self._seen_enough()
        ):
            error, footprint = self.state.error, self.state.footprint
            if 1 - self._needed(c.prune_weight).mean() >= WORTH_PRUNING:
                error, footprint = self.prune()
            if not self.chosen.growing_error or self._split(error, footprint, self.chosen.growing_error) is None:
                self.forget_statistics()
            self.prunings += 1

    def _needed(self, weight: float) -> np.ndarray:
        """Which leaves have a largest weight of at least ``weight``, (n_leaves,).

        And those that no ray has met, until two epochs of tiles were seen, so that each was for certain: what is seen at the
        rim of a few pictures would be lost for good. They cost no time, and are split no more. And, of a given octree whose
        views are too few to judge it (starts/visible.py), all that is solid.
        """
        needed = self.state.max_weight >= weight
        if self.keeps_solid:
            needed |= solid(self.octree)
        if self.bank is not None and self.config.foreground_share * self.tiles_seen < 2 * len(
            self.bank.foreground_tiles
        ):
            needed |= self.state.footprint == 0
        return needed

    def prune(self) -> tuple[np.ndarray, np.ndarray]:
        """Removes leaves that no ray needed; error and footprint of those that stay, (n_leaves,) each.

        Raises InputError where none would stay.
        """
        keep = self._needed(self.config.prune_weight)
        if not keep.any():
            raise InputError(
                f"the octree collapsed to empty space at step {self.steps_done}: no training ray needs any of it; check "
                "that --background is the images' background and that the scene bounds contain the object, or lower "
                "octree.colour_weight and octree.distortion"
            )
        started, leaves = time.perf_counter(), self.octree.n_leaves
        error, footprint = self.state.error[keep], self.state.footprint[keep]
        self.change(*self.octree.prune(keep))
        self.seconds_a_leaf = (time.perf_counter() - started) / leaves
        return error, footprint

    def finish(self) -> Octree:
        """The octree without the leaves that no picture misses: see FINAL_PRUNE_WEIGHTS. Ends the training.

        Moments and tiles are released before: a second octree is in memory while they are compared.
        """
        if self.bank is None or not self._seen_enough():
            return self.octree
        rng = np.random.default_rng(self.seed)
        tiles = self.bank.foreground_tiles if len(self.bank.foreground_tiles) else self.bank.background_tiles
        tiles = rng.choice(tiles, min(len(tiles), FINAL_TILES), replace=False)
        batch = self.bank.batch(tiles, np.ones(len(tiles), np.float32))
        needed = [self._needed(weight) for weight in FINAL_PRUNE_WEIGHTS]
        self.bank = None
        del self.state, tiles
        return_free_memory()
        return pruned_at_the_end(self.octree, needed, batch, self.background, self.config.final_prune_loss)
