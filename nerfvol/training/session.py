"""What surrounds the steps of a training run: its data, clock, log, checkpoints and previews.

Nothing here changes a number of the result, save that the clock ends the phases of a run that has a time budget.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.paths import describe_orbit
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.images import composite_average
from nerfvol.datasets.load import load_dataset
from nerfvol.datasets.tiles import rich_share
from nerfvol.errors import InputError
from nerfvol.files import pictures, run_folder
from nerfvol.files.atomic import ensure_writable_folder
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.kernels import ops
from nerfvol.kernels.state import TILE_RAYS
from nerfvol.machine import process_seconds, return_free_memory
from nerfvol.measure.metrics import ssim
from nerfvol.training.memory import Beside, affordable_leaves, estimate_training, largest_octree

FIELD_SHARE = 0.3
"""Of a time budget, the most that the field gets."""
RESERVE_SHARE = 0.2
"""Of a time budget, the most that is kept for writing and scoring."""
FINISH_SECONDS = 0.5
"""Of writing, beside ..."""
FINISH_SECONDS_PER_LEAF = 1.5e-6
"""... writing and reading an octree in compact storage (two cores of 2023); a run that takes longer ends later."""
HELD_OUT_KEPT = 32 << 20
"""Bytes of held-out images that a run keeps; more are read once again to be scored."""
COMPARED_SIZE = 200
"""Pixels along the middle of a held-out view on which field and octrees are compared: a field takes seconds for so many."""
LARGEST_HELD_OUT = 32
"""Views that a run scores itself on; `nerfvol eval` scores all there are."""
RUNNING = 0.98
"""Memory, per step, of the running error."""


_STATE = {
    "elapsed": float, "phase_started": float, "running": float, "log_bytes": int, "stages": dict, "steps": dict,
    "trainer": dict,
}  # fmt: skip


class Phase(Protocol):
    """What is optimised: the field, the octree."""

    name: str
    steps: int
    most_steps: float
    preview_width: int
    trainer: Any

    @property
    def steps_done(self) -> int: ...

    @property
    def stage(self) -> int: ...

    def picture(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) as the camera sees it."""
        ...

    @property
    def n_leaves(self) -> int:
        """Of the octree that there is so far."""
        ...

    @property
    def n_vertices(self) -> int: ...

    def size(self) -> str:
        """How large the representation is, in words."""
        ...


class Clock:
    """Seconds of wall clock that a run has used, over all its sessions."""

    def __init__(self, started: float | None, spent: float) -> None:
        now = time.perf_counter()
        self._zero = (now - process_seconds() if started is None else started) - spent

    def elapsed(self) -> float:
        return time.perf_counter() - self._zero


def read_saved(path: Path) -> dict[str, Any]:
    """The state in a run's checkpoint, with everything that a continuation looks up in it."""
    state = load_checkpoint(path)
    known = {"done": {"steps"}, "field": _STATE, "octree": _STATE}
    phase = state.get("phase")
    if not (isinstance(phase, str) and phase in known and set(known[phase]) <= state.keys()):
        raise InputError(f"{path} is no checkpoint of a training run")
    for name, kind in _STATE.items() if phase != "done" else ():
        if not isinstance(state[name], kind):
            raise InputError(f"{path} is damaged: its {name} is {state[name]!r}")
    return state


