"""A converted model trained further on photographs, in what a time budget leaves or a fixed number of steps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.frame import Frame
from nerfvol.datasets.photographs import Photographs
from nerfvol.machine import process_seconds
from nerfvol.octree.tree import Octree
from nerfvol.splats.splats import Splats
from nerfvol.starts.subject import subject_of
from nerfvol.training.backgrounds import second_background
from nerfvol.training.convert import Say, surfaces_of
from nerfvol.training.finishing import LARGEST_RESERVE, seconds_of_picture, seconds_to_score
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.phase import FinalPhase
from nerfvol.training.splat_schedule import SECONDS_PER_STEP, make_schedule
from nerfvol.training.splat_trainer import SplatTrainer
from nerfvol.training.surface_stages import stage_for, with_stage
from nerfvol.views import SplatModel

FINE_STEPS = 1500
"""Steps on photographs where no time is given."""
LOOK_AGAIN = 0.08
"""Share of a time budget after which what comes after the training is measured anew."""


def surfaces_to_train(
    splats: Splats, dataset: Dataset, background: Sequence[float], config: Config, level: int | None = None
) -> tuple[Octree, Config]:
    """The octree of splats that will be trained on pictures, and ``config`` with its stage: both as fine as its time has
    rays for (training/surface_stages.py), where no ``level`` is asked for."""
    scene, cameras = dataset.scene, dataset.cameras
    if level is None:
        left = None if config.time_budget is None else max(config.time_budget - process_seconds(), 1.0)
        stage = stage_for(scene, cameras, dataclasses.replace(config.octree, steps=FINE_STEPS), left)
        if stage is not None:
            level, factor = stage
            cameras = [camera.scaled(factor) for camera in cameras]
            config = dataclasses.replace(config, octree=with_stage(config.octree, level, factor))
    return surfaces_of(splats, scene, cameras, background, level), config


def tuned_octree(
    octree: Octree, dataset: Dataset, background: Sequence[float], config: Config, scored: int = 0, say: Say = print
) -> Octree:
    """An octree trained further on photographs until ``config.time_budget``, FINE_STEPS steps where there is none.

    The budget counts from the start of the process; writing, and scoring ``scored`` views with both models, lie within it.
    """
    frame = Frame.of(dataset.scene)
    dataset, octree = frame.dataset_into(dataset), frame.octree_into(octree)
    settings = dataclasses.replace(config.octree.from_surfaces(dataset.scene), steps=FINE_STEPS)
    trainer = OctreeTrainer(dataset, background, settings, config.seed, octree)
    _run(trainer, dataset.cameras[0], config.time_budget, scored, say)
    return frame.octree_back(trainer.finish())


def tuned_splats(
    splats: Splats, dataset: Dataset, background: Sequence[float], config: Config, scored: int = 0, say: Say = print
) -> SplatModel:
    """Splats trained further on photographs; as :func:`tuned_octree`."""
    settings = config.for_few_views(len(dataset), dataset.scene).splats.for_scene(dataset.scene)
    second = second_background(dataset, background, bool(settings.two_backgrounds))
    photographs = Photographs(dataset, background, second=second)
    sizes = [(camera.intrinsics.width, camera.intrinsics.height) for camera in photographs.cameras]
    left = None if config.time_budget is None else max(config.time_budget - process_seconds(), 1.0)
    schedule = make_schedule(
        left or FINE_STEPS * SECONDS_PER_STEP, sizes, dataset.scene.is_unbounded, config.splats.max_splats
    )
    schedule = dataclasses.replace(schedule, most=max(schedule.most, splats.n))
    splats = splats.with_sh_degree(settings.sh_degree or 0)
    distance = subject_of(dataset).distance
    trainer = SplatTrainer(photographs, splats, settings, schedule, distance, background, config.seed)
    _run(trainer, dataset.cameras[0], config.time_budget, scored, say)
    return trainer.take_model({})


def _run(phase: FinalPhase, camera: Camera, budget: float | None, scored: int, say: Say) -> None:
    """A phase's steps, one at least: FINE_STEPS, or until the budget; what comes after them is measured on ``camera``: writing,
    drawing ``scored`` views, and their scores, which the model that there was before has too."""
    begun, done, progress, looked, after = process_seconds(), 0, 0.0, -math.inf, 0.0
    lens = camera.intrinsics
    scores = 0.0 if budget is None else 2 * seconds_to_score(np.zeros((lens.height, lens.width, 3), np.float32))
    while progress < 1:
        if budget is not None and process_seconds() - looked >= LOOK_AGAIN * budget:
            looked = process_seconds()
            after = phase.seconds_to_write() + 1.1 * scored * (seconds_of_picture(phase, camera) + scores)
            after = min(after, LARGEST_RESERVE * budget)
        phase.step(progress)
        done += 1
        left = None if budget is None else budget - after - begun
        progress = done / FINE_STEPS if left is None else (process_seconds() - begun) / left if left > 0 else 1.0
    say(f"trained {done} steps on the photographs: {phase.size()}")
    if (sentence := phase.outcome()) is not None:
        say(sentence)
