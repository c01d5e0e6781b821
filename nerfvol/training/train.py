"""The training run, from top to bottom: data, (field, distillation,) octree, scores.

Without a time budget a run is a fixed number of steps and no clock is read for anything but the log and the moments of
checkpoints: the same seed gives the same bits, for any number of threads, stopped and resumed or not. With a budget,
progress is the share of the time that is over, and every stage ends with the best it has.

A checkpoint holds all that lives between two steps. It is written every ``config.checkpoint_every`` seconds and on
Ctrl-C, under a temporary name: kill -9 costs at most that interval.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nerfvol import __version__
from nerfvol.cameras.camera import Camera
from nerfvol.config.training import Config
from nerfvol.files import run_folder
from nerfvol.files.atomic import write_json
from nerfvol.files.checkpoint import save_checkpoint
from nerfvol.kernels import ops
from nerfvol.machine import describe_hardware, keep_large_arrays_apart, peak_memory, return_free_memory
from nerfvol.measure.scores import evaluate_octree, score_views
from nerfvol.octree.io import load_octree, save_octree
from nerfvol.octree.tree import Octree
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.session import Clock, Run, read_saved
from nerfvol.views import render_image

FEWEST_STEPS = 5000
"""Of the octree, before a run with a time budget may end early, however few its tiles."""
LOG_EVERY = 50
"""Steps between two lines of the log."""


def train(config: Config, started: float | None = None) -> Path:
    """One training run as ``config`` says, in the folder ``config.out``, which it returns.

    Args:
        config: all settings; with ``resume`` the run goes on from its checkpoint.
        started: moment (``time.perf_counter``) at which the time budget begins; default: the start of the process.

    Raises:
        InputError: data that cannot be used, too little memory, a full disk, a scene that collapses to empty space.
        KeyboardInterrupt: Ctrl-C, after the step was finished and a checkpoint written.
    """
    keep_large_arrays_apart()
    out = Path(config.out)
    saved = read_saved(out / run_folder.CHECKPOINT) if config.resume else None
    if saved is not None and saved["phase"] == "done":
        print(f"{out} is finished ({saved['steps']} steps), there is nothing to resume; its settings can be run anew "
              f"with --config {out / run_folder.CONFIG}")  # fmt: skip
        return out
    run = Run(config, Clock(started, saved["elapsed"] if saved else 0.0), saved)
    with run.interruptible(), run.open_log():
        from_field = config.init == "mlp" and run.phase in ("start", "field")
        phase = OctreePhase(run, start_from_field(run) if from_field else None)
        optimise(run, phase)
        finish(run, phase)
    return out


# ------------------------------------------------------------------ the loop
def optimise(run: Run, phase: FieldPhase | OctreePhase) -> None:
    """Steps until the phase is over, with all that goes on beside them."""
    run.enter(phase)
    progress = run.progress(phase)
    with progress_bar(phase.name, progress) as bar:
        while progress < 1:
            stage = phase.stage
            error, samples = phase.step(progress)
            run.follow(phase, error)
            before, progress = progress, run.progress(phase)
            if phase.steps_done % LOG_EVERY == 0 or progress >= 1:
                run.log(phase, progress, error, samples)
            bar.set_postfix_str(run.status(phase, error, samples), refresh=False)
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
                run.save(phase)
    if phase.stages_left:
        print(f"the {phase.name} ended {phase.stages_left} stage(s) before the finest; a longer run would sharpen it")


def start_from_field(run: Run) -> Octree:
    """Trains the field and distils it."""
    phase = FieldPhase(run)
    optimise(run, phase)
    return distil_field(run, phase)


def distil_field(run: Run, phase: FieldPhase) -> Octree:
    """The field as an octree, with the scores of both; says what was lost."""
    from nerfvol.starts.field import distill

    config, background = run.config, run.config.background
    run.stages["field"] = {"seconds": run.phase_seconds(), "steps": phase.steps_done, "leaves": None,
                           "MB": phase.parameter_bytes / 1e6}  # fmt: skip
    settings = dataclasses.replace(
        config.distill, level=min(config.distill.level, max(config.octree.levels)), sh_degree=config.octree.sh_degree
    )
    started = time.perf_counter()
    octree, report = distill(
        phase.trainer.trained_field(), phase.trainer.domain, run.dataset, background, settings, phase.picture
    )
    for message in report.messages:
        print(message)
    print(report, flush=True)
    written = save_octree(run.folder / run_folder.DISTILLED, octree, run.metadata(), config.storage)
    run.stages["distilled"] = {"seconds": time.perf_counter() - started, "leaves": octree.n_leaves,
                               "MB": written / 1e6, "lost_on_training_views_db": report.lost_db}  # fmt: skip
    few = run.comparison_views
    run.stages["field"] |= summary(score_views(phase.picture, few, background))
    run.stages["distilled"] |= summary(evaluate_octree(octree, few, background))
    return octree


def finish(run: Run, phase: OctreePhase) -> None:
    """Writes the octree, scores what was written, writes the scores."""
    config, path = run.config, run.folder / run_folder.OCTREE
    seconds = run.phase_seconds()
    written = save_octree(path, phase.take_octree(), run.metadata(), config.storage)
    return_free_memory()
    stored, _ = load_octree(path)
    scores = evaluate_octree(stored, run.held_out, config.background)
    row = {"seconds": seconds, "steps": run.steps["octree"], "leaves": stored.n_leaves, "MB": written / 1e6}
    if run.stages:
        run.stages["fine_tuned"] = row | summary(evaluate_octree(stored, run.comparison_views, config.background))
    lens = run.held_out.cameras[-1].intrinsics
    metrics = {
        **summary(scores), "n_images": len(scores["rows"]), "split": "val", "image_size": [lens.width, lens.height],
        "background": list(config.background), "downscale": config.downscale, "seconds": run.clock.elapsed(),
        "steps": run.steps, "leaves": stored.n_leaves, "vertices": stored.n_vertices, "MB": written / 1e6,
        "storage": config.storage, "init": config.init, "seed": config.seed, "time_budget": config.time_budget,
        "data": config.data, "threads": ops.get_threads(), "hardware": describe_hardware(),
        "peak_memory_MB": (peak_memory() or 0) / 1e6, "nerfvol": __version__, "stages": run.stages,
        "rows": scores["rows"],
    }  # fmt: skip
    write_json(run.folder / run_folder.METRICS, metrics)
    save_checkpoint(run.checkpoint, {"phase": "done", "steps": sum(run.steps.values())})
    print_table(run, metrics)


# ------------------------------------------------------------------ what is optimised
class FieldPhase:
    """The field, before it is distilled."""

    name = "field"
    previews = (0.1, 0.4, 1.0)
    preview_width = 100  # a field renders slowly
    stages_left = n_leaves = n_vertices = 0
    most_steps = math.inf

    def __init__(self, run: Run) -> None:
        from nerfvol.training.field_trainer import FieldTrainer

        ops.set_threads(ops.get_threads())  # torch was loaded only now
        self.trainer = FieldTrainer(run.dataset, run.config.field, run.config.seed, run.config.background)
        self.steps, self.stage = run.config.field.steps, 0

    @property
    def steps_done(self) -> int:
        return self.trainer.steps_done

    @property
    def parameter_bytes(self) -> int:
        """Bytes of the network."""
        return sum(p.numel() * p.element_size() for p in self.trainer.field.parameters())

    def step(self, progress: float) -> tuple[float, float]:
        """Squared error and samples per ray of one step."""
        report = self.trainer.step(progress)
        return 10 ** (-report["psnr"] / 10), report["samples_per_ray"]

    def picture(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) as the camera sees the field."""
        import torch

        rays_o, rays_d = (torch.from_numpy(a) for a in camera.rays())
        lens = camera.intrinsics
        return self.trainer.render(rays_o, rays_d)["rgb"].numpy().reshape(lens.height, lens.width, 3)

    def size(self) -> str:
        return f"{self.trainer.n_rays} rays"