class Run:
    """A run's data, log, checkpoints and clock; nothing here changes a number of the result."""

    def __init__(self, config: Config, clock: Clock, saved: dict[str, Any] | None) -> None:
        self.config, self.clock, self.folder = config, clock, Path(config.out)
        self.checkpoint = self.folder / run_folder.CHECKPOINT
        self.saved = saved or {"phase": "start", "log_bytes": 0, "stages": {}, "steps": {}}
        self.phase: str = self.saved["phase"]
        self.stages: dict[str, Any] = self.saved["stages"]
        self.steps: dict[str, int] = self.saved["steps"]
        self.phase_started, self.running = 0.0, math.nan
        self.interrupted = False
        loading = time.perf_counter()
        self.held_out = load_dataset(config.data, "val", config.downscale).evenly(LARGEST_HELD_OUT)
        self._first = self.held_out.evenly(1)
        self.comparison_views = self.held_out.evenly(config.compare_views).middles(COMPARED_SIZE)
        """Parts of held-out views on which field, distilled and fine-tuned octree are compared."""
        self._loading = 0.0
        if self.held_out.nbytes > HELD_OUT_KEPT:  # else let go until they are scored
            self.held_out.release()
            self._loading = time.perf_counter() - loading
        self.dataset = load_dataset(config.data, "train", config.downscale)
        for message in self.dataset.messages:
            print(message)
        require_something(self.dataset, config.background)
        scene = self.dataset.scene
        self.config = config = dataclasses.replace(
            config, octree=config.octree.for_scene(scene), distill=config.distill.for_scene(scene)
        )
        lens = self.dataset.cameras[0].intrinsics
        self._degree = max(config.octree.sh_degree, config.octree.final_sh_degree)
        share = rich_share(self.dataset, config.background)
        pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in self.dataset.cameras)
        self.rich_tiles = max(share, 0.01) * pixels / TILE_RAYS
        """About so many training tiles are not plain background."""
        held = self.held_out.nbytes or self._first.nbytes + self.comparison_views.nbytes
        self._beside = Beside(share, held, field=config.init == "mlp")
        wanted = largest_octree(config.octree.levels, lens.width * lens.height, scene.is_unbounded)
        self.max_leaves = affordable_leaves(self.dataset, self._degree, least=min(wanted, 1 << 18), beside=self._beside)
        self._reckoned = min(wanted, self.max_leaves)
        estimate = estimate_training(self.dataset, self._reckoned, self._degree, self._beside)
        print(f"{len(self.dataset)} training views of {lens.width}x{lens.height}, {len(self.held_out)} held out; "
              f"memory: {estimate.sentence()}", flush=True)  # fmt: skip
        self.preview_folder = ensure_writable_folder(self.folder / run_folder.PREVIEWS)
        self._reserve = self._time_to_finish()
        self._last_save = time.perf_counter()

    def enter(self, phase: Phase) -> None:
        """Begin the phase, or go on inside it where the checkpoint was written in it."""
        resumed = self.saved["phase"] == phase.name
        if resumed:
            try:
                phase.trainer.load_state_dict(self.saved["trainer"])
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise InputError(f"{self.checkpoint} does not fit the {phase.name} of this run: {error}") from error
            self.phase_started, self.running = self.saved["phase_started"], self.saved["running"]
            print(f"resumed at step {phase.steps_done} of the {phase.name}")
        else:
            self.phase_started, self.running = self.clock.elapsed(), math.nan
        self.phase, self.steps[phase.name] = phase.name, phase.steps_done
        self.saved = {"phase": "entered"}  # lets the old arrays go
        if not resumed:
            self.save(phase)

    def phase_seconds(self) -> float:
        return self.clock.elapsed() - self.phase_started

    def progress(self, phase: Phase) -> float:
        """How much of the phase is over; 1: it ends."""
        budget = self.config.time_budget
        if budget is None:
            return phase.steps_done / phase.steps
        left = budget - self._reserve - self.phase_started
        share = min(self.config.field.time_budget, FIELD_SHARE * left) if phase.name == "field" else left
        return max(self.phase_seconds() / share, phase.steps_done / phase.most_steps) if share > 0 else 1.0

    def follow(self, phase: Phase, error: float) -> None:
        """Keep the running error; a number that is none ends the run before it reaches a checkpoint."""
        if not math.isfinite(error):
            raise InputError(
                f"the training of the {phase.name} diverged at step {phase.steps_done}: its error is {error}; lower "
                "the learning rates (field.learning_rate; octree.rate_density, rate_dc and rate_sh)"
            )
        self.running = error if math.isnan(self.running) else RUNNING * self.running + (1 - RUNNING) * error
        self.steps[phase.name] = phase.steps_done

    def status(self, phase: Phase, error: float, samples: float) -> str:
        return f"loss {error:.2e}  PSNR {decibels(self.running):.2f}  {samples:.1f} samples/ray  {phase.size()}"

    def log(self, phase: Phase, progress: float, error: float, samples: float) -> None:
        line = {
            "phase": phase.name, "step": phase.steps_done, "stage": phase.stage, "progress": round(progress, 6),
            "seconds": round(self.clock.elapsed(), 3), "loss": error, "psnr": decibels(self.running),
            "samples_per_ray": samples, "size": phase.size(),
        }  # fmt: skip
        self._log.write(json.dumps(line).encode() + b"\n")
        self._log.flush()

    @contextlib.contextmanager
    def open_log(self) -> Iterator[BinaryIO]:
        """The log, cut back to where the checkpoint left it."""
        path = self.folder / run_folder.LOG
        with path.open("r+b" if path.exists() else "w+b") as self._log:
            self._log.truncate(min(self.saved["log_bytes"], path.stat().st_size))
            self._log.seek(0, 2)
            yield self._log

    def checkpoint_due(self) -> bool:
        return time.perf_counter() - self._last_save >= self.config.checkpoint_every

    def save(self, phase: Phase) -> None:
        """Write a checkpoint from which the run goes on exactly."""
        state = {
            "phase": phase.name, "elapsed": self.clock.elapsed(), "phase_started": self.phase_started,
            "running": self.running, "log_bytes": self._log.tell(), "stages": self.stages, "steps": self.steps,
            "trainer": phase.trainer.state_dict(),
        }  # fmt: skip
        save_checkpoint(self.checkpoint, state)
        self.release_images(phase)
        self._last_save = time.perf_counter()

    def enter_stage(self, phase: Phase) -> None:
        """What a change of the phase's stage brings: images that are needed no more, another time to finish.

        And another estimate of the memory, where the octree has more leaves than the first one reckoned with: a surface
        has about so many, a thick medium several times as many.
        """
        self.release_images(phase)
        return_free_memory()
        if phase.n_leaves > self._reckoned:
            self._reckoned = phase.n_leaves
            estimate = estimate_training(self.dataset, self._reckoned, self._degree, self._beside, phase.n_vertices)
            print(f"memory: the octree is larger than was reckoned with; now {estimate.sentence()}", flush=True)
        self._reserve = self._time_to_finish(phase)

    def release_images(self, phase: Phase) -> None:
        """Let go of the training images once the tiles at hand serve to the end."""
        left = self.config.octree.downscales[phase.stage :]
        if phase.name == "octree" and phase.trainer.bank is not None and len(set(left)) == 1:
            self.dataset.release()

    def preview(self, phase: Phase, moment: float) -> None:
        """The first held-out view, small: truth beside what the phase has."""
        camera, image = self._first.cameras[0], self._first.images[0]
        k = max(1, -(-camera.intrinsics.width // phase.preview_width))
        truth = composite_average(image, self.config.background, k).astype(np.float32) / 255
        picture = pictures.side_by_side([truth, phase.picture(camera.scaled(k))])
        pictures.write_png(self.preview_folder / f"{phase.name}_{round(100 * moment):03d}.png", picture)

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """The first Ctrl-C only sets a flag, so that the step in progress is finished; a second one ends at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def note(number: int, frame: Any) -> None:
            if self.interrupted:
                raise KeyboardInterrupt
            self.interrupted = True
            print("\nfinishing the step and saving (again: stop at once)", flush=True)

        before = signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def interruption(self, phase: Phase) -> KeyboardInterrupt:
        place = f"step {phase.steps_done} of the {phase.name}"
        print(f"saved at {place}; to go on: nerfvol train --resume --out {self.folder}", flush=True)
        return KeyboardInterrupt()

    def metadata(self) -> dict[str, Any]:
        """What the octree file says of itself; no clock and no machine in it, so that equal runs write equal files."""
        config = self.config
        provenance = {"data": config.data, "init": config.init, "seed": config.seed, "downscale": config.downscale,
                      "steps": dict(self.steps), "time_budget": config.time_budget}  # fmt: skip
        orbit = describe_orbit(self.dataset.cameras, self.dataset.scene.aabb)
        return {"provenance": provenance, "background": list(config.background), "orbit": orbit}

    def _time_to_finish(self, phase: Phase | None = None) -> float:
        """Seconds to keep for writing, reading the views and scoring.

        Reading took a time at the start, scoring is measured on one view; without a phase, the rest is guessed.
        """
        if self.config.time_budget is None:
            return 0.0
        started = time.perf_counter()
        image = self._first.composited(0, self.config.background)
        ssim(image, image)
        scoring = (time.perf_counter() - started) / ops.get_threads()  # so many views are scored side by side
        started = time.perf_counter()
        if phase is not None:
            phase.picture(self.held_out.cameras[0])
        rendering = 0.1e-6 * image.size / 3 if phase is None else time.perf_counter() - started
        writing = FINISH_SECONDS + FINISH_SECONDS_PER_LEAF * (1_000_000 if phase is None else phase.n_leaves)
        return min(
            writing + self._loading + 1.1 * len(self.held_out) * (scoring + rendering),
            RESERVE_SHARE * self.config.time_budget,
        )


def require_something(dataset: Dataset, background: Sequence[float]) -> None:
    """An InputError where every pixel of every picture has the background's colour: there is nothing to reconstruct."""
    plain = np.round(np.asarray(background) * 255)
    if all((composite_average(image, background, 1) == plain).all() for image in dataset.images):
        colour = ",".join(f"{c:g}" for c in background)
        raise InputError(
            f"{dataset.source}: the training images are empty, nothing in them differs from the background {colour}; "
            "check the images, or choose another --background"
        )


def decibels(squared_error: float) -> float:
    """PSNR of a mean squared error."""
    return -10 * math.log10(max(squared_error, 1e-10))
