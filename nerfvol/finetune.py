"""Optimising the octree: stages from coarse to fine, pruning, subdivision where it pays.

The recipe (docs/performance.md has what each choice is worth): images from small to full size, an octree that starts
thin and uniform, loses what no ray needs and splits what rays see at more than a pixel; per-sample colour and distortion
terms that empty space; RMSprop on touched vertices.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nerfvol.datasets import Dataset, SceneBounds
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.machine import return_free_memory
from nerfvol.memory import splits_within
from nerfvol.octree import Octree, Transfer, convert_rows
from nerfvol.settings import filled
from nerfvol.tiles import Cursor, TileBank
from nerfvol.topology import MAX_LEVEL


@dataclass
class OctreeConfig:
    """Settings of the octree's optimisation. Shares of progress lie in [0, 1]."""

    steps: int = 15000
    """Optimiser steps of the whole schedule when no time budget is given."""
    most_epochs: float = 40.0
    """... and when one is given, as many as draw each tile so often at most: a run that comes to them ends early, for more
    would overfit (docs/performance.md)."""
    levels: list[int] = field(default_factory=lambda: [5, 6, 7, 8, 8, 9, 10])
    """Finest level of each stage: level 8 means 256 cells along the region of detail."""
    downscales: list[int] = field(default_factory=lambda: [16, 8, 4, 2, 1, 1, 1])
    """Image downscale of each stage."""
    until: list[float] = field(default_factory=lambda: [0.003, 0.008, 0.03, 0.10, 0.35, 0.60, 1.0])
    """Share of progress at which each stage ends."""
    tiles: list[int] = field(default_factory=lambda: [64, 96, 128, 128, 192, 320, 320])
    """8x8 tiles in a batch, per stage: about equal work a step, so that shares of steps are shares of time."""
    prunes: list[int] = field(default_factory=lambda: [3, 3, 2, 2, 2, 2, 2])
    """Prunings inside each stage, evenly spaced."""
    coverage: float = 0.5
    """Pruning waits until this share of the tiles that are not plain background was seen (see _seen_enough for the cap)."""
    prune_steps: int = 20
    """... and this many steps were made: a thin start needs some to become visible at all, however few the pictures."""
    sh_degree: int | None = None
    """Spherical harmonics of the colours: 0 to 3. None: 1, and 2 in photographs, whose surfaces shine."""
    final_sh_degree: int = 1
    """... in the last stage, where it is more: for shiny scenes. It costs memory and steps (docs/performance.md)."""
    rich_share: float = 0.8
    """Share of a batch drawn from tiles that are not plain background."""
    colour: float = 0.06
    """Weight of the per-sample colour term at the start."""
    distortion: float = 0.05
    """Weight of the distortion term at the start."""
    regulariser_decay: float = 0.1
    """Both weights shrink to this factor over the run."""
    rate_density: float = 0.3
    rate_dc: float = 0.07
    rate_sh: float = 0.006
    rate_decay: float | None = None
    """Learning rates shrink exponentially to this factor ... None: 0.04, and 0.02 in photographs."""
    decay_from: float | None = None
    """... from this share of progress on. None: 0.8, and 0.35 in photographs, whose noise takes longer to average."""
    beta: float = 0.98
    prune_weight: float = 0.005
    """Leaves whose largest rendering weight since the last pruning is below are removed."""
    final_prune_weights: list[float] = field(default_factory=lambda: [0.04, 0.02, 0.01])
    """At the end: the first of these at which pruning costs no more than ``final_prune_loss``."""
    final_prune_loss: float = 0.005
    """Share by which the squared error of training tiles may grow (0.005 is 0.02 dB); what it takes from the octree is speed
    and bytes that nobody sees, in thin shells about a tenth, in thick media nothing."""
    whole_pixels: float = 2.5
    """Stages split all leaves larger than this many pixels of their images in some view, down to their level, until ..."""
    fine_from: int = 9
    """... this level; from there on a stage splits leaves once, ..."""
    subdivide_pixels: float = 1.5
    """... those larger than this many pixels ..."""
    subdivide_error: float = 0.7
    """... that are among the fewest to hold this share of the squared error."""
    fine_steps: int = 2500
    """A stage from level ``fine_from`` on is left out where fewer steps would be left for it."""
    early_stop_eps: float = 4e-3
    """Training rays end when their transmittance falls below."""

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            given = getattr(self, name)
            for value in given if isinstance(given, list) else [given]:
                if value is not None and not low <= value <= high:
                    raise InputError(f"octree.{name} must lie between {low:g} and {high:g}, got {value:g}")

    def for_scene(self, scene: SceneBounds) -> OctreeConfig:
        """The same with a number for each None; photographs are scenes with surroundings."""
        return filled(self, BOUNDED if scene.background_cube is None else PHOTOGRAPHS)


