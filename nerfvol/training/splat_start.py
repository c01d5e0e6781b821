"""What the splats of a run begin with, and the schedule that its seconds allow; and splats that are an octree's start."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from nerfvol.config.splats import SplatConfig
from nerfvol.config.training import Config
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.kernels.splat_state import SplatState
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds
from nerfvol.splats.splats import Splats
from nerfvol.starts.choose import STARTS, choose_start
from nerfvol.starts.cloud import splats_of_cloud
from nerfvol.starts.subject import subject_of
from nerfvol.starts.surfels import surfels
from nerfvol.starts.visible import JUDGING_VIEWS, judged_downscale, largest_weights
from nerfvol.training.field_phase import FIELD_SHARE
from nerfvol.training.session import Run
from nerfvol.training.splat_schedule import SECONDS_PER_STEP, Schedule, make_schedule, saved_schedule
from nerfvol.training.splat_trainer import SplatTrainer

OPACITIES = {"random": 0.3, "hull": 0.8}
"""Random points are mostly nowhere: they begin fainter than points that were found (0.5); what silhouettes leave is opaque."""


START_SHARE, START_SHARE_OF_PHOTOGRAPHS = 0.25, 0.18
"""Of the time left in a run, what splats take that an octree is made of, ..."""
START_STEPS = 700
"""... and their steps, at most, where there is no time budget."""
SECONDS_TO_CONVERT = 3.0
"""Kept for the end of a run while such splats are trained: the octree of their surfaces, and what that takes to be written."""


class StartingSplats(SplatTrainer):
    """Splats that an octree is made of: they leave most of the time to it."""

    def __init__(self, *arguments: Any, share: float) -> None:
        """``arguments``: SplatTrainer's; ``share``: of the time left that is theirs."""
        super().__init__(*arguments)
        self.share = share

    def share_of(self, seconds: float) -> float:
        """Their share of the time left."""
        return self.share * seconds

    def seconds_to_write(self) -> float:
        """Their octree comes first."""
        return SECONDS_TO_CONVERT


def start_share(scene: SceneBounds) -> float:
    """The share of the time that splats have that an octree of ``scene`` is made of."""
    return START_SHARE_OF_PHOTOGRAPHS if scene.is_unbounded else START_SHARE


def settings_of(config: Config) -> SplatConfig:
    """Those of the run's splats: where they are a start, START_STEPS at most."""
    if config.representation != "octree":
        return config.splats
    return dataclasses.replace(config.splats, steps=min(config.splats.steps, START_STEPS))


def make_schedule_of(run: Run, photographs: Photographs) -> Schedule:
    """The schedule of the seconds that the run has left for splats, or of their steps; a resumed run's is the checkpoint's."""
    config = run.config
    if run.phase == "splats":
        with _saved_of(run) as saved:
            return saved_schedule(saved)
    left = run.seconds_left()
    share = start_share(run.data.training.scene) if config.representation == "octree" else 1.0
    from_field = config.representation == "splats" and config.init == "mlp"
    if from_field and left is not None:
        left -= min(config.field.time_budget, FIELD_SHARE * left)
    seconds = settings_of(config).steps * SECONDS_PER_STEP if left is None else share * left
    sizes = [(camera.intrinsics.width, camera.intrinsics.height) for camera in photographs.cameras]
    schedule = make_schedule(seconds, sizes, run.data.training.scene.is_unbounded, config.splats.max_splats)
    return schedule.of_surfaces() if from_field else schedule


@contextlib.contextmanager
def _saved_of(run: Run) -> Iterator[dict[str, Any]]:
    """The trainer's state in the checkpoint; InputError where what is looked up in it is not there or does not fit."""
    try:
        yield run.saved["trainer"]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{run.checkpoint} does not fit the splats of this run: {error}") from error


def start_splats(run: Run, photographs: Photographs, most: int, octree: Octree | None = None) -> tuple[Splats, float]:
    """The splats to begin with, at most ``most`` of points; and the median camera's distance to the subject, scene units.

    ``octree``: what a field was distilled to that they are to begin with; None: there is none.

    Raises:
        InputError: the start that ``init`` names is unknown or finds nothing.
    """
    config, dataset = run.config, run.data.training
    degree = config.splats.sh_degree or 0
    if run.phase == "splats":  # the checkpoint has them
        with _saved_of(run) as saved:
            return SplatState.from_arrays(saved).splats(), float(saved["subject_distance"])
    if octree is not None:
        discs = _discs_on(run, octree, most).with_sh_degree(degree)
        run.say(f"start: {discs.n:,} discs on what is seen of the {octree.n_leaves:,} leaves")
        return discs, subject_of(dataset).distance
    init = "auto" if config.representation == "octree" else config.init
    if init not in ("auto", *STARTS):
        return _from_file(run, init, degree, most), subject_of(dataset).distance
    start = choose_start(dataset, photographs, None if init == "auto" else init, config.seed)
    run.say(start.sentence)
    opacity = OPACITIES.get(start.name, 0.5)
    distance, cloud = start.subject.distance, start.cloud
    if len(cloud) > most:
        cloud = cloud[np.sort(np.random.default_rng(config.seed).permutation(len(cloud))[:most])]
        run.say(f"{most:,} of these points are taken: as many splats as this run may have")
    return splats_of_cloud(cloud, photographs.cameras, distance, degree, config.splats.mode, opacity), distance


def _from_file(run: Run, path: str, degree: int, most: int) -> Splats:
    """The splats of a file or run folder; of an octree discs on what the training views see of it, at most ``most``."""
    from nerfvol.models import load_model
    from nerfvol.views import OctreeModel, SplatModel

    model, config = load_model(path), run.config
    if isinstance(model, OctreeModel):
        splats = _discs_on(run, model.octree, most)
        run.say(f"start: {splats.n:,} discs on what is seen of the {model.octree.n_leaves:,} leaves of {path}")
        return splats.with_sh_degree(degree)
    if not isinstance(model, SplatModel):
        raise InputError(f"--init {path}: expected splats or an octree, it is a model of {model.kind}")
    n, limit = model.packed.n, config.splats.max_splats
    if not n or (limit is not None and n > limit):
        raise InputError(f"--init {path}: it has {n:,} splats, expected 1 to {limit or 'any number':,}")
    run.say(f"start: the {n:,} splats of {path}")
    return run.data.frame.splats_into(model.splats.with_sh_degree(degree))


def _discs_on(run: Run, octree: Octree, most: int) -> Splats:
    """Discs, at most ``most``, on the leaves of ``octree`` that the training views see."""
    seen = run.data.training.evenly(2 * JUDGING_VIEWS)
    weights = largest_weights(octree, seen, run.background, judged_downscale(seen))
    return surfels(octree, weights, most, run.config.splats.mode)
