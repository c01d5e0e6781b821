"""How fine an octree begins and ends that begins with surfaces: as fine as there are rays for.

Every leaf that a picture's pixels ask for is there from the start, and a leaf that no ray meets stays what splats said of it.
So photographs are looked at in the size of which the run can draw each pixel about once, and leaves are as wide as those
pixels: of photographs of 12 million pixels a minute sees an eighth of the size, of small ones all there is. Of cut-out objects
most is background, and they are looked at as they are.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.config.octree import FINEST_LEVEL, OctreeConfig
from nerfvol.errors import InputError
from nerfvol.kernels.state import TILE_RAYS
from nerfvol.region import SceneBounds
from nerfvol.starts.leaves import PIXELS

MOST_LEVEL = 10
"""Of the leaves that are asked for where nobody says how fine; one more where rays suffice (levels_finer)."""
RAYS_PER_SECOND, RAYS_PER_SECOND_OF_OBJECTS = 400_000.0, 1_200_000.0
"""What a second of a time budget is worth: rays of an octree of surfaces on two cores, some 10 segments each in photographs."""
EPOCHS = 1.0
"""Times that each pixel of the photographs is drawn, at least, in the size that is chosen."""
EPOCHS_OF_FINER = 3.0
"""... from which on leaves a level finer pay than the scene's middle asks for: what is nearer has smaller pixels (fern, 7
times: 24.83 to 25.13 dB; bonsai, 1.2 times: 24.30 to 24.10, for fewer steps were left)."""
SMALLEST = 100
"""Pixels along the longer side, at least, of the reduced photographs."""
MOST_FACTOR = 256
STAGE = {"stage_ends": [1.0], "tiles": [320], "prunes": [2]}
"""All of the run: there is no haze that small pictures would have to clear first."""


def finest_level(scene: SceneBounds, cameras: Sequence[Camera]) -> int:
    """Level whose leaves are about PIXELS wide at the scene's middle for the nearest camera, at most MOST_LEVEL."""
    pixel = min(
        float(np.linalg.norm(c.position - scene.center)) / max(c.intrinsics.fx, c.intrinsics.fy) for c in cameras
    )
    # A camera may stand in the middle: in a room, or where all photographs are taken from one place.
    pixel = max(pixel, 4.0**-MOST_LEVEL * scene.side)
    return int(np.clip(round(math.log2(scene.side / (PIXELS * pixel))), 5, MOST_LEVEL))


def stage_for(
    scene: SceneBounds, cameras: Sequence[Camera], config: OctreeConfig, seconds: float | None,
    fits: Callable[[int], bool] = lambda factor: True,
) -> tuple[int, int] | None:  # fmt: skip
    """The one stage of an octree of surfaces that is trained for ``seconds`` (None: the steps of ``config``): level of its
    finest leaves and factor of the photographs' reduction. None: the stages of the settings, for an object that there is time
    to look at more often.

    cameras: of the whole photographs. fits: whether there is memory for leaves of photographs reduced by a factor; they are
    reduced until there is, or to a pixel.
    """
    rays = rays_of(config, seconds, scene.is_unbounded)
    if not scene.is_unbounded:
        return None if levels_finer(cameras, rays) else (finest_level(scene, cameras), 1)
    factor = image_factor(cameras, rays)
    shortest = min(min(camera.intrinsics.width, camera.intrinsics.height) for camera in cameras)
    while not fits(factor) and factor < MOST_FACTOR and shortest >= 2 * factor:
        factor *= 2
    cameras = [camera.scaled(factor) for camera in cameras]
    return finest_level(scene, cameras) + levels_finer(cameras, rays), factor


def image_factor(cameras: Sequence[Camera], rays: float) -> int:
    """The power of two by which photographs are reduced of which a run can draw ``rays`` rays."""
    pixels = _pixels(cameras)
    longest = max(max(camera.intrinsics.width, camera.intrinsics.height) for camera in cameras)
    factor = 1
    while rays * factor**2 < EPOCHS * pixels and longest >= 2 * SMALLEST * factor:
        factor *= 2
    return factor


def levels_finer(cameras: Sequence[Camera], rays: float) -> int:
    """1 where ``rays`` rays see the pixels of the reduced ``cameras`` often enough for leaves a level finer; else 0."""
    return int(rays >= EPOCHS_OF_FINER * _pixels(cameras))


def _pixels(cameras: Sequence[Camera]) -> int:
    return sum(camera.intrinsics.width * camera.intrinsics.height for camera in cameras)


def rays_of(config: OctreeConfig, seconds: float | None, photographs: bool = True) -> float:
    """Rays that ``seconds`` are worth, of an object or of ``photographs``; None: those of the settings' steps."""
    if seconds is None:
        return config.steps * config.tiles[-1] * TILE_RAYS
    return (RAYS_PER_SECOND if photographs else RAYS_PER_SECOND_OF_OBJECTS) * seconds


def has_stages_of_its_own(given: OctreeConfig) -> bool:
    """Whether somebody chose stages."""
    plain = OctreeConfig()
    return any(getattr(given, name) != getattr(plain, name) for name in ("levels", "downscales", *STAGE))


def with_stage(config: OctreeConfig, level: int, factor: int) -> OctreeConfig:
    """The same with one stage: leaves of ``level`` at most, photographs reduced by ``factor``."""
    return dataclasses.replace(config, levels=[level], downscales=[factor], **STAGE)


def stage_in(results: Mapping[str, Any]) -> tuple[int, int] | None:
    """Level and factor as a run's results keep them; None where its octree has the stages of the settings.

    Raises:
        InputError: they are no such numbers.
    """
    row = results.get("converted")
    if row is None or row.get("images") is None:
        return None
    level, factor = row.get("level"), row["images"]
    if not (isinstance(level, int) and isinstance(factor, int) and 1 <= level <= FINEST_LEVEL and factor >= 1):
        raise InputError(f"the checkpoint's octree has leaves of level {level!r} and images /{factor!r}")
    if factor & (factor - 1) or factor > MOST_FACTOR:
        raise InputError(
            f"the checkpoint's octree is trained on images /{factor}, expected a power of two up to {MOST_FACTOR}"
        )
    return level, factor
