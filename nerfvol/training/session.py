"""What surrounds the steps of a training run: its data, clock, log, checkpoints and previews.

Nothing here changes a number of the result, save that the clock ends the phases of a run that has a time budget.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from nerfvol.cameras.paths import describe_orbit
from nerfvol.config.training import Config
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.atomic import ensure_writable_folder
from nerfvol.files.checkpoint import save_checkpoint
from nerfvol.kernels.state import StepReport
from nerfvol.machine import return_free_memory
from nerfvol.medium.model import MediumModel
from nerfvol.models import Model
from nerfvol.neural import FieldModel
from nerfvol.training.clock import Clock, first_signal_noted
from nerfvol.training.compiled_field import compiled_refusal
from nerfvol.training.finishing import seconds_to_finish, seconds_to_score
from nerfvol.training.phase import Phase
from nerfvol.training.prepare import Data, claim_folder, is_simulated
from nerfvol.training.previews import Previews
from nerfvol.training.saved import field_begun
from nerfvol.views import OctreeModel, SplatModel

LOOK_AGAIN = 0.08
"""Of a time budget: as often, at most, is the time to finish estimated anew because a representation has grown."""
RUNNING = 0.98
"""Memory, per step, of the running error."""

BECAME = {"splats": "converted", "field": "distilled"}
"""Phases before the octree, and the row of the results that says that they became one."""

Say = Callable[[str], object]
Watch = Callable[["Run", Phase, bool], object]
"""Sees a run, its phase after a step, and whether that step began a stage."""


class Run:
    """A run's data, log, checkpoints and clock; nothing here changes a number of the result.

    say: what is told to a person goes through it, a sentence a call.
    """

    def __init__(
        self, config: Config, data: Data, clock: Clock, saved: dict[str, Any] | None, say: Say = print
    ) -> None:
        self.given, self.data = config, data
        self.saved = saved or {"phase": "start", "log_bytes": 0, "results": {}, "steps": {}}
        self.phase: str = self.saved["phase"]
        self.results: dict[str, Any] = self.saved["results"]
        self.steps: dict[str, int] = self.saved["steps"]
        self.folder = Path(config.out)
        self.checkpoint = self.folder / run_folder.CHECKPOINT
        begun = set(self.steps)
        if self.phase in ("octree", "splats"):  # what became no octree left them to begin with something else
            lost = {first for first, became in BECAME.items() if became not in self.results}
            begun -= lost - {self.phase}
        self.config = self._settled(begun)
        self.background: tuple[float, float, float] = self.config.background or WHITE
        self.clock, self.say = clock, say
        self.phase_started, self.running = 0.0, math.nan
        self.interrupted = False
        self.watch: Watch | None = None
        self._claimed = False
        self._log: BinaryIO | None = None
        self._entered = False  # a phase, without a step since
        self._scoring: float | None = None  # seconds that a view's scores take, once they were measured
        self._reserve = self._time_to_finish()
        self._looked, self._size_then = self.clock.elapsed(), ""
        self._last_save = time.perf_counter()
        self._warned: set[str] = set()
        self._previews = Previews(
            self.folder / run_folder.PREVIEWS, data.first, self.background, self.config.time_budget
        )

    def _settled(self, begun: Collection[str]) -> Config:
        """The settings as given, with those that the data decide; ``begun``: the phases that were begun before."""
        config, scene, cameras = self.given, self.data.training.scene, self.data.training.cameras
        sides = sorted(min(c.intrinsics.width, c.intrinsics.height) for c in cameras)
        side = sides[len(sides) // 2]
        if compiled_refusal(config.field) is None:  # in torch a field takes minutes and knows nothing of few views
            config = config.for_views(len(cameras), scene, is_simulated(config.data), begun, side)
            config = config.for_field(len(cameras), scene, field_begun(self.saved, self.checkpoint))
        suited = config.for_scene(scene).for_pictures(side)
        return suited.before(self.data.training.backdrop)

    def without_first(self) -> None:
        """What was to begin as splats or a field, and nobody asked for it, begins with something else, an octree with low
        density: there can be none."""
        self.config = self._settled((self.config.representation,))

    def enter(self, phase: Phase) -> None:
        """Begin the phase, or go on inside it where the checkpoint was written in it.

        Raises:
            InputError: what the checkpoint holds does not fit the phase.
        """
        resumed = self.saved["phase"] == phase.name
        if resumed:
            try:
                phase.load_state_dict(self.saved["trainer"])
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise InputError(f"{self.checkpoint} does not fit the {phase.name} of this run: {error}") from error
            self.phase_started, self.running = self.saved["phase_started"], self.saved["running"]
            self.say(f"resumed at step {phase.steps_done} of the {phase.name}")
        else:
            self.phase_started, self.running = self.clock.elapsed(), math.nan
        self._entered = not resumed
        self.phase, self.steps[phase.name] = phase.name, phase.steps_done
        self.saved = {"phase": "entered", "log_bytes": self.saved["log_bytes"]}  # releases the old arrays

    def seconds_left(self) -> float | None:
        """Of a time budget, before writing and scoring; None: there is none."""
        budget = self.config.time_budget
        return None if budget is None else max(0.0, budget - self._reserve - self.clock.elapsed())

    def phase_seconds(self) -> float:
        """Seconds of wall clock since the present phase began, over all sessions."""
        return self.clock.elapsed() - self.phase_started

    def progress(self, phase: Phase) -> float:
        """How much of the phase is over; 1: it ends."""
        budget = self.config.time_budget
        if budget is None:
            return phase.steps_done / phase.steps
        left = budget - self._reserve - self.phase_started
        share = phase.share_of(left)
        return max(self.phase_seconds() / share, phase.steps_done / phase.most_steps) if share > 0 else 1.0

    def follow(self, phase: Phase, error: float) -> None:
        """Keep the running error; InputError where it is no number, before the run reaches a checkpoint."""
        if not math.isfinite(error):
            raise InputError(
                f"the training of the {phase.name} diverged at step {phase.steps_done}: its error is {error}; lower "
                f"the learning rates ({phase.rates})"
            )
        self.running = error if math.isnan(self.running) else RUNNING * self.running + (1 - RUNNING) * error
        self.steps[phase.name] = phase.steps_done

    def status(self, phase: Phase, report: StepReport) -> str:
        """Error, running PSNR and size, for the progress bar."""
        error, samples = report.squared_error, report.samples
        return f"loss {error:.2e}  PSNR {decibels(self.running):.2f}  {samples:.1f} samples/ray  {phase.size()}"

    def log(self, phase: Phase, progress: float, report: StepReport) -> None:
        """One line of the log."""
        line = {
            "phase": phase.name, "step": phase.steps_done, "stage": phase.stage, "progress": round(progress, 6),
            "seconds": round(self.clock.elapsed(), 3), "loss": report.squared_error, "psnr": decibels(self.running),
            "samples_per_ray": report.samples, "size": phase.size(),
        }  # fmt: skip
        if self._log is not None:
            self._log.write(json.dumps(line).encode() + b"\n")
            self._log.flush()

    def claim(self, phase: Phase | None) -> None:
        """Once a phase has made its first step: the folder is this run's, what an earlier run left there is put aside, and a
        first checkpoint is written."""
        if self._log is None:
            self._open_log()
        if phase is not None and self._entered:
            self._entered = False
            self.save(phase)

    def _open_log(self) -> None:
        if not self._claimed:
            claim_folder(self.given)
            self._claimed = True
        path = self.folder / run_folder.LOG
        ensure_writable_folder(self.folder / run_folder.PREVIEWS)
        self._log = path.open("r+b" if path.exists() else "w+b")
        self._log.truncate(min(self.saved["log_bytes"], path.stat().st_size))  # back to where the checkpoint left it
        self._log.seek(0, 2)

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *failure: object) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None

    def checkpoint_due(self) -> bool:
        """Whether the last checkpoint, or the start of this session, is ``checkpoint_every`` seconds ago."""
        return time.perf_counter() - self._last_save >= self.config.checkpoint_every

    def save(self, phase: Phase) -> None:
        """Write a checkpoint from which the run goes on exactly."""
        state = {
            "phase": phase.name, "elapsed": self.clock.elapsed(), "phase_started": self.phase_started,
            "running": self.running, "log_bytes": 0 if self._log is None else self._log.tell(), "results": self.results,
            "steps": self.steps, "trainer": phase.state_dict(), "data": dict(self.data.fingerprint),
        }  # fmt: skip
        save_checkpoint(self.checkpoint, state)
        self.release_images(phase)
        self._last_save = time.perf_counter()

    def save_if_possible(self, phase: Phase) -> None:
        """As :meth:`save`; a disk that is full for a while costs a checkpoint and a sentence, not the run."""
        try:
            self.save(phase)
        except InputError as error:
            self._last_save = time.perf_counter()
            self.warn(f"{error}; the run goes on without this checkpoint")

    def warn(self, sentence: str) -> None:
        """Say it once, however often it happens."""
        if sentence not in self._warned:
            self._warned.add(sentence)
            self.say(f"warning: {sentence}")

    def enter_stage(self, phase: Phase) -> None:
        """What a change of the phase's stage brings: images that are needed no more, another time to finish, more memory."""
        self.release_images(phase)
        return_free_memory()
        if (sentence := phase.outgrown()) is not None:
            self.say(sentence)
        self._look_again(phase)

    def keep_time(self, phase: Phase) -> None:
        """Estimate anew what finishing takes once the representation has another size: an octree may double inside a stage."""
        budget = self.config.time_budget
        if (
            budget is not None
            and self.clock.elapsed() - self._looked >= LOOK_AGAIN * budget
            and phase.size() != self._size_then
        ):
            self._look_again(phase)

    def _look_again(self, phase: Phase) -> None:
        self._reserve = self._time_to_finish(phase)
        self._looked, self._size_then = self.clock.elapsed(), phase.size()

    def release_images(self, phase: Phase) -> None:
        """Release the training images once the phase will not ask for them again."""
        if not phase.needs_images():
            self.data.training.release()

    def preview(self, phase: Phase, moment: float) -> None:
        """The first held-out view, small: truth next to what the phase has. One that cannot be written costs a sentence."""
        try:
            self._previews.add(phase, moment)
        except InputError as error:
            self.warn(f"{error}; the run goes on without this preview")

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """The first signal to end only sets a flag, so that the step in progress is finished (:func:`first_signal_noted`)."""

        def note() -> bool:
            first, self.interrupted = not self.interrupted, True
            if first:
                self.say("\nfinishing the step and saving (again: stop at once)")
            return first

        with first_signal_noted(note):
            yield

    def interruption(self, phase: Phase) -> KeyboardInterrupt:
        """What to raise once a checkpoint was written after Ctrl-C; says where the run is and how to go on."""
        place = f"step {phase.steps_done} of the {phase.name}"
        self.say(f"saved at {place}; to go on: nerfvol train --resume --out {self.folder}")
        return KeyboardInterrupt()

    def metadata(self) -> dict[str, Any]:
        """What the octree file says of itself; no clock and no machine in it, so that equal runs write equal files."""
        config = self.config
        provenance = {"data": config.data, "init": config.init, "seed": config.seed, "downscale": config.downscale,
                      "steps": dict(self.steps), "time_budget": config.time_budget}  # fmt: skip
        orbit = describe_orbit(self.data.training.cameras, self.data.training.scene.aabb)
        orbit = self.data.frame.orbit_back(orbit)
        return {"provenance": provenance, "background": list(self.background), "orbit": orbit}

    def in_scene_units(self, model: Model) -> Model:
        """A model that was trained, in the units of the poses."""
        frame = self.data.frame
        if isinstance(model, OctreeModel):
            return OctreeModel(frame.octree_back(model.octree), model.metadata)
        if isinstance(model, FieldModel):
            return FieldModel(model.field, model.metadata, frame.shift, frame.scale)
        if isinstance(model, MediumModel):
            return model.moved(frame.shift, frame.scale)
        if frame.is_identity or not isinstance(model, SplatModel):
            return model
        return SplatModel(frame.splats_back(model.splats), {**model.metadata, "near": model.near * frame.scale})

    def _time_to_finish(self, phase: Phase | None = None) -> float:
        if self.config.time_budget is None:
            return 0.0
        if self._scoring is None:
            self._scoring = seconds_to_score(self.data.first.composited(0, self.background))
        return seconds_to_finish(self.config, self.data, self._scoring, phase)


def decibels(squared_error: float) -> float:
    """PSNR of a mean squared error."""
    return -10 * math.log10(max(squared_error, 1e-10))
