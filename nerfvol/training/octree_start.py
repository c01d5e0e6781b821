"""What an octree begins with besides low density: a field or splats, which are trained first as a phase of the run.

Both end as an octree and as rows among the run's results; a run that is resumed inside of either goes on there. Splats of few
views begin with a field's octree as well.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from nerfvol.config.octree import FINEST_LEVEL, OctreeConfig
from nerfvol.config.training import Config
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import EmptyModel, InputError
from nerfvol.files import run_folder
from nerfvol.kernels import ops
from nerfvol.machine import return_free_memory
from nerfvol.measure.scores import MEANS, evaluate, score_views
from nerfvol.octree.tree import Octree
from nerfvol.training.appearance import MOMENTS, Appearance, small_picture
from nerfvol.training.backgrounds import second_background
from nerfvol.training.field_phase import level_in_time
from nerfvol.training.field_start import make_field_trainer
from nerfvol.training.memory import (
    SURFACE_BYTES,
    photographs_bytes,
    splat_memory,
    starting_splats_bytes,
    surface_leaves,
)
from nerfvol.training.phase import Phase
from nerfvol.training.session import Run
from nerfvol.training.splat_schedule import Schedule
from nerfvol.training.surface_stages import (
    MOST_LEVEL,
    has_stages_of_its_own,
    stage_for,
    stage_in,
    with_stage,
)
from nerfvol.views import OctreeModel

Optimise = Callable[[Run, Phase], None]
"""Makes the steps of a phase (training.train.optimise)."""


def why_start(config: Config, n_views: int, photographs: bool = False) -> str | None:
    """A sentence on the start that was chosen for ``n_views`` training views; None: low density, which needs none, or splats'
    points, of which their start says more."""
    if config.init == "mlp":
        few = n_views <= config.field.few_views
        why = f"there are only {n_views} training views" if few else "there is time for one"
        octree, instead = ("the octree that it is distilled to", "direct")
        if config.representation == "splats":
            octree, instead = f"discs on {octree}", "hull"
        return f"start: a field, then {octree}, for {why}; --init {instead} overrules"
    if config.init == "splats":
        why = (
            "low density would leave haze in photographs" if photographs else f"{config.time_budget or 0:g} s are short"
        )
        return f"start: splats, then the octree of the surfaces that they show, for {why}; --init direct overrules"
    return None


def start_from_field(run: Run, optimise: Optimise) -> Octree | None:
    """Trains the field and distils it; the octree, and the scores of both among the run's results.

    None, with a sentence, where nobody asked for a field and it came out empty: there is low density to begin with, or for
    splats what suits the data.

    Raises:
        EmptyModel: a field was asked for, and there is nothing in it.
    """
    try:
        return _distilled(run, optimise)
    except EmptyModel:
        if run.given.init != "auto":
            raise
        run.results.pop("field", None)
        run.without_first()
        instead = "low density" if run.config.representation == "octree" else "without a field"
        run.say(f"start: {instead}, for the field came out empty; are the background and the scene bounds right?")
        return None


def _distilled(run: Run, optimise: Optimise) -> Octree:
    from nerfvol.starts.field import distill

    config, background, data = run.config, run.background, run.data
    field = make_field_trainer(data.training, config.field, config.seed, background)
    ops.set_threads(ops.get_threads())  # torch may have been loaded only now
    optimise(run, field)
    run.results["field"] = {"seconds": run.phase_seconds(), "steps": field.steps_done, "leaves": None,
                            "MB": field.parameter_bytes / 1e6}  # fmt: skip
    finest = min(config.distill.level or FINEST_LEVEL, max(config.octree.levels))
    settings = dataclasses.replace(config.distill, level=level_in_time(finest, run.seconds_left()))
    if settings.level != finest:
        run.say(f"the field is distilled at level {settings.level} instead of {finest}, for which there is no time")
    started = time.perf_counter()
    octree, report = distill(field.trained_field(), field.domain, data.training, background, settings, field.picture)
    for message in report.messages:
        run.say(message)
    run.say(str(report))
    distilled = OctreeModel(octree, run.metadata())
    in_units = OctreeModel(run.data.frame.octree_back(copy.copy(octree)), run.metadata())
    written = in_units.save(run.folder / run_folder.DISTILLED, config.storage)
    run.results["distilled"] = {"seconds": time.perf_counter() - started, "leaves": octree.n_leaves,
                                "MB": written / 1e6, "lost_on_training_views_db": report.lost_db}  # fmt: skip
    run.results["field"] |= summary(score_views(field.picture, data.compared, background))
    run.results["distilled"] |= summary(evaluate(distilled, data.compared, background))
    return octree


@dataclass(frozen=True, eq=False)
class SplatPlan:
    """What splats that an octree is made of will be trained on and how; bytes: of memory next to the program meanwhile; leaves:
    of their octree, at most about; stage: its level and the factor of the photographs' reduction, None: as its settings say."""

    photographs: Photographs
    schedule: Schedule
    bytes: int
    leaves: int
    stage: tuple[int, int] | None


def planned_splats(run: Run) -> SplatPlan | None:
    """As :func:`prepare_splats`; None, with a sentence, where nobody asked for splats and there can be none."""
    try:
        return prepare_splats(run)
    except InputError as error:
        if run.given.init != "auto" or run.phase == "splats":
            raise
        run.without_first()
        run.say(f"start: low density, for there can be no splats first: {error}")
        return None


