"""The training run, from top to bottom: data, (field or splats first,) octree, or splats, or a field or a medium alone,
scores.

Without a time budget a run is a fixed number of steps and no clock is read for anything but the log and the moments of
checkpoints: the same seed gives the same bits, for any number of threads, stopped and resumed or not. With a budget,
progress is the share of the time that is over, and every phase ends with the best it has.

A checkpoint holds all that lives between two steps. It is written after the first step of a phase, every
``config.checkpoint_every`` seconds and on Ctrl-C, under a temporary name: kill -9 costs at most that interval.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfvol import __version__
from nerfvol.config.training import Config
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.atomic import remove_leftovers, write_json
from nerfvol.files.checkpoint import save_checkpoint
from nerfvol.files.lock import only_writer
from nerfvol.kernels import ops
from nerfvol.machine import describe_hardware, keep_large_arrays_apart, peak_memory, return_free_memory
from nerfvol.measure.scores import COLOUR_MAPS, evaluate
from nerfvol.medium.lighting import load_lighting
from nerfvol.models import Model, load_model
from nerfvol.native import need_torch
from nerfvol.starts.exposures import measure_exposures
from nerfvol.starts.fog import low_density_octree
from nerfvol.training.appearance import Appearance
from nerfvol.training.backgrounds import second_background
from nerfvol.training.clock import Clock
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
    SplatPlan,
    planned_splats,
    settings_of_octree,
    start_from_field,
    start_from_splats,
    summary,
    why_start,
)
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.phase import FinalPhase, Phase
from nerfvol.training.photograph_table import write_table
from nerfvol.training.prepare import check_folder, load_data, require_same
from nerfvol.training.refined import write_refined
from nerfvol.training.saved import read_saved
from nerfvol.training.scoring import affordable_scores
from nerfvol.training.session import Run, Say, Watch
from nerfvol.training.splat_trainer import SplatTrainer

if TYPE_CHECKING:
    from nerfvol.training.medium_trainer import MediumTrainer

PRODUCT = {
    "octree": run_folder.OCTREE, "splats": run_folder.SPLATS, "field": run_folder.FIELD, "medium": run_folder.MEDIUM,
}  # fmt: skip
WHY = {
    "octree": "an object without surroundings, or asked for by --init",
    "splats": "photographs, which splats draw sharper and sooner, or asked for by --init",
    "medium": "--light tells the light",
}
MakeBar = Callable[[str, float], Any]
"""A phase's name and what is done of it, 0 to 1 -> a bar with tqdm's ``update`` and ``set_postfix_str``."""
MEASURED_FROM = 1.0
"""Seconds for each photograph from which on exposures are measured before training: that takes 0.02 to 0.08 s of each."""
LOG_EVERY = 50
"""Steps between two lines of the log."""


@dataclass(frozen=True)
class Results:
    """What a run came to. model: its file; metrics: what metrics.json holds; size: of the model, in words; compared: the
    parts of views on which the rows of metrics["results"] were scored, in words."""

    folder: Path
    model: Path
    metrics: dict[str, Any]
    size: str
    compared: str


def train(
    config: Config,
    started: float | None = None,
    say: Say | None = None,
    bar: MakeBar | None = None,
    watch: Watch | None = None,
) -> Results | None:
    """One training run as ``config`` says, in the folder ``config.out``.

    Args:
        config: all settings; with ``resume`` the run goes on from its checkpoint.
        started: moment (``time.perf_counter``) at which the time budget begins; default: the start of the process.
        say: gets each sentence that a person should see; default: prints it.
        bar: makes what shows the progress of a phase, from its name and what is done of it; default: :func:`progress_bar`.
        watch: called after every step with the run, its phase and whether the step began a stage; must change nothing.

    Returns:
        what the run came to; None where a resumed run was finished already.

    Raises:
        InputError: data that cannot be used, too little memory, a full disk, a scene that collapses to empty space.
        KeyboardInterrupt: Ctrl-C, after the step was finished and a checkpoint written.
    """
    say = say or functools.partial(print, flush=True)
    keep_large_arrays_apart()
    out = check_folder(config)
    try:
        with only_writer(out, "trains"):
            for folder in (out, out / run_folder.PREVIEWS):
                remove_leftovers(folder)
            return _train(config, out, started, say, bar, watch)
    except InputError:
        with contextlib.suppress(OSError):  # a folder made for nothing; one that holds something stays
            out.rmdir()
        raise


def _train(
    config: Config, out: Path, started: float | None, say: Say, bar: MakeBar | None, watch: Watch | None
) -> Results | None:
    saved = read_saved(out / run_folder.CHECKPOINT) if config.resume else None
    if saved is not None and saved["phase"] == "done":
        say(f"{out} is finished ({saved['steps']} steps), there is nothing to resume; its settings can be run again "
            f"with --config {out / run_folder.CONFIG}")  # fmt: skip
        return None
    clock = Clock(started, saved["elapsed"] if saved else 0.0)
    data = load_data(config, say)
    require_same(saved, data, out / run_folder.CHECKPOINT)
    run = Run(config, data, clock, saved, say)
    run.watch = watch
    with run.interruptible(), run:
        if run.config.light is None and len({camera.light for camera in data.training.cameras}) > 1:
            run.say("the views are taken under several lights, of which one picture is made: --light FILE fits a medium that "
                    "can be lit anew")  # fmt: skip
        begin = {"octree": begin_octree, "splats": begin_splats, "field": begin_field, "medium": begin_medium}
        phase: FinalPhase = begin[run.config.representation](run)
        optimise(run, phase, bar)
        appearance = phase.appearance
        if data.training.scene.is_unbounded:
            run.say(write_table(run.folder / run_folder.PHOTOGRAPHS, data.training, phase))
        data.training.release()
        if appearance.active:
            run.say(appearance.sentence())
        if (refined := phase.refined()) is not None:
            run.say(write_refined(run.folder / run_folder.REFINED, refined, data.frame))
        metadata = {COLOUR_MAPS: True} if appearance.active else {}
        trained: list[Model] = [phase.take_model(run.metadata() | metadata)]
        del phase
        return finish(run, trained)


# ------------------------------------------------------------------ what is trained
def begin_octree(run: Run) -> OctreeTrainer:
    """The trainer of an octree: from low density, or from a field or splats that are trained first."""
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


def begin_splats(run: Run) -> SplatTrainer:
    """The trainer of splats: from what suits the data, a field of few views first, or what ``init`` asks for."""
    from nerfvol.training.splat_start import make_schedule_of, start_splats

    config, dataset = run.config, run.data.training
    second = second_background(dataset, run.background, bool(config.splats.two_backgrounds))
    photographs = Photographs(dataset, run.background, most_bytes=photographs_bytes(), second=second)
    for message in photographs.messages:
        run.say(message)
    schedule, kept = make_schedule_of(run, photographs), run.data.held_out_bytes
    first = field_backgrounds(config, dataset) if config.init == "mlp" and run.phase != "splats" else 0
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


# ------------------------------------------------------------------ the loop
def optimise(run: Run, phase: Phase, make_bar: MakeBar | None = None) -> None:
    """Steps until the phase is over, with all that goes on around them."""
    run.enter(phase)
    progress = run.progress(phase)
    with (make_bar or progress_bar)(phase.name, progress) as bar:
        while progress < 1:
            stage = phase.stage
            report = phase.step(progress)
            run.follow(phase, report.squared_error)
            before, progress = progress, run.progress(phase)
            run.claim(phase)
            run.keep_time(phase)
            if phase.steps_done % LOG_EVERY == 0 or progress >= 1:
                run.log(phase, progress, report)
            bar.set_postfix_str(run.status(phase, report), refresh=False)
            bar.update(min(progress, 1.0) - before)
            for moment in phase.previews:
                if before < moment <= progress:
                    run.preview(phase, moment)
            if run.interrupted:
                run.save(phase)
                raise run.interruption(phase)
            if phase.stage != stage:
                run.enter_stage(phase)
            if run.checkpoint_due():
                run.save_if_possible(phase)
            if run.watch is not None:
                run.watch(run, phase, phase.stage != stage)
    if (sentence := phase.outcome()) is not None:
        run.say(sentence)
    if phase.stages_left:
        run.say(f"the {phase.name} ended {phase.stages_left} stage(s) before the finest; a longer run would sharpen it")


def finish(run: Run, trained: list[Model]) -> Results:
    """Writes the model, scores what was written, writes the scores. ``trained`` is emptied: its memory is needed."""
    run.claim(None)
    config, seconds = run.config, run.phase_seconds()
    path = run.folder / PRODUCT[config.representation]
    written = run.in_scene_units(trained.pop()).save(path, config.storage)
    return_free_memory()
    model = load_model(path)
    frame = run.data.frame
    scores = affordable_scores(run, model, frame.dataset_back(run.data.held_out))
    counts = _counts(model)
    row = {"seconds": seconds, "steps": run.steps[model.kind], "leaves": None, "MB": written / 1e6, **counts}
    if run.results:
        run.results["fine_tuned"] = row | summary(
            evaluate(model, frame.dataset_back(run.data.compared), run.background)
        )
    lens = run.data.held_out.cameras[-1].intrinsics
    metrics = {
        **summary(scores), "n_images": len(scores["rows"]), "split": "val", "image_size": [lens.width, lens.height],
        "background": list(run.background), "downscale": config.downscale, "seconds": run.clock.elapsed(),
        "steps": run.steps, "representation": model.kind, **counts, "MB": written / 1e6,
        "storage": config.storage, "init": config.init, "seed": config.seed, "time_budget": config.time_budget,
        "data": config.data, "threads": ops.get_threads(), "hardware": describe_hardware(),
        "peak_memory_MB": (peak_memory() or 0) / 1e6, "nerfvol": __version__, "results": run.results,
        "rows": scores["rows"],
    }  # fmt: skip
    write_json(run.folder / run_folder.METRICS, metrics)
    save_checkpoint(run.checkpoint, {"phase": "done", "steps": sum(run.steps.values())})
    few = run.data.compared.cameras[-1].intrinsics
    size = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    return Results(run.folder, path, metrics, size, f"middle {few.width}x{few.height} of {len(run.data.compared)}")


# ------------------------------------------------------------------ small things
def _counts(model: Model) -> dict[str, int]:
    """What the model is made of, by name."""
    described = model.describe()
    return {name: described[name] for name in ("leaves", "vertices", "splats", "parameters") if name in described}


def progress_bar(name: str, done: float) -> Any:
    """A bar from 0 to 1 with an estimate of the time left; nothing where the output is no terminal."""
    if sys.stderr is None or not sys.stderr.isatty():
        return _NoBar()
    from tqdm import tqdm  # what it imports takes as long as a tenth of the training of a few seconds

    shape = "{desc} {percentage:3.0f}% |{bar:20}| {elapsed}<{remaining} {postfix}"
    return tqdm(total=1.0, initial=done, desc=name, bar_format=shape, smoothing=0.05, disable=None)


class _NoBar(contextlib.AbstractContextManager["_NoBar"]):
    """What :func:`optimise` asks of a bar, without one."""

    def __exit__(self, *failure: object) -> None:
        pass

    def set_postfix_str(self, text: str, refresh: bool = True) -> None:
        """Nothing."""

    def update(self, more: float) -> None:
        """Nothing."""
