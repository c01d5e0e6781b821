"""Intrinsics: size, focal lengths, principal point and lens, and the directions of pixels in camera axes.

camera.py has the conventions.
"""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.cameras.lens import LARGEST, PINHOLE, Fisheye, Lens, with_coefficients
from nerfvol.errors import InputError

Float = NDArray[np.float64]

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