RANGES = {
    "steps": (1, math.inf), "most_epochs": (0.1, math.inf), "levels": (1, MAX_LEVEL), "downscales": (1, 256),
    "until": (0, 1), "tiles": (1, 1 << 20),
    "prunes": (0, math.inf), "coverage": (0, math.inf), "prune_steps": (0, math.inf), "sh_degree": (0, 3),
    "final_sh_degree": (0, 3), "rich_share": (0, 1), "colour": (0, math.inf), "distortion": (0, math.inf),
    "regulariser_decay": (1e-9, 1), "rate_density": (0, 1e3), "rate_dc": (0, 1e3), "rate_sh": (0, 1e3),
    "rate_decay": (1e-9, 1), "decay_from": (0, 0.999), "beta": (0, 0.9999), "prune_weight": (0, math.inf),
    "final_prune_weights": (0, 1), "final_prune_loss": (0, math.inf), "whole_pixels": (0, math.inf), "fine_from": (0, math.inf),
    "subdivide_pixels": (0, math.inf), "subdivide_error": (0, 1), "fine_steps": (0, math.inf), "early_stop_eps": (0, 0.999),
}  # fmt: skip
"""Smallest and largest value of each setting, and of each entry of a list."""
BOUNDED = {"sh_degree": 1, "rate_decay": 0.04, "decay_from": 0.8}
PHOTOGRAPHS = {"sh_degree": 2, "rate_decay": 0.02, "decay_from": 0.35}
"""Settings of an octree where nothing else is said."""


WORTH_PRUNING = 0.05
"""Share of the leaves below which a pruning inside a stage is left out: two octrees stand in memory while one is made."""
FINAL_TILES = 4096
"""Training tiles on which the final pruning is judged: 0.4 of an 800x800 picture."""


