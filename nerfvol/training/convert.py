"""One representation from another: splats or a field become an octree, an octree or a field splats, and what that cost is
measured.

Geometry first, from the model alone: leaves around splats (starts/leaves.py), an octree's leaves as Gaussians
(starts/gaussians.py). An octree of splats is then fitted to pictures of them, since Gaussians that overlap are no sum of
densities: no photograph is needed for it. Either may be trained further on the photographs themselves, splats from discs on
what is seen (starts/surfels.py).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.config.field import DistillConfig
from nerfvol.config.octree import OctreeConfig
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.dataset import evenly as even_places
from nerfvol.datasets.frame import Frame
from nerfvol.datasets.images import map_threads
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.machine import process_seconds
from nerfvol.measure.scores import evaluate
from nerfvol.models import Model
from nerfvol.neural import FieldModel
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds, cube
from nerfvol.splats.splats import Splats
from nerfvol.starts.field import distill
from nerfvol.starts.leaves import octree_around
from nerfvol.starts.subject import subject_of
from nerfvol.starts.surfaces import Seen, write_surfaces
from nerfvol.starts.surfels import surfels
from nerfvol.starts.visible import judged_downscale, largest_weights, thickness
from nerfvol.training.backgrounds import second_background
from nerfvol.training.finishing import LARGEST_RESERVE, seconds_of_picture, seconds_to_score
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.phase import FinalPhase
from nerfvol.training.splat_schedule import SECONDS_PER_STEP, make_schedule
from nerfvol.training.splat_trainer import SplatTrainer
from nerfvol.training.surface_stages import MOST_LEVEL, finest_level, stage_for, with_stage
from nerfvol.views import SplatModel

MOST_DISCS = 100_000
"""Surfels of an octree where nobody says how many."""
FITTED_VIEWS, FITTED_VIEWS_OF_OBJECTS = 100, 50
"""Pictures of the splats that their octree is fitted to, at most."""
FITTED_STEPS = 100
"""Steps of the fit, which begins with the surfaces found (starts/surfaces.py): some one and a half seconds on two cores."""
LEVELLED = 0.03
"""Share of the mean that its second moments begin with: worth 40 steps (docs/experiments.md)."""
LOOKS = 32
"""Pictures that tell surfaces from the free before the fit."""
EMPTY = 0.02
"""Optical thickness along a leaf's side, at its densest corner, below which the leaf is left out before the fit."""
FITTED_PIXELS = 400
"""Longer side, at most, of these pictures; of larger cameras a whole fraction."""
VIRTUAL_VIEWS, VIRTUAL_ANGLE = 64, 0.7
"""Cameras all around a model whose own are not known, and their angle of view, radians."""
FINE_STEPS = 1500
"""Steps on photographs where no time is given."""
LOOK_AGAIN = 0.08
"""Share of a time budget after which what comes after the training is measured anew."""

FIT = {
    "downscales": [1], "stage_ends": [1.0], "tiles": [320], "prunes": [1], "prune_steps": 20, "foreground_share": 0.97,
    "colour_weight": 0.02, "distortion": 0.02, "rate_density": 0.3, "rate_dc": 0.07, "rate_sh": 0.006, "rate_decay": 0.1,
    "decay_from": 0.2, "growing_error": 0.0, "tv_from": 0, "prune_weight": 0.005, "early_stop_eps": 0.02,
}  # fmt: skip
"""Settings of the fit: one stage, and rates that fall from a fifth of it on."""

Say = Callable[[str], object]
T = TypeVar("T")


