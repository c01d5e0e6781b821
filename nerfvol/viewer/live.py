"""A model on its way: what a viewer shows of a training run, a new edition after each stage and every few seconds.

The training is not stopped for it: a copy is taken between two steps, which takes a tenth of a second, and encoded in a
thread of its own, which takes a share of one core.
"""

from __future__ import annotations

import copy
import threading
import time
from typing import Any

from nerfvol.models import Model
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.phase import Phase
from nerfvol.training.session import Run, decibels
from nerfvol.training.splat_trainer import SplatTrainer
from nerfvol.viewer.shown import Shown
from nerfvol.views import OctreeModel, SplatModel

EVERY = 20.0
"""Seconds between editions."""


class Live:
    """Watches a run (training.train's ``watch``) and publishes what it has to ``shown``."""

    def __init__(self, shown: Shown, every: float = EVERY) -> None:
        self.shown, self.every = shown, every
        self._thread: threading.Thread | None = None
        self._last, self._due = -float("inf"), False

    def __call__(self, run: Run, phase: Phase, began_stage: bool) -> None:
        """After a step: publishes where it is time to, and the last edition is out; then waits as long as somebody who looks
        has paused the training, which is no training time."""
        self._publish(run, phase, began_stage)
        if self.shown.paused:
            started = time.perf_counter()
            self.shown.wait_while_paused(lambda: run.interrupted)
            run.clock.exclude(time.perf_counter() - started)

    def _publish(self, run: Run, phase: Phase, began_stage: bool) -> None:
        self._due |= began_stage or time.monotonic() - self._last >= self.every
        if not self._due or (self._thread is not None and self._thread.is_alive()):
            return
        model = snapshot(phase, run.metadata())
        if model is None:
            return
        self._due, self._last = False, time.monotonic()
        sentence = f"Training: step {phase.steps_done}, {phase.size()}, running PSNR {decibels(run.running):.1f} dB"
        self._thread = threading.Thread(target=self.shown.publish, args=(model, sentence), daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Waits for the edition that is on its way."""
        if self._thread is not None:
            self._thread.join()


def snapshot(phase: Phase, metadata: dict[str, Any]) -> Model | None:
    """A copy of the model that ``phase`` trains; None where it is none that a page draws (a field)."""
    if isinstance(phase, OctreeTrainer):
        octree = copy.copy(phase.octree)
        octree.values = octree.values.copy()
        return OctreeModel(octree, metadata)
    if isinstance(phase, SplatTrainer):
        return SplatModel(phase.state.splats(), {**metadata, **phase.metadata()})
    return None