class OctreeTrainer:
    """Optimises an octree on a dataset. ``progress`` runs from 0 to 1 and drives every schedule."""

    def __init__(
        self, dataset: Dataset, background: Sequence[float], config: OctreeConfig, seed: int, octree: Octree | None
    ):
        config = config.for_scene(dataset.scene)
        n = len(config.levels)
        for name in ("downscales", "until", "tiles", "prunes"):
            if len(getattr(config, name)) != n:
                raise InputError(f"octree.{name} must have one entry per stage ({n}), got {len(getattr(config, name))}")
        self.dataset, self.background, self.config, self.seed = dataset, tuple(background), config, seed
        self.octree = octree if octree is not None else self._thin_start()
        self.state = ops.TrainState(self.octree)
        # A given octree enters at the stage whose finest level it has, where full progress of that stage is still ahead.
        self.stage = 0 if octree is None else first_stage(config, octree, dataset.scene)
        self.first_stage = self.stage
        self.step_count = 0
        self.rich, self.plain = Cursor(), Cursor()
        self.prunings = 0
        self.tiles_seen = 0
        self.bank: TileBank | None = None
        self.max_leaves: int | None = None
        """Bound on splitting, where memory is short; None: none."""

    def _thin_start(self) -> Octree:
        return thin_octree(self.dataset, self.config.levels[0], self.config.sh_degree)

    @property
    def _start(self) -> float:
        """The share of the schedule that a given octree skips."""
        return self.config.until[self.first_stage - 1] if self.first_stage else 0.0

    def state_dict(self) -> dict:
        """Everything an exact continuation needs: arrays, numbers and strings."""
        t, s = self.octree, self.state
        return {
            "node_mask": t.node_mask, "leaf_mask": t.leaf_mask, "values": t.values, "moments": s.moments,
            "origin": t.origin, "size": t.size, "density_scale": t.density_scale, "sh_degree": t.sh_degree,
            "max_weight": s.max_weight, "error": s.error, "footprint": s.footprint,
            "stage": self.stage, "first_stage": self.first_stage, "step_count": self.step_count,
            "prunings": self.prunings, "tiles_seen": self.tiles_seen,
            "rich": dataclasses.asdict(self.rich), "plain": dataclasses.asdict(self.plain),
        }  # fmt: skip

    def load_state_dict(self, state: dict) -> None:
        """Continues from :meth:`state_dict` as if nothing had happened."""
        octree = Octree(
            state["node_mask"], state["leaf_mask"], origin=state["origin"], size=state["size"],
            sh_degree=state["sh_degree"], density_scale=state["density_scale"],
        )  # fmt: skip
        if np.shape(state["values"]) != octree.values.shape or np.shape(state["moments"]) != octree.values.shape:
            raise InputError("checkpoint: values and moments do not fit the octree's topology")
        octree.values = np.array(state["values"], dtype=np.float32)
        self.octree = octree
        self.state = ops.TrainState(octree, np.array(state["moments"], dtype=np.float32))
        for name in ("max_weight", "error", "footprint"):
            if np.shape(state[name]) != (octree.n_leaves,):
                raise InputError(f"checkpoint: {name} does not fit the octree's {octree.n_leaves} leaves")
            setattr(self.state, name, np.array(state[name], dtype=np.float32))
        for name in ("stage", "first_stage", "step_count", "prunings", "tiles_seen"):
            setattr(self, name, int(state[name]))
        self.rich, self.plain = Cursor(**state["rich"]), Cursor(**state["plain"])
        # The bank says when enough was seen to prune: where it stood before, it must stand at once.
        self.bank = None if self.step_count == 0 else self._make_bank()

    def step(self, progress: float) -> ops.StepReport:
        """One step at ``progress`` in [0, 1] of the run."""
        c = self.config
        progress = self._start + progress * (1 - self._start)
        if progress >= c.until[self.stage] and self.stage + 1 < len(c.levels):
            if self.prunings == c.prunes[self.stage] and self._seen_enough() and self._worth_splitting(progress):
                self.next_stage()
        self._prune_inside_stage(progress)
        if self.bank is None:
            self.bank = self._make_bank()
        fade = c.regulariser_decay**progress
        options = ops.LossOptions(self.background, c.colour * fade, c.distortion * fade, c.early_stop_eps)
        late = max(0.0, progress - c.decay_from) / (1 - c.decay_from)
        rate = c.rate_decay**late
        rates = ops.Rates(c.rate_density * rate, c.rate_dc * rate, c.rate_sh * rate, c.beta)
        batch = self.bank.draw(c.tiles[self.stage], c.rich_share, self.seed, self.rich, self.plain)
        report = ops.train_step(self.octree, self.state, batch, options, rates, self.bank.pixel_angle)
        self.step_count += 1
        self.tiles_seen += c.tiles[self.stage]
        return report

    def _make_bank(self) -> TileBank:
        return TileBank(self.dataset, self.background, self.config.downscales[self.stage])

    def next_stage(self) -> None:
        """Prunes, splits the leaves that the next stage wants finer, and turns to its images."""
        c = self.config
        old, self.stage, self.prunings = self.stage, self.stage + 1, 0
        error, footprint = self.prune()
        footprint = footprint * (c.downscales[old] / c.downscales[self.stage])  # in pixels of the next stage's images
        wanted, fine = c.levels[self.stage], c.levels[self.stage] >= c.fine_from
        for _ in range(1 if fine else wanted):
            split = footprint > (c.subdivide_pixels if fine else c.whole_pixels)
            split &= self.octree.leaf_level < leaf_limits(self.octree, self.dataset.scene, wanted)
            if fine:
                split &= holds_share(error, c.subdivide_error)
            split = splits_within(split, error, self.max_leaves)
            if not split.any():
                break
            transfer = self._change(*self.octree.subdivide(split))
            error, footprint = error[transfer.parent] / 8, footprint[transfer.parent] / 2
        if self.stage + 1 == len(c.levels) and c.final_sh_degree > self.octree.sh_degree:
            self._grow_sh(c.final_sh_degree)
        if c.downscales[old] != c.downscales[self.stage]:
            self.bank = None
            self.rich, self.plain = Cursor(), Cursor()

    def _grow_sh(self, degree: int) -> None:
        """The same field with more bands, which begin at zero."""
        moments = convert_rows(self.state.moments, self.octree.sh_degree, degree)
        self.octree = self.octree.with_sh_degree(degree)
        self.state = ops.TrainState(self.octree, moments)

    def _worth_splitting(self, progress: float) -> bool:
        """Whether the next stage, if it is a fine one, will have the steps that it needs at the pace so far."""
        c = self.config
        left = self.step_count * (1 - progress) / max(progress - self._start, 1e-9)
        return c.levels[self.stage + 1] < c.fine_from or left >= c.fine_steps

    def _seen_enough(self) -> bool:
        """Whether the rays since the last pruning can tell what no ray needs."""
        # Around photographs much is seen at the rim of a few of them only: it takes more tiles to have met it at all.
        enough = 20_000 if self.dataset.scene.background_cube is None else 80_000
        if self.bank is None or self.tiles_seen < self.config.prune_steps * self.config.tiles[self.stage]:
            return False
        return self.tiles_seen >= min(self.config.coverage * len(self.bank.rich_tiles), enough)

    def _prune_inside_stage(self, progress: float) -> None:
        c = self.config
        start = c.until[self.stage - 1] if self.stage else 0.0
        due = (self.prunings + 1) / (c.prunes[self.stage] + 1)
        if (
            self.prunings < c.prunes[self.stage]
            and progress >= start + due * (c.until[self.stage] - start)
            and self._seen_enough()
        ):
            if 1 - self._needed(self.config.prune_weight).mean() < WORTH_PRUNING:
                self._start_anew()
            else:
                self.prune()
            self.prunings += 1

    def _needed(self, weight: float) -> np.ndarray:
        """Which leaves have a largest weight of at least ``weight``, (n_leaves,).

        And those that no ray has met, until two epochs of tiles were seen, so that each was for certain: what stands at the
        rim of a few pictures would be lost for good. They cost no time, and are split no more.
        """
        needed = self.state.max_weight >= weight
        if self.bank is not None and self.config.rich_share * self.tiles_seen < 2 * len(self.bank.rich_tiles):
            needed |= self.state.footprint == 0
        return needed

    def _start_anew(self) -> None:
        """Forgets what rays needed so far."""
        self.tiles_seen = 0
        self.state.reset_statistics(self.octree.n_leaves)

    def prune(self) -> tuple[np.ndarray, np.ndarray]:
        """Removes leaves that no ray needed; error and footprint of those that stay."""
        keep = self._needed(self.config.prune_weight)
        self.tiles_seen = 0
        if not keep.any():
            raise InputError(
                f"the octree collapsed to empty space at step {self.step_count}: no training ray needs any of it; check "
                "that --background is the images' background and that the scene bounds contain the object, or lower "
                "octree.colour and octree.distortion"
            )
        error, footprint = self.state.error[keep], self.state.footprint[keep]
        self._change(*self.octree.prune(keep))
        return error, footprint

    def finish(self) -> Octree:
        """The octree without the leaves that no picture misses: see ``final_prune_weights``. Ends the training.

        A second octree stands beside the first while they are compared; moments and tiles are let go before.
        """
        if self.bank is None or not self._seen_enough():
            return self.octree
        rng = np.random.default_rng(self.seed)
        tiles = self.bank.rich_tiles if len(self.bank.rich_tiles) else self.bank.plain_tiles
        tiles = rng.choice(tiles, min(len(tiles), FINAL_TILES), replace=False)
        batch = self.bank.batch(tiles, np.ones(len(tiles), np.float32))
        needed = [self._needed(weight) for weight in self.config.final_prune_weights]
        self.bank = None
        del self.state, tiles
        return_free_memory()
        most = self._squared_error(self.octree, batch) * (1 + self.config.final_prune_loss)
        for keep in needed:
            if not keep.any():
                continue
            pruned = None  # one at a time
            pruned = self.octree.prune(keep)[0]
            if self._squared_error(pruned, batch) <= most:
                return pruned
        return self.octree

    def _squared_error(self, octree: Octree, batch: ops.Batch) -> float:
        """Sum over the batch's rays, with their weights, of the squared error of the colours as they are shown."""
        image = ops.render_rays(octree, batch.rays_o, batch.rays_d, self.background, outputs=("rgb",))["rgb"]
        difference = np.clip(image, 0, 1) - batch.target
        return float((difference**2).sum(1, dtype=np.float64) @ batch.weight)

    def _change(self, octree: Octree, transfer: Transfer) -> Transfer:
        self.octree = octree  # the old values go before the moments follow
        self.state = ops.TrainState(octree, transfer.vertices(self.state.moments))
        return transfer


