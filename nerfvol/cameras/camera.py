"""Cameras: with intrinsics.py the only place that knows axes, pixel centres, lens distortion and that ray directions have unit
length.

Conventions, for the whole package:

- Arrays here are numpy. ``c2w`` is a camera-to-world 4x4 float64 matrix in OpenGL axes: x right, y up, looking down -z.
- Pixel (i, j) is column i, row j; it covers [i, i+1) x [j, j+1) and is sampled at its centre (i + 1/2, j + 1/2), so
  that the principal point of a perfectly centred camera is (width / 2, height / 2) and averaging k x k pixels divides
  it by k. (COLMAP, instant-ngp and NeRF-synthetic all mean this; OpenCV's own calibration puts centres at integers:
  add 1/2 to its cx, cy.)
- Rays are o + t d with |d| = 1: t is a distance in scene units.
- Rays of an image are listed row by row: ray j * width + i belongs to pixel (i, j).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.cameras.intrinsics import Intrinsics as Intrinsics
from nerfvol.cameras.pose import look_at, orbit_axes, rigid_pose
from nerfvol.errors import InputError

Float = NDArray[np.float64]

TILE_SIDE = 8


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics and a rigid pose, and the name of the light that the picture was taken under, where there are several.

    ``c2w`` (4, 4) or (3, 4) must be a rotation and a translation: its 3x3 part orthonormal and right-handed to within
    5e-3, as tools that write three decimals leave it; it is then replaced by the nearest exact rotation so that
    |d| = 1 holds to rounding. Scaled, mirrored, sheared and non-finite poses raise InputError.
    """

    intrinsics: Intrinsics
    c2w: Float
    light: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "c2w", rigid_pose(self.c2w))

    @property
    def position(self) -> Float:
        """(3,) the camera's centre in the world."""
        return self.c2w[:3, 3]

    @property
    def forward(self) -> Float:
        """(3,) unit viewing direction in the world."""
        return -self.c2w[:3, 2]

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The common origin (3,) and unit directions (height * width, 3) of the image's rays, row by row, float32."""
        rotation = self.c2w[:3, :3].astype(np.float32)
        return self.c2w[:3, 3].astype(np.float32), self.intrinsics.directions().reshape(-1, 3) @ rotation.T

    def rays_at(self, pixels: ArrayLike) -> tuple[Float, Float]:
        """The origin (3,) and unit directions (n, 3) through image positions (n, 2), in float64."""
        return self.c2w[:3, 3].copy(), self.intrinsics.directions_at(pixels) @ self.c2w[:3, :3].T

    def project(self, points: ArrayLike) -> Float:
        """Image positions (n, 2), in pixels, of world points (n, 3); NaN where the lens cannot see the point."""
        return self.intrinsics.project((np.asarray(points, dtype=np.float64) - self.c2w[:3, 3]) @ self.c2w[:3, :3])

    def scaled(self, k: int) -> Camera:
        """The camera of the image area-averaged over k x k blocks."""
        return self.through(self.intrinsics.scaled(k))

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the image at another size (see Intrinsics.resized)."""
        return self.through(self.intrinsics.resized(width, height))

    def through(self, intrinsics: Intrinsics) -> Camera:
        """The camera at its place with other intrinsics: the pose, which was found rigid, is not looked at again."""
        camera = object.__new__(Camera)
        for name, value in (("intrinsics", intrinsics), ("c2w", self.c2w), ("light", self.light)):
            object.__setattr__(camera, name, value)
        return camera


def tile_pixels(width: int, height: int) -> NDArray[np.int64]:
    """Flat pixel indices (n_tiles, 64) of an image's 8x8 tiles: row by row, and so inside; -1 outside the image."""
    columns, rows = _tiled(width), _tiled(height)
    inside = (rows[:, None] < height) & (columns[None, :] < width)
    return _in_tiles(np.where(inside, rows[:, None] * width + columns[None, :], -1))


def tile_rays(width: int, height: int) -> NDArray[np.int64]:
    """:func:`tile_pixels` with the image's nearest pixel outside of it: the pixels whose rays pad a tile. One that points
    elsewhere would make a tile as wide as all that lies between, and slow as that (kernels/csrc/packet.h)."""
    columns, rows = np.minimum(_tiled(width), width - 1), np.minimum(_tiled(height), height - 1)
    return _in_tiles(rows[:, None] * width + columns[None, :])


def _tiled(side: int) -> NDArray[np.int64]:
    return np.arange(math.ceil(side / TILE_SIDE) * TILE_SIDE)


def _in_tiles(flat: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows and columns of whole tiles as (n_tiles, 64)."""
    rows, columns = flat.shape
    blocks = flat.reshape(rows // TILE_SIDE, TILE_SIDE, columns // TILE_SIDE, TILE_SIDE)
    return np.ascontiguousarray(blocks.transpose(0, 2, 1, 3)).reshape(-1, TILE_SIDE * TILE_SIDE)


def orbit(
    n: int,
    *,
    center: ArrayLike,
    radius: float,
    elevation_deg: float,
    intrinsics: Intrinsics,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    azimuths: ArrayLike | None = None,
) -> list[Camera]:
    """n cameras evenly spaced on a circle, or at ``azimuths`` (n,), radians, all looking at its middle.

    ``center`` (3,) and ``radius``, the distance to it, are in scene units; ``elevation_deg`` is the angle above the plane
    through ``center`` normal to ``up`` (3,), of any length (-90 < elevation < 90). Azimuth 0, the first camera's on a
    circle, is toward the world axis least aligned with ``up``.

    Raises:
        InputError: no view, no radius, or an elevation at a pole.
    """
    if n < 1 or not radius > 0 or not -90 < elevation_deg < 90:
        raise InputError(
            f"an orbit needs at least one view, a positive radius and an elevation between -90 and 90 degrees, "
            f"got {n}, {radius:g} and {elevation_deg:g}"
        )
    middle = np.asarray(center, dtype=np.float64)
    axis, start, side = orbit_axes(up)
    elevation = math.radians(elevation_deg)
    cameras = []
    for azimuth in 2 * math.pi * np.arange(n) / n if azimuths is None else np.asarray(azimuths, np.float64):
        outward = math.cos(azimuth) * start + math.sin(azimuth) * side
        eye = middle + radius * (math.cos(elevation) * outward + math.sin(elevation) * axis)
        cameras.append(Camera(intrinsics, look_at(eye, middle, axis)))
    return cameras
