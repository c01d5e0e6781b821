"""What is trained: the trainer of each representation for a run, with its memory announced and its start made."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.medium.lighting import load_lighting
from nerfvol.native import need_torch
from nerfvol.starts.exposures import measure_exposures
from nerfvol.starts.fog import low_density_octree
from nerfvol.training.appearance import Appearance
from nerfvol.training.backgrounds import second_background
from nerfvol.training.compiled_field import CompiledFieldTrainer
from nerfvol.training.few_views import few_views
from nerfvol.training.field_start import make_final_trainer
from nerfvol.training.memory import (
    OctreePlan,
    field_backgrounds,
    field_memory,
    medium_memory,
    photographs_bytes,
    splat_memory,
)
from nerfvol.training.octree_start import (
    Optimise,
    SplatPlan,
    planned_splats,
    settings_of_octree,
    start_from_field,
    start_from_splats,
    why_start,
)
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.session import Run
from nerfvol.training.splat_trainer import SplatTrainer

if TYPE_CHECKING:
    from nerfvol.training.medium_trainer import MediumTrainer

WHY = {
    "octree": "an object without surroundings, or asked for by --init",
    "splats": "photographs, which splats draw sharper and sooner, or asked for by --init",
    "medium": "--light tells the light",
}
MEASURED_FROM = 1.0
"""Seconds for each photograph from which on exposures are measured before training: that takes 0.02 to 0.08 s of each."""


def begin_octree(run: Run, optimise: Optimise) -> OctreeTrainer:
    """The trainer of an octree: from low density, or from a field or splats that are trained first, by ``optimise``."""
    data = run.data
    splats = planned_splats(run) if run.config.init == "splats" and run.phase in ("start", "splats") else None
    try:
        plan = _plan_of(run, splats)
    except InputError as error:
        if splats is None or run.given.init != "auto" or run.phase == "splats":
            raise
        splats = None
        run.without_first()
        plan = _plan_of(run, None)  # or there is no memory for any
        run.say(f"start: low density, for with splats first {error}")
    announce(run, plan.sentence())
    photographs = data.training.scene.is_unbounded
    if run.config.init != run.given.init and (chosen := why_start(run.config, len(data.training), photographs)):
        run.say(chosen)
    # A resumed run's is the checkpoint's: of low density it might begin with a level that fills the memory.
    octree = low_density_octree(data.training, 3, 1) if run.phase == "octree" else None
    # Photographs that splats see are measured for them, and the octree goes on with what they found.
    appearance = appearance_of(run, measured=splats is None or not photographs)
    if splats is not None:
        octree = start_from_splats(run, splats, appearance_of(run, splats.photographs), appearance, optimise)
        splats = None  # its photographs' memory is the octree's now
    elif run.config.init == "mlp" and run.phase in ("start", "field"):
        octree = start_from_field(run, optimise)
    settings = settings_of_octree(run)
    return OctreeTrainer(data.training, run.background, settings, run.config.seed, octree, plan, appearance)


def _plan_of(run: Run, splats: SplatPlan | None) -> OctreePlan:
    """How large the octree may become, of ``splats`` or of what takes no memory before; InputError where nothing fits."""
    training, held_out = run.data.training, run.data.held_out_bytes
    if splats is None:
        return OctreePlan(run.config, training, held_out)
    return OctreePlan(run.config, training, held_out, splats.bytes, splats.leaves, splats.stage is None)


def begin_field(run: Run) -> CompiledFieldTrainer:
    """The trainer of a field that is the product itself."""
    config, dataset = run.config, run.data.training
    announce(run, field_memory(dataset, config.field, run.data.held_out_bytes))
    return make_final_trainer(dataset, config.field, config.seed, run.background)


def begin_medium(run: Run) -> MediumTrainer:
    """The trainer of a medium under known light."""
    need_torch("--representation medium")
    from nerfvol.training.medium_trainer import MediumTrainer

    ops.set_threads(ops.get_threads())  # torch may have been loaded only now
    config, dataset = run.config, run.data.training
    if dataset.scene.is_unbounded:
        raise InputError(
            "--light fits a medium alone: expected pictures with a transparent background, not surroundings"
        )
    lighting = load_lighting(config.light or "")
    announce(run, medium_memory(dataset, config.medium, run.data.held_out_bytes))
    return MediumTrainer(dataset, lighting, config.medium, config.seed, run.background)


def begin_splats(run: Run, optimise: Optimise) -> SplatTrainer:
    """The trainer of splats: from what suits the data, a field of few views first, trained by ``optimise``, or what ``init``
    asks for."""
    from nerfvol.training.splat_start import make_schedule_of, start_splats

    config, dataset = run.config, run.data.training
    second = second_background(dataset, run.background, bool(config.splats.two_backgrounds))
    photographs = Photographs(dataset, run.background, most_bytes=photographs_bytes(), second=second)
    for message in photographs.messages:
        run.say(message)
    schedule, kept = make_schedule_of(run, photographs), run.data.held_out_bytes
    first = field_backgrounds(config.field, dataset) if config.init == "mlp" and run.phase != "splats" else 0
    announce(run, splat_memory(dataset, photographs, schedule, config.splats, kept, first))
    if config.init != run.given.init and (chosen := why_start(config, len(dataset))):
        run.say(chosen)
    octree = start_from_field(run, optimise) if first else None
    splats, distance = start_splats(run, photographs, schedule.most, octree)
    del octree
    return SplatTrainer(
        photographs, splats, config.splats, schedule, distance, run.background, config.seed, appearance_of(run, photographs),
        config.refine_poses,
    )  # fmt: skip


def appearance_of(run: Run, photographs: Photographs | None = None, measured: bool = True) -> Appearance:
    """The colour maps of the run's photographs, which say themselves whether they need any. Objects whose pictures have the
    background painted in, as splats see all of them, have none: a map would change the background too. ``measured``: whether
    photographs are asked now, before any model."""
    dataset, config = run.data.training, run.config
    keeps_alpha = config.representation == "octree" and photographs is None and dataset.images[0].shape[2] == 4
    mapped = dataset.scene.is_unbounded or keeps_alpha
    appearance = Appearance(len(dataset), config.appearance if mapped else "off")
    begun = config.representation if photographs is None else "splats"
    if measured and appearance.mode != "off" and run.phase != begun:  # else the checkpoint knows
        left = run.seconds_left()
        if appearance.mode == "on" or left is None or left >= MEASURED_FROM * len(dataset):
            appearance.begin(measure_exposures(dataset, photographs))
    return appearance


def announce(run: Run, memory: str) -> None:
    """What is trained on what, and the memory that takes."""
    lens = run.data.training.cameras[0].intrinsics
    why = (
        "" if run.given.representation != "auto" else f" ({WHY[run.config.representation]}; --representation overrules)"
    )
    run.say(f"training {run.config.representation}{why}")
    run.say(f"{len(run.data.training)} training views of {lens.width}x{lens.height}, {len(run.data.held_out)} held out; "
            f"memory: {memory}")  # fmt: skip
    said = few_views(len(run.data.training), run.data.training.scene.is_unbounded)
    if said is not None:
        run.say(said)