def holds_share(error: np.ndarray, share: float) -> np.ndarray:
    """The fewest entries of ``error`` (n,) that together hold ``share`` of its sum: (n,) bool."""
    order = np.argsort(-error, kind="stable")
    held = np.cumsum(error[order], dtype=np.float64)
    chosen = np.zeros(len(error), dtype=bool)
    chosen[order[: 1 + np.searchsorted(held, share * held[-1])]] = True
    return chosen


def first_stage(config: OctreeConfig, octree: Octree, scene: SceneBounds) -> int:
    """The first stage whose finest level is the octree's, or the last one."""
    finest = octree.max_level - n_shells(scene)
    reached = [i for i, level in enumerate(config.levels) if level >= finest]
    return reached[0] if reached else len(config.levels) - 1


def n_shells(scene: SceneBounds) -> int:
    """How often the detail cube must double to hold the surroundings; 0 where the background is not part of the scene."""
    if scene.background_cube is None:
        return 0
    detail, around = ((box[1] - box[0]).max() for box in (scene.aabb, scene.background_cube))
    return max(0, int(np.ceil(np.log2(around / detail) - 1e-6)))


def thin_octree(dataset: Dataset, level: int, sh_degree: int) -> Octree:
    """A nearly transparent octree: 2**level cells along the detail cube, then shells of doubling cells to the horizon.

    Each shell reaches twice as far as the one inside it with cells twice as large, so that cells look about equally
    large from the middle. Right before the lenses there is nothing (Dataset.before_a_lens).
    """
    scene = dataset.scene
    lo, hi = scene.aabb
    detail, shells, n = float((hi - lo).max()), n_shells(scene), 2**level
    size = detail * 2**shells
    origin = (lo + hi) / 2 - size / 2
    cube = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    levels, cells = [], []
    for shell in range(shells + 1):
        inner = ((cube >= n // 4) & (cube < n - n // 4)).all(1)
        ijk = cube if shell == 0 else cube[~inner]
        levels.append(np.full(len(ijk), level + shells - shell))
        cells.append(ijk + (2 ** (level + shells - shell) - n) // 2)
    levels, cells = np.concatenate(levels), np.concatenate(cells)
    kept = ~dataset.before_a_lens(origin + (cells + 0.5) * (size / 2.0**levels)[:, None])
    levels, cells = levels[kept], cells[kept]
    return Octree.from_leaves(levels, cells, origin, size, sh_degree, density_scale=300 / detail)


def leaf_limits(octree: Octree, scene: SceneBounds, level: int) -> np.ndarray:
    """The finest level that each leaf may have, (n_leaves,), where the detail cube has 2**level cells."""
    shells = n_shells(scene)
    half = (scene.aabb[1] - scene.aabb[0]).max() / 2
    distance = np.abs(octree.leaf_centers() - scene.center).max(1) / half
    return level + shells - np.ceil(np.log2(np.maximum(distance, 1))).astype(np.int64)