def cameras_around(model: Model) -> list[Camera]:
    """VIRTUAL_VIEWS cameras evenly over the sphere around a model's box (Fibonacci's spiral), looking at its middle."""
    low, high = model.aabb()
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    if not radius > 0:
        raise InputError("the model has no extent, so no camera can be put around it")
    focal = FITTED_PIXELS / 2 / math.tan(VIRTUAL_ANGLE / 2)
    lens = Intrinsics(FITTED_PIXELS, FITTED_PIXELS, focal, focal, FITTED_PIXELS / 2, FITTED_PIXELS / 2)
    k = np.arange(VIRTUAL_VIEWS) + 0.5
    z, turn = 1 - 2 * k / VIRTUAL_VIEWS, k * math.pi * (1 + math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    distance = 1.05 * radius / math.sin(VIRTUAL_ANGLE / 2)
    return [Camera(lens, look_at(middle + distance * d, middle, (0.0, 0.0, 1.0))) for d in directions]


def seen_by(model: Model, cameras: Sequence[Camera], scene: SceneBounds, background: Sequence[float]) -> Dataset:
    """Pictures of a model as a dataset: what ``cameras`` see of it over ``background``, uint8."""
    images = [_bytes_of(model.render(camera, background)["rgb"]) for camera in cameras]
    return _dataset(cameras, images, scene, model.kind)


def _bytes_of(picture: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def _dataset(cameras: Sequence[Camera], images: list[NDArray[np.uint8]], scene: SceneBounds, kind: str) -> Dataset:
    names = [f"view_{i:03d}" for i in range(len(cameras))]
    return Dataset(list(cameras), images, names, scene, f"pictures of {kind}")


def scene_around(model: Model) -> SceneBounds:
    """The region of a model alone: the smallest cube around its box, with a margin."""
    low, high = model.aabb()
    return SceneBounds(cube((low + high) / 2, 0.51 * float((high - low).max())), None, False)


def small_cameras(cameras: Sequence[Camera], scene: SceneBounds) -> list[Camera]:
    """As many of these as an octree is fitted to, evenly chosen, of about FITTED_PIXELS pixels."""
    most = FITTED_VIEWS if scene.is_unbounded else FITTED_VIEWS_OF_OBJECTS
    longest = max(max(c.intrinsics.width, c.intrinsics.height) for c in cameras)
    factor = max(1, -(-longest // FITTED_PIXELS))
    return [camera.scaled(factor) if factor > 1 else camera for camera in evenly(cameras, most)]


def evenly(items: Sequence[T], most: int) -> list[T]:
    """At most ``most`` of these, the first and the last among them."""
    return [items[i] for i in even_places(len(items), min(len(items), most))]


def octree_of(
    splats: Splats, scene: SceneBounds, cameras: Sequence[Camera], background: Sequence[float],
    level: int | None = None, seed: int = 0,
) -> Octree:  # fmt: skip
    """The octree of splats: leaves around them, fitted to small pictures of them as ``cameras`` without their lenses see them.

    level: of the finest leaves, along the scene's inner cube; None: :func:`finest_level`.

    Raises:
        InputError: no splat lies in the scene's region, or none is seen.
    """
    frame = Frame.of(scene)
    if not frame.is_identity:  # float32 tells no rays of map coordinates apart
        octree = octree_of(*_moved(frame, splats, scene, cameras), background, level, seed)
        return frame.octree_back(octree)
    level = finest_level(scene, cameras) if level is None else level
    fitted = [_without_lens(camera) for camera in small_cameras(cameras, scene)]
    views, images = looked_at(SplatModel(splats), fitted, background)
    octree = _with_surfaces(octree_around(splats, scene, cameras, level), views)
    seen = _dataset(fitted, images, scene, SplatModel.kind)
    trainer = OctreeTrainer(seen, background, OctreeConfig(levels=[level], steps=FITTED_STEPS, **FIT), seed, octree)
    for step in range(FITTED_STEPS):
        trainer.step(step / FITTED_STEPS)
        if step == 0:
            trainer.state.level_moments(LEVELLED)
    return trainer.octree


def surfaces_of(
    splats: Splats, scene: SceneBounds, cameras: Sequence[Camera], background: Sequence[float], level: int | None = None,
    most_level: int = MOST_LEVEL,
) -> Octree:  # fmt: skip
    """The octree of splats before any fit: leaves around them, dense where the cameras see surfaces and nowhere else.

    level: as in :func:`octree_of`, which raises the same; None: around photographs one finer, for what is nearer than the
    scene's middle has smaller pixels, and no leaf is finer than those that see it ask for, nor than ``most_level``.
    """
    frame = Frame.of(scene)
    if not frame.is_identity:
        return frame.octree_back(surfaces_of(*_moved(frame, splats, scene, cameras), background, level, most_level))
    if level is None:
        level = min(finest_level(scene, cameras) + scene.is_unbounded, most_level)
    octree = octree_around(splats, scene, cameras, level)
    return _with_surfaces(
        octree, looked_at(SplatModel(splats), evenly(small_cameras(cameras, scene), LOOKS), background)[0]
    )


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


def _moved(
    frame: Frame, splats: Splats, scene: SceneBounds, cameras: Sequence[Camera]
) -> tuple[Splats, SceneBounds, list[Camera]]:
    return frame.splats_into(splats), frame.scene_into(scene), [frame.camera_into(camera) for camera in cameras]


def _with_surfaces(octree: Octree, views: Sequence[Seen]) -> Octree:
    """Of splats as they stand, what ``views`` tell; without the leaves that are empty then. InputError where all are."""
    write_surfaces(octree, views)
    solid = thickness(octree) >= EMPTY
    if not solid.any():
        finest = octree.leaf_sizes().min()
        raise InputError(
            f"none of the splats is seen: they are transparent, or far smaller than the finest leaves ({finest:.3g})"
        )
    return octree.prune(solid)[0]


def looked_at(
    model: Model, cameras: Sequence[Camera], background: Sequence[float]
) -> tuple[list[Seen], list[NDArray[np.uint8]]]:
    """What LOOKS of ``cameras`` see of a model, with distances, as pinholes; and what all of them see over ``background``."""
    looks = set(evenly(range(len(cameras)), LOOKS))

    def look(i: int) -> tuple[Seen | None, NDArray[np.uint8]]:
        camera = _without_lens(cameras[i])
        outputs = ("rgb", "opacity", "median_depth") if i in looks else ("rgb",)
        image = model.render(camera, background, outputs)
        if i not in looks:
            return None, _bytes_of(image["rgb"])
        opacity = image["opacity"]
        through = (1 - opacity)[..., None] * np.asarray(background, np.float32)
        rgb = (image["rgb"] - through) / np.maximum(opacity, 1 / 255)[..., None]
        return Seen(camera, rgb, opacity, image["median_depth"]), _bytes_of(image["rgb"])

    # One picture is drawn while another is worked over.
    made = map_threads(look, range(len(cameras)), 2)
    return [seen for seen, _ in made if seen is not None], [image for _, image in made]


def _without_lens(camera: Camera) -> Camera:
    lens = camera.intrinsics
    return camera.through(Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy))


def octree_of_field(
    model: FieldModel, seen: Dataset, background: Sequence[float], level: int | None = None, say: Say = print
) -> Octree:
    """The octree that a field is distilled to (starts/field.py); ``seen``: pictures of it, which say what is visible.

    level: of the finest leaves, along the inner cube; None: as in training on many views.

    Raises:
        InputError: the field is empty, or nothing of it is seen.
    """
    frame = Frame(model.origin, model.scale)
    config = DistillConfig(level=level)
    octree, report = distill(model.field, model.domain, frame.dataset_into(seen), background, config)
    for message in report.messages:
        say(message)
    return frame.octree_back(octree)


def discs_of(octree: Octree, seen: Dataset, background: Sequence[float], most: int | None = None) -> Splats:
    """The surfels of what ``seen``'s cameras see of an octree, at most ``most`` (MOST_DISCS): what a training begins with.

    Raises:
        InputError: they see none of it.
    """
    return surfels(octree, largest_weights(octree, seen, background, judged_downscale(seen)), most or MOST_DISCS)


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
    settings = config.for_views(len(dataset), dataset.scene).splats.for_scene(dataset.scene)
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


def cost(a: Model, b: Model, views: Dataset, background: Sequence[float]) -> tuple[float, float]:
    """PSNR of both models on ``views``, dB."""
    first, second = (evaluate(model, views, background)["psnr"] for model in (a, b))
    return cast(float, first), cast(float, second)
