"""Training of a field by the compiled kernels, step by step; ``field_trainer`` has the same in torch, ``field_start`` chooses.

Every random number of step k comes from (seed, k), and all that lives between steps is in ``state_dict``: the same seed gives
the same bits for any number of threads, stopped and resumed or not. What the schedule is worth: docs/experiments.md.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfvol.config.assemble import to_plain
from nerfvol.config.field import FieldConfig
from nerfvol.errors import InputError
from nerfvol.field.counters import mixed
from nerfvol.field.layout import Domain
from nerfvol.kernels import field_ops
from nerfvol.kernels.field_model import CompiledField
from nerfvol.kernels.field_ops import FieldBatch, FieldState, March, Occupancy
from nerfvol.kernels.field_state import COARSE
from nerfvol.native import native
from nerfvol.neural import FieldModel
from nerfvol.training import field_schedule
from nerfvol.training.appearance import Appearance, small_picture
from nerfvol.training.backgrounds import is_second, second_background
from nerfvol.training.field_looks import look
from nerfvol.training.field_phase import FIELD_SHARE, SECONDS_TO_DISTILL, FieldReport

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera, Intrinsics
    from nerfvol.datasets.dataset import Dataset

MOST_RAYS = 32768
"""Of one step, while most of space is known to be empty."""
FEW_WIDTH = 64
"""Neurons of a layer, at least, where there are few training views: a wide network guesses better what none of them sees, with
many views it only costs time."""
FEW_COARSEST = 8
"""Cells along an edge of the coarsest grid, at most, there: what no view tells then follows from what is wide around it."""
SECONDS_TO_WRITE = 0.3
"""Of a field that is the product."""


def compiled_refusal(config: FieldConfig) -> str | None:
    """Why the compiled kernels do not train a field so; None: they do."""
    if config.trainer == "torch":
        return "field.trainer is torch"
    if config.sampler != "occupancy":
        return f"field.sampler is {config.sampler}"
    if config.sparsity_weight > 0:
        return "field.sparsity_weight is not 0"
    return field_ops.refusal(config.shape)


class Pixels:
    """All training pixels of one image scale, to draw rays from: uint8 pictures and shared tables of pixel directions."""

    def __init__(self, dataset: Dataset, background: Sequence[float], downscale: int) -> None:
        compiled = native()
        assert compiled is not None
        cameras = [camera.scaled(downscale) for camera in dataset.cameras]
        pictures = [np.ascontiguousarray(image) for image in dataset.pyramid(background, downscale)]
        tables: dict[Intrinsics, np.ndarray] = {}
        for camera in cameras:
            if camera.intrinsics not in tables:
                tables[camera.intrinsics] = np.ascontiguousarray(camera.intrinsics.directions().reshape(-1, 3))
        poses = np.stack([camera.c2w for camera in cameras]).astype(np.float32)
        rotations, origins = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
        self._drawn = compiled.field_draw
        self._pixels = compiled.FieldPixels(pictures, [tables[c.intrinsics] for c in cameras], rotations, origins)

    def sample(self, n_rays: int, seed: int, step: int) -> FieldBatch:
        """Random pixels, evenly over all pictures."""
        o, d, target = (np.empty((n_rays, 3), np.float32) for _ in range(3))
        jitter = np.empty(n_rays, np.float32)
        self._drawn(self._pixels, mixed(seed, step), o, d, target, jitter)
        return FieldBatch(o, d, target, jitter)


class CompiledFieldTrainer:
    """Trains one field on one dataset, a step at a time; a phase (training.phase.Phase).

    Args:
        dataset: posed images.
        domain: the field's region.
        config: see ``FieldConfig``.
        seed: all randomness.
        background: RGB that images with alpha are composited on and that lies behind the field.
        near_plane: nothing nearer to a camera is looked at, u.
        final: the field is what the run is for; else an octree follows, which is made of it.
    """

    name = "field"
    rates = "field.rate"
    previews = (0.6, 1.0)  # not of haze, which takes long
    preview_width = 400
    timed_at = 8  # each ray costs alike
    stages_left = 0
    most_steps = math.inf

    def __init__(
        self,
        dataset: Dataset,
        domain: Domain,
        config: FieldConfig,
        seed: int = 0,
        background: Sequence[float] = (1.0, 1.0, 1.0),
        near_plane: float = 0.0,
        final: bool = False,
    ) -> None:
        self.final, self.appearance = final, Appearance(len(dataset), "off")
        self.dataset, self.seed, self.domain = dataset, seed, domain
        self.few = len(dataset) <= config.few_views
        shape = config.shape
        if self.few:
            coarsest = min(shape.hash_min, FEW_COARSEST)
            shape = dataclasses.replace(shape, sh_degree=0, width=max(shape.width, FEW_WIDTH), hash_min=coarsest)
        self.config = dataclasses.replace(config, shape=shape)
        self.background = (float(background[0]), float(background[1]), float(background[2]))
        self.state = FieldState(domain, shape, seed)
        self.second = second_background(dataset, self.background, self.few)
        self.occupancy = Occupancy(domain, config.grid_resolution)
        self.steps_done, self.stage = 0, 0  # an image scale is no stage: nothing else changes with it
        self.march = March(self.occupancy, config.march_steps[-1], near_plane)
        self.n_rays = max(1, config.samples_per_step // 64)
        self._pixels: dict[tuple[int, bool], Pixels] = {}  # by image scale, and whether before the second background

    # ------------------------------------------------------------------ what a run asks of a phase
    @property
    def steps(self) -> int:
        """Of the whole schedule without a time budget."""
        return self.config.steps

    @property
    def parameter_bytes(self) -> int:
        """Bytes of the grid's entries and of the network."""
        return self.state.nbytes

    def share_of(self, seconds: float) -> float:
        """All of them, or, where an octree follows, ``field.time_budget`` and at most FIELD_SHARE."""
        return seconds if self.final else min(self.config.time_budget, FIELD_SHARE * seconds)

    def size(self) -> str:
        """See Phase: where it is the product, what a picture takes follows from the occupied cells, in powers of two."""
        if not self.final:
            return f"{self.parameter_bytes // 4:,} parameters"
        cells = (
            int.from_bytes(self.occupancy.coarse.tobytes(), "little").bit_count() * COARSE**3
        )  # asked for at every step
        return f"{self.parameter_bytes // 4:,} parameters, about {2 ** round(math.log2(max(1, cells))):,} cells"

    def seconds_to_write(self) -> float:
        """Distilling comes first, where an octree follows."""
        return SECONDS_TO_WRITE if self.final else SECONDS_TO_DISTILL

    def needs_images(self) -> bool:
        """Until the pixels at hand serve to the end; an octree will ask for them."""
        return not (self.final and len(set(self.config.downscales)) == 1 and self._pixels)

    def outgrown(self) -> str | None:
        """A field does not grow."""
        return None

    def outcome(self) -> str | None:
        """What a field could still learn is not known."""
        return None

    def picture(self, camera: Camera) -> np.ndarray:
        """(height, width, 3) float32 image of the field as ``camera`` sees it."""
        return self.trained_field().picture(camera)

    def trained_field(self) -> CompiledField:
        """The field without what it holds in space that training skips: what is to be rendered or distilled. An object is drawn
        with the finest steps, which show more than those that it was trained with; of photographs haze would take too long."""
        self.state.use_levels(self.state.n_levels)  # as it will be read from a file
        march = self.march if self.domain.outer > 1 else self.march.with_steps(self.config.march_steps[-1])
        return CompiledField(self.state, march, self.background)

    def seen(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See FinalPhase."""
        return small_picture(self.dataset, i, self.picture)

    def refined(self) -> None:
        """The cameras stay."""

    def take_model(self, metadata: dict[str, Any]) -> FieldModel:
        """The field as it is; Adam's moments stay behind with the trainer."""
        return FieldModel(self.trained_field(), metadata)

    # ------------------------------------------------------------------ training
    def step(self, progress: float | None = None) -> FieldReport:
        """One optimisation step.

        Args:
            progress: how much of the run is over, 0 to 1; None = steps done / ``config.steps``.
        """
        config = self.config
        progress = min(1.0, self.steps_done / config.steps if progress is None else progress)
        stage = config.stage_at(progress)
        second = is_second(self.second, self.steps_done)
        batch = self._bank(config.downscales[stage], second).sample(self.n_rays, self.seed, self.steps_done)
        behind = self.second if self.second and second else self.background
        step, n_levels = self.steps_done, self.state.n_levels
        self.march = self.march.with_steps(field_schedule.march_steps(config, stage, step))
        self.state.use_levels(field_schedule.levels_in_use(n_levels, step))
        loss = field_schedule.loss_at(config, self.few, behind, progress)
        rates = field_schedule.rates_at(config, self.few, step, progress)
        moves = field_schedule.moves(n_levels, step)
        report = field_ops.train_step(self.state, batch, self.march, loss, rates, moves)
        self.steps_done += 1
        look(self.state, self.occupancy, self.seed, self.steps_done)
        n_rays = self.n_rays
        self._follow_samples(report.samples / n_rays)
        return FieldReport(
            squared_error=report.squared_error, samples=report.samples / n_rays, loss=report.loss, n_rays=n_rays,
            downscale=config.downscales[stage],
        )  # fmt: skip

    def _follow_samples(self, per_ray: float) -> None:
        """Choose the next number of rays so that a step has about ``samples_per_step`` samples."""
        wanted = self.config.samples_per_step / max(per_ray, 0.25)
        self.n_rays = max(1, min(MOST_RAYS, int(min(wanted, 1.25 * self.n_rays + 16))))

    def _bank(self, downscale: int, second: bool) -> Pixels:
        if (downscale, second) not in self._pixels:
            colours = {False: self.background} | ({} if self.second is None else {True: self.second})
            self._pixels = {(downscale, s): Pixels(self.dataset, c, downscale) for s, c in colours.items()}
        return self._pixels[downscale, second]

    def state_dict(self) -> dict[str, Any]:
        """Everything that lives between steps, as arrays and numbers."""
        return {
            "field": self.state.arrays(),
            "shape": to_plain(self.state.shape),  # a resumed run's may follow from another budget
            "grid": self.occupancy.state_dict(),
            "steps_done": self.steps_done,
            "n_rays": self.n_rays,
            "march_steps": self.march.n_steps,  # of photographs' fields these are drawn with
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of ``state_dict``; InputError where the state is of another network."""
        try:
            self.state.load_arrays(state["field"])
            self.occupancy.load_state_dict(state["grid"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"the checkpoint's field does not fit the configured network: {error}") from error
        self.steps_done, self.n_rays = int(state["steps_done"]), int(state["n_rays"])
        steps, most = int(state.get("march_steps", self.march.n_steps)), max(self.config.march_steps)
        if not 1 <= steps <= most:
            raise InputError(f"the checkpoint's field has {steps} steps along a ray, expected 1 to {most}")
        self.march = self.march.with_steps(steps)
