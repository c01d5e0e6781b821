"""Small pictures of a run on its way: the first held-out view next to what a phase has of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerfvol.datasets.averages import composite_average
from nerfvol.datasets.dataset import Dataset
from nerfvol.files import pictures
from nerfvol.training.finishing import seconds_of_picture
from nerfvol.training.phase import Phase

PREVIEW_SHARE, PREVIEW_SECONDS = 0.01, 0.08
"""Of a time budget, what previews may take together; and for the first one, before it was measured."""


class Previews:
    """Those of a run, in ``folder``. A time budget (seconds) is for training: what they may take of it is bounded.

    views: whose first is shown, over ``background``.
    """

    def __init__(self, folder: Path, views: Dataset, background: Sequence[float], budget: float | None) -> None:
        self.folder, self.views, self.background, self.budget = folder, views, background, budget
        self._taken, self._cost = 0.0, PREVIEW_SECONDS  # seconds, of all and of the last

    def add(self, phase: Phase, moment: float) -> None:
        """The one at ``moment`` in [0, 1] of ``phase``, unless the budget has no time for it.

        Raises:
            InputError: it cannot be written.
        """
        started = time.perf_counter()
        camera, image = self.views.cameras[0], self.views.images[0]
        k = max(1, -(-camera.intrinsics.width // phase.preview_width))
        if self.budget is not None:
            if phase.timed_at > 1:
                self._cost = seconds_of_picture(phase, camera.scaled(k))
            if self._taken + self._cost > PREVIEW_SHARE * self.budget:
                return
        try:
            truth = np.divide(composite_average(image, self.background, k), 255, dtype=np.float32)
            picture = pictures.side_by_side([truth, phase.picture(camera.scaled(k))])
            pictures.write_png(self.folder / f"{phase.name}_{round(100 * moment):03d}.png", picture)
        finally:
            self._cost = time.perf_counter() - started
            self._taken += self._cost
