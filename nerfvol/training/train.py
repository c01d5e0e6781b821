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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfvol import __version__
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.atomic import remove_leftovers, write_json
from nerfvol.files.checkpoint import save_checkpoint
from nerfvol.files.lock import only_writer
from nerfvol.kernels import ops
from nerfvol.machine import describe_hardware, keep_large_arrays_apart, peak_memory, return_free_memory
from nerfvol.measure.scores import COLOUR_MAPS, evaluate
from nerfvol.models import Model, load_model
from nerfvol.training.begin import begin_field, begin_medium, begin_octree, begin_splats
from nerfvol.training.clock import Clock
from nerfvol.training.octree_start import summary
from nerfvol.training.phase import FinalPhase, Phase
from nerfvol.training.photograph_table import write_table
from nerfvol.training.prepare import check_folder, load_data, require_same
from nerfvol.training.progress import MakeBar, progress_bar
from nerfvol.training.refined import write_refined
from nerfvol.training.saved import read_saved
from nerfvol.training.scoring import affordable_scores
from nerfvol.training.session import Run, Say, Watch

PRODUCT = {
    "octree": run_folder.OCTREE, "splats": run_folder.SPLATS, "field": run_folder.FIELD, "medium": run_folder.MEDIUM,
}  # fmt: skip
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
        before = functools.partial(optimise, make_bar=bar)
        begin = {
            "octree": functools.partial(begin_octree, optimise=before),
            "splats": functools.partial(begin_splats, optimise=before),
            "field": begin_field,
            "medium": begin_medium,
        }
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
