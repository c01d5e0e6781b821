"""Cameras: the only place that knows axes, pixel centres, lens distortion and that ray directions have unit length.

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

import functools
import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.cameras.lens import LARGEST, PINHOLE, Fisheye, Lens, with_coefficients
from nerfvol.cameras.pose import look_at, orbit_axes, rigid_pose
from nerfvol.errors import InputError

Float = NDArray[np.float64]

TILE_SIDE = 8
_OPENGL = np.array([1.0, -1.0, -1.0])  # OpenCV axes (y down, z forward) to OpenGL axes
_CACHE_BYTES = 256 << 20


def _coefficient(name: str) -> property:
    return property(lambda self: self.lens.coefficients.get(name, 0.0), doc=f"The lens's {name}; 0 where it has none.")


@dataclass(frozen=True, init=False)
class Intrinsics:
    """Projection of camera axes to pixels: size, focal lengths, principal point (all in pixels) and lens.

    The lens is a :class:`~nerfvol.cameras.lens.Lens`, without distortion unless given. Its coefficients may be given and
    read by name here too: ``Intrinsics(..., k1=0.02)`` is a BrownConrady lens, ``Intrinsics(..., k1=0.02, fisheye=True)`` a
    Fisheye lens, and dataclasses.replace takes both.

    Raises:
        InputError: a size below 1x1, focal lengths that are not positive, numbers that are not finite, a coefficient that
            the lens lacks.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens

    def __init__(
        self,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        lens: Lens = PINHOLE,
        **of_lens: float,
    ) -> None:
        if not isinstance(lens, Lens):
            raise TypeError(f"Intrinsics takes a lens, or its coefficients by name, got {lens!r}")
        values = (width, height, fx, fy, cx, cy, with_coefficients(lens, of_lens) if of_lens else lens)
        for field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, field.name, value)
        self._check()

    k1, k2, k3, k4, p1, p2 = map(_coefficient, ("k1", "k2", "k3", "k4", "p1", "p2"))

    @property
    def fisheye(self) -> bool:
        """Whether the lens is a Fisheye."""
        return isinstance(self.lens, Fisheye)

    @property
    def distortion(self) -> tuple[float, ...]:
        """The lens's coefficients in their order; all are 0 for a lens that does nothing to its model."""
        return tuple(self.lens.coefficients.values())

    def _check(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"the image size must be at least 1x1 pixels, got {self.width}x{self.height}")
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not abs(value) < LARGEST:
                raise InputError(f"camera intrinsic {name} must be a finite number, got {value}")
        if not min(self.fx, self.fy) > 1 / LARGEST:
            raise InputError(
                f"the focal lengths must be positive, got fx={self.fx:g}, fy={self.fy:g} (singular intrinsics)"
            )

    def scaled(self, k: int) -> Intrinsics:
        """The camera of an image area-averaged over k x k blocks; rows and columns that fill no block are dropped.

        Raises:
            InputError: k is below 1, or no block fits into the image.
        """
        if k < 1:
            raise InputError(f"the downscale factor must be a positive integer, got {k}")
        width, height = self.width // k, self.height // k
        if width < 1 or height < 1:
            raise InputError(f"a {self.width}x{self.height} image cannot be downscaled by {k}: nothing is left of it")
        return replace(self, width=width, height=height, fx=self.fx / k, fy=self.fy / k, cx=self.cx / k, cy=self.cy / k)

    def cropped(self, left: int, top: int, width: int, height: int) -> Intrinsics:
        """The camera of the part of the image that begins at column ``left`` and row ``top``; all in pixels.

        Raises:
            InputError: the part reaches beyond the image.
        """
        if min(left, top) < 0 or left + width > self.width or top + height > self.height:
            raise InputError(
                f"{width}x{height} pixels from column {left} and row {top} on are no part of a {self.width}x{self.height} image"
            )
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same field of view across the width at another size; another aspect ratio crops or extends the height."""
        s = width / self.width
        cy = height / 2 + s * (self.cy - self.height / 2)
        return replace(self, width=width, height=height, fx=self.fx * s, fy=self.fy * s, cx=self.cx * s, cy=cy)

    def directions(self) -> NDArray[np.float32]:
        """(height, width, 3) float32 unit directions of pixel centres in camera axes; shared, so not to be written."""
        return _directions.get(self)

    def seen(self) -> NDArray[np.bool_] | None:
        """(height, width) bool: the pixels that lie within the lens's reach; None where all do. Others have no ray."""
        return _reaches(self)

    def directions_at(self, pixels: ArrayLike) -> Float:
        """Unit directions (n, 3) float64, camera axes, of positions (n, 2) in pixels; pixel centres end in 1/2.

        Raises:
            InputError: a position beyond the lens's reach, which has no direction.
        """
        return self.lens.undistort(self._plane(pixels)) * _OPENGL

    def directions_where(self, pixels: ArrayLike) -> tuple[Float, NDArray[np.bool_]]:
        """As :meth:`directions_at`, and which positions have a direction, (n,) bool; the others look along the axis."""
        directions, found = self.lens.undistort_where(self._plane(pixels))
        return directions * _OPENGL, found

    def _plane(self, pixels: ArrayLike) -> Float:
        p = np.asarray(pixels, dtype=np.float64)
        return np.stack([(p[:, 0] - self.cx) / self.fx, (p[:, 1] - self.cy) / self.fy], axis=1)

    def project(self, points: ArrayLike) -> Float:
        """Image positions (n, 2), in pixels, of points (n, 3) in camera axes; NaN where the lens cannot see them."""
        p = np.asarray(points, dtype=np.float64) * _OPENGL
        return self.lens.distort(p) * (self.fx, self.fy) + (self.cx, self.cy)