def prepare_splats(run: Run) -> SplatPlan:
    """The photographs and the schedule of splats that an octree is made of.

    Raises:
        InputError: the lens of a view cannot be undone, or they do not fit in the memory at hand.
    """
    from nerfvol.training.convert import LOOKS, evenly, small_cameras
    from nerfvol.training.splat_start import make_schedule_of

    dataset, settings, kept = run.data.training, run.config.splats, run.data.held_out_bytes
    second = second_background(dataset, run.background, bool(settings.two_backgrounds))
    photographs = Photographs(dataset, run.background, most_bytes=photographs_bytes(), second=second)
    for message in photographs.messages:
        run.say(message)
    schedule = make_schedule_of(run, photographs)
    splat_memory(dataset, photographs, schedule, settings, kept)
    lenses = [camera.intrinsics for camera in evenly(small_cameras(dataset.cameras, dataset.scene), LOOKS)]
    looked_at = sum(lens.width * lens.height for lens in lenses)
    stage, leaves = _how_fine(run, schedule.most)
    used = starting_splats_bytes(dataset, photographs, schedule, settings, kept, looked_at, leaves)
    return SplatPlan(photographs, schedule, used, leaves, stage)


def _how_fine(run: Run, splats: int) -> tuple[tuple[int, int] | None, int]:
    """The stage of an octree that at most so many ``splats`` become, level of its finest leaves and factor of the pictures'
    reduction, None: as its settings say; and about how many leaves it begins with. As fine as there are rays and memory for."""
    from nerfvol.training.splat_start import start_share

    scene, cameras, left = run.data.training.scene, run.data.training.cameras, run.seconds_left()
    lens, most = cameras[0].intrinsics, photographs_bytes() or math.inf
    pixels = lens.width * lens.height
    if run.data.training.kind == "room":  # one view shows a part of what is all around
        pixels = max(pixels, int(4 * math.pi * lens.fx * lens.fy))

    def leaves(factor: int) -> int:
        return surface_leaves(splats, pixels // factor**2, scene.is_unbounded)

    if has_stages_of_its_own(run.given.octree):
        return None, leaves(1)
    seconds = None if left is None else (1 - start_share(scene)) * left
    stage = stage_for(scene, cameras, run.config.octree, seconds, lambda factor: SURFACE_BYTES * leaves(factor) <= most)
    return stage, leaves(stage[1] if stage else 1)


def start_from_splats(
    run: Run, plan: SplatPlan, appearance: Appearance, asked: Appearance, optimise: Optimise
) -> Octree | None:
    """Trains splats; the octree of the surfaces that pictures of them show, and the scores of both among the run's results.

    None, with a sentence, where nobody asked for splats and they show no surfaces: low density is left to begin with.

    appearance: of the splats' photographs. asked: of the octree's: they go on with the splats' colour maps where these have
    some; else splats tell whether exposures differ, in a sixth of the time that the octree would take to draw all views.

    Raises:
        InputError: splats were asked for, and none lies in the scene's region, or none is seen.
    """
    from nerfvol.training.convert import surfaces_of
    from nerfvol.training.splat_start import StartingSplats, settings_of, start_share, start_splats

    config, background, data = run.config, run.background, run.data
    scene = data.training.scene
    splats, distance = start_splats(run, plan.photographs, plan.schedule.most)
    trainer = StartingSplats(
        plan.photographs, splats, settings_of(config), plan.schedule, distance, background, config.seed, appearance,
        share=start_share(scene),
    )  # fmt: skip
    optimise(run, trainer)
    seconds, steps = run.phase_seconds(), trainer.steps_done
    if scene.is_unbounded and appearance.decided:
        asked.go_on_from(appearance)
    elif not asked.active and asked.due(MOMENTS[0]):
        asked.fit(partial(small_picture, data.training, picture=trainer.picture), MOMENTS[0])
    model = trainer.take_model({})
    del trainer
    started, cameras = time.perf_counter(), data.training.cameras
    level, factor = plan.stage or (None, 1)
    cameras = [camera.scaled(factor) for camera in cameras]
    most_level = min(MOST_LEVEL, max(config.octree.levels))  # where no level is planned
    try:
        octree = surfaces_of(model.splats, scene, cameras, background, level, most_level)
    except InputError as error:
        if run.given.init != "auto":
            raise
        run.without_first()
        run.say(f"start: low density, for the splats became no octree: {error}")
        return None
    converted = OctreeModel(octree, run.metadata())
    took = time.perf_counter() - started
    run.say(f"{model.packed.n:,} splats became {octree.n_leaves:,} leaves in {took:.1f} s")
    rows = {"splats": (model, seconds, None), "converted": (converted, took, octree.n_leaves)}
    for name, (made, spent, leaves) in rows.items():
        run.results[name] = {"seconds": spent, "leaves": leaves, "MB": made.describe()["bytes_in_memory"] / 1e6,
                             **summary(evaluate(made, data.compared, background))}  # fmt: skip
    run.results["splats"]["steps"] = steps
    if plan.stage is not None:
        run.results["converted"] |= {"level": level, "images": factor}
    return_free_memory()
    return octree


def settings_of_octree(run: Run) -> OctreeConfig:
    """The octree's settings; where it began with surfaces of photographs, with the one stage that there is time for.

    Raises:
        InputError: a checkpoint that names no such stage.
    """
    stage = stage_in(run.results) if run.config.init == "splats" else None
    return run.config.octree if stage is None else with_stage(run.config.octree, *stage)


def summary(scores: dict[str, Any]) -> dict[str, Any]:
    """Means of the scores, without the rows."""
    return {key: scores[key] for key in (*MEANS, "seconds_per_frame") if key in scores}
