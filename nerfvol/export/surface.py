"""The surface of a model as views of it see it: median depths, for points and meshes of octrees and splats alike.

The views are cameras that are given, such as those of the training, or stand on a sphere around the model's box, evenly
(a Fibonacci lattice). They are drawn without lens distortion over black; colours are what is seen, divided by the opacity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.cameras.lens import PINHOLE
from nerfvol.errors import InputError
from nerfvol.models import Model

Float = NDArray[np.float32]
SEEN = 0.5
"""Opacity from which on half of the light is stopped, so that there is a median depth."""
_ANGLE = math.radians(40.0)
_LARGEST_SIDE = 800
_MOST_VIEWS = 1000


@dataclass(frozen=True)
class Cameras:
    """Cameras, a picture's file name for each, and where they are from."""

    cameras: Sequence[Camera]
    names: Sequence[str]
    source: str = ""


@dataclass(frozen=True)
class Shot:
    """One view. depth (H, W): of the surface along the ray, scene units, 0 where there is none; opacity (H, W); rgb, normal
    (H, W, 3), normals towards the camera."""

    camera: Camera
    depth: Float
    opacity: Float
    rgb: Float
    normal: Float

    def look(self, places: NDArray) -> tuple[NDArray[np.int64], Float, NDArray[np.bool_]]:
        """Of places (n, 3): the flat pixel that shows them (0 where none does), their distance, and whether one does."""
        lens, pose = self.camera.intrinsics, self.camera.c2w
        local = (places - pose[:3, 3]).astype(np.float32) @ pose[:3, :3].astype(np.float32)
        depth = -local[:, 2]
        front = depth > 1e-6
        scale = 1 / np.where(front, depth, 1)
        u, v = lens.fx * local[:, 0] * scale + lens.cx, lens.cy - lens.fy * local[:, 1] * scale
        shown = front & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
        u, v = np.where(shown, u, 0), np.where(shown, v, 0)
        return v.astype(np.int64) * lens.width + u.astype(np.int64), np.linalg.norm(local, axis=1), shown

    def points(self, opacity: float) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Points (n, 3) of the surface where it is at least so opaque, and their flat pixels (n,)."""
        pixels = np.flatnonzero((self.opacity >= max(opacity, SEEN)) & (self.depth > 0))
        origin, directions = self.camera.rays()
        return origin + directions[pixels].astype(np.float64) * self.depth.reshape(-1)[pixels, None], pixels


def shoot(model: Model, views: int, cameras: Cameras | None, resolution: int) -> list[Shot]:
    """``views`` shots: of ``cameras``, evenly chosen, or from a sphere, with about two pixels a voxel.

    Raises:
        InputError: fewer than 2 views or more than 1000, or nothing is opaque enough to have a surface.
    """
    if not 2 <= views <= _MOST_VIEWS:
        raise InputError(f"--views must lie between 2 and {_MOST_VIEWS}, got {views}")
    if cameras is None:
        chosen = _sphere(model, views, min(2 * resolution, _LARGEST_SIDE))
    else:
        every = np.unique(
            np.linspace(0, len(cameras.cameras) - 1, min(views, len(cameras.cameras))).round().astype(int)
        )
        chosen = [_plain(cameras.cameras[i]) for i in every]
    shots = [_shot(model, camera) for camera in chosen]
    if not any((shot.depth > 0).any() for shot in shots):
        raise InputError("no view sees anything that stops half of its light, so there is no surface")
    return shots


def bytes_of_shots(views: int, cameras: Cameras | None, resolution: int) -> int:
    """What :func:`shoot` keeps."""
    side = min(2 * resolution, _LARGEST_SIDE) if cameras is None else _LARGEST_SIDE
    return (views if cameras is None else min(views, len(cameras.cameras))) * side * side * 40


def _plain(camera: Camera) -> Camera:
    lens = replace(camera.intrinsics, lens=PINHOLE)
    share = min(1.0, _LARGEST_SIDE / max(lens.width, lens.height))
    return Camera(lens, camera.c2w).resized(max(1, round(share * lens.width)), max(1, round(share * lens.height)))


def _sphere(model: Model, views: int, side: int) -> list[Camera]:
    low, high = model.aabb()
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    focal = 0.5 * side / math.tan(0.5 * _ANGLE)
    lens = Intrinsics(side, side, focal, focal, 0.5 * side, 0.5 * side)
    distance = reach / math.sin(0.5 * _ANGLE)
    z = 1 - (2 * np.arange(views) + 1) / views
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(views)
    outward = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    up = [np.eye(3)[2] if abs(d[2]) < 0.99 else np.eye(3)[0] for d in outward]
    return [Camera(lens, look_at(middle + distance * d, middle, u)) for d, u in zip(outward, up, strict=True)]


def _shot(model: Model, camera: Camera) -> Shot:
    image = model.render(camera, (0, 0, 0), ("rgb", "opacity", "median_depth", "normal"))
    opacity, median = image["opacity"], image["median_depth"]
    depth = np.where((opacity >= SEEN) & np.isfinite(median), median, 0).astype(np.float32)
    directions = camera.rays()[1].reshape(image["normal"].shape)
    normal = image["normal"] / np.maximum(np.linalg.norm(image["normal"], axis=-1, keepdims=True), 1e-6)
    away = (normal * directions).sum(axis=-1, keepdims=True) > 0
    colour = np.clip(image["rgb"] / np.maximum(opacity, 1e-3)[..., None], 0, 1).astype(np.float32)
    return Shot(
        camera,
        depth,
        opacity,
        np.clip(colour, 0, 1).astype(np.float32),
        np.where(away, -normal, normal).astype(np.float32),
    )