class _DirectionCache:
    """Directions per distinct intrinsics, bounded in bytes, since photo sets may have a lens for every photo."""

    def __init__(self, limit: int) -> None:
        self._limit, self._bytes = limit, 0
        self._kept: OrderedDict[Intrinsics, NDArray[np.float32]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, intrinsics: Intrinsics) -> NDArray[np.float32]:
        with self._lock:
            if intrinsics in self._kept:
                self._kept.move_to_end(intrinsics)
                return self._kept[intrinsics]
        made = self._make(intrinsics)
        with self._lock:
            if intrinsics not in self._kept:
                self._kept[intrinsics] = made
                self._bytes += made.nbytes
            while self._bytes > self._limit and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return made

    @staticmethod
    def _make(intrinsics: Intrinsics) -> NDArray[np.float32]:
        width, height = intrinsics.width, intrinsics.height
        out = np.empty((height, width, 3), dtype=np.float32)
        columns = np.arange(width) + 0.5
        band = max(1, (1 << 14) // width)  # float64 temporaries of a few rows stay in the processor's cache
        for top in range(0, height, band):
            rows = np.arange(top, min(top + band, height)) + 0.5
            pixels = np.stack(np.broadcast_arrays(columns[None, :], rows[:, None]), axis=-1).reshape(-1, 2)
            out[top : top + len(rows)] = intrinsics.directions_where(pixels)[0].reshape(len(rows), width, 3)
        return out


_directions = _DirectionCache(_CACHE_BYTES)


@functools.lru_cache(maxsize=32)
def _reaches(intrinsics: Intrinsics) -> NDArray[np.bool_] | None:
    width, height = intrinsics.width, intrinsics.height
    corners = np.array([(x, y) for x in (0.5, width - 0.5) for y in (0.5, height - 0.5)])
    if intrinsics.directions_where(corners)[1].all():  # reach is a disc: what holds the corners holds the picture
        return None
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return intrinsics.directions_where(np.stack([columns.ravel(), rows.ravel()], 1))[1].reshape(height, width)


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
