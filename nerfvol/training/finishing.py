"""How long a run with a time budget will take after its last step: writing, reading the views, scoring them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.config.training import Config
from nerfvol.kernels import ops
from nerfvol.measure.metrics import ssim
from nerfvol.training.appearance import fitting_factor
from nerfvol.training.phase import Phase
from nerfvol.training.prepare import Data

RESERVE_SHARE = 0.1
"""Of a time budget, the most that is kept for writing and scoring, ..."""
LARGEST_RESERVE = 0.5
"""... or this, where writing, reading, the table of photographs and FEWEST_SCORED views, which come in any case, take more."""
FEWEST_SCORED = 2
"""Held-out views that are scored however long they take."""
EXPECTED_SECONDS_TO_WRITE = 2.0
"""Of an octree, before there is one that tells ..."""
SECONDS_TO_WRITE = 0.5
"""... and of all else."""
TABLE_SECONDS = 0.008
"""For a training photograph's row in the table of photographs, besides its small picture; of one of more than ..."""
TABLE_PIXELS = 500_000
"""... so many pixels as much more as it has more of them."""
FIT_SECONDS = 0.5
"""For a held-out view's pose, where cameras are refined."""
BAND, BAND_PIXELS = 32, 1 << 20
"""Rows of a band of a picture of more than so many pixels: as many bands as hold so many tell what the whole one takes. Drawing
a photograph of 12 million pixels to learn that, as often as an octree grows, would take a short run's time."""


def seconds_to_score(image: NDArray[np.float32]) -> float:
    """What scoring a view of this image (H, W, 3) takes: so many views are scored side by side."""
    return _seconds(ssim, image, image) / ops.get_threads()


def seconds_to_finish(config: Config, data: Data, scoring: float, phase: Phase | None = None) -> float:
    """Seconds to keep for writing, reading the views and scoring, of a run with a time budget.

    Reading took a time at the start, ``scoring`` a view was measured, drawing is measured on one view; without a phase, the
    rest is guessed.
    """
    rows = len(data.training) if data.training.scene.is_unbounded else 0
    small = 0.0
    if phase is None:
        rendering = 0.1e-6 * data.first.images[0].size / 3
        writing = EXPECTED_SECONDS_TO_WRITE if config.representation == "octree" else SECONDS_TO_WRITE
    else:
        rendering = seconds_of_picture(phase, data.held_out.cameras[0])
        writing = phase.seconds_to_write()
        if rows:
            camera = data.training.cameras[0]
            lens = camera.intrinsics
            small = seconds_of_picture(phase, camera.scaled(fitting_factor(lens.width, lens.height)))
    pixels = data.first.images[0].size / data.first.images[0].shape[2]
    table = (TABLE_SECONDS * max(1.0, pixels / TABLE_PIXELS) + small) * rows
    if rows and phase is not None and not phase.needs_images():
        table += data.loading  # the photographs were released
    view = scoring + rendering + FIT_SECONDS * config.refine_poses
    all_views, budget = 1.1 * len(data.held_out) * view, config.time_budget or math.inf
    sure = writing + data.reading + table + FEWEST_SCORED * view
    most = min(sure, LARGEST_RESERVE * budget) if phase is not None else 0.0
    return min(writing + data.reading + table + all_views, max(RESERVE_SHARE * budget, most))


def seconds_of_picture(phase: Phase, camera: Camera) -> float:
    """What a picture of the camera takes; see Phase.timed_at."""
    k = min(phase.timed_at, camera.intrinsics.width, camera.intrinsics.height)
    whole = camera.scaled(k)
    bands = bands_of(whole)
    share = sum(band.intrinsics.height for band in bands) / whole.intrinsics.height
    return k * k / share * _seconds(lambda: [phase.picture(band) for band in bands])


def bands_of(camera: Camera) -> list[Camera]:
    """Evenly spaced bands of rows that together have BAND_PIXELS pixels at most; the camera itself where it has no more."""
    lens = camera.intrinsics
    if lens.width * lens.height <= BAND_PIXELS:
        return [camera]
    n = max(1, BAND_PIXELS // (BAND * lens.width))
    rows = min(BAND, lens.height // n)
    tops = (np.arange(n) + 0.5) * (lens.height / n) - rows / 2
    return [camera.through(lens.cropped(0, int(top), lens.width, rows)) for top in tops]


def _seconds(function: Callable[..., object], *arguments: object) -> float:
    started = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - started