class OctreePhase:
    """The octree, from a thin start or from a distilled field."""

    name = "octree"
    previews = (0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
    preview_width = 200

    def __init__(self, run: Run, octree: Octree | None) -> None:
        config = run.config
        self.background, self.steps = config.background, config.octree.steps
        drawn = (
            config.octree.rich_share * config.octree.tiles[-1] if config.octree.rich_share else config.octree.tiles[-1]
        )
        self.most_steps = max(FEWEST_STEPS, config.octree.most_epochs * run.rich_tiles / drawn)
        self.trainer = OctreeTrainer(run.dataset, config.background, config.octree, config.seed, octree)
        self.trainer.max_leaves = run.max_leaves

    @property
    def steps_done(self) -> int:
        return self.trainer.step_count

    @property
    def stage(self) -> int:
        return self.trainer.stage

    @property
    def stages_left(self) -> int:
        return len(self.trainer.config.levels) - 1 - self.trainer.stage

    def step(self, progress: float) -> tuple[float, float]:
        """Squared error and samples per ray of one step."""
        report = self.trainer.step(progress)
        return report.squared_error, report.samples

    def picture(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) as the camera sees the leaves: averages would be made anew for each picture."""
        return render_image(self.trainer.octree, camera, self.background, outputs=("rgb",), lod=0.0)["rgb"]

    def take_octree(self) -> Octree:
        """The finished octree; tiles, moments and statistics are let go."""
        octree = self.trainer.finish()
        del self.trainer
        return_free_memory()
        return octree

    @property
    def n_leaves(self) -> int:
        return self.trainer.octree.n_leaves

    @property
    def n_vertices(self) -> int:
        return self.trainer.octree.n_vertices

    def size(self) -> str:
        return f"{self.n_leaves:,} leaves"


# ------------------------------------------------------------------ small things
def progress_bar(name: str, done: float) -> tqdm[Any]:
    """A bar from 0 to 1 with an estimate of the time left; nothing where the output is no terminal."""
    shape = "{desc} {percentage:3.0f}% |{bar:20}| {elapsed}<{remaining} {postfix}"
    return tqdm(total=1.0, initial=done, desc=name, bar_format=shape, smoothing=0.05, disable=None)


def summary(scores: dict[str, Any]) -> dict[str, Any]:
    """Means of the scores, without the rows."""
    return {key: scores[key] for key in ("psnr", "ssim", "seconds_per_frame")}


def print_table(run: Run, metrics: dict[str, Any]) -> None:
    """What the run came to, in a few lines."""
    if run.stages:
        few = run.comparison_views
        lens = few.cameras[-1].intrinsics
        views = f"middle {lens.width}x{lens.height} of {len(few)}"
        print(f"\n{views:21s}PSNR    SSIM   seconds     leaves      MB   s/frame")
        for name, row in run.stages.items():
            leaves = "" if row["leaves"] is None else f"{row['leaves']:,}"
            print(f"{name.replace('_', '-'):18s} {row['psnr']:6.2f}  {row['ssim']:.4f} {row['seconds']:9.1f} "
                  f"{leaves:>10s} {row['MB']:7.1f} {row['seconds_per_frame']:9.4f}")  # fmt: skip
    background = ",".join(f"{c:g}" for c in metrics["background"])
    print(f"\n{metrics['n_images']} held-out views on background {background}: PSNR {metrics['psnr']:.2f} dB, "
          f"SSIM {metrics['ssim']:.4f}; {metrics['leaves']:,} leaves, {metrics['MB']:.1f} MB, "
          f"{metrics['seconds_per_frame']:.3f} s per frame, {metrics['seconds']:.0f} s in all", flush=True)  # fmt: skip
