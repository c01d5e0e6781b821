"""Pinhole cameras of data_synth. Written apart from nerfvol's, so that a camera bug cannot cancel itself out.

World: right-handed, z up. Camera: OpenGL axes, x right, y up, looking down -z; ``c2w`` is camera-to-world (4, 4).
Pixel (column i, row j) is the point (i + 1/2, j + 1/2) of the image plane, rows run downwards. Ray directions have
unit length, so a ray parameter t is a distance in scene units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth.checks import vector
from data_synth.errors import InputError
from data_synth.jit import jit


class CameraData(NamedTuple):
    """What a kernel needs of a camera. ``c2w`` (3, 4) float64; focal lengths and centre in pixels."""

    c2w: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with its centre of projection in the middle of the image.

    width, height: pixels. focal: pixels. c2w: (4, 4) float64 rigid camera-to-world matrix, OpenGL axes.
    """

    width: int
    height: int
    focal: float
    c2w: np.ndarray

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"Camera: width and height must be at least 1 pixel, got {self.width}x{self.height}")
        if not (math.isfinite(self.focal) and self.focal > 0):
            raise InputError(f"Camera: focal must be a positive number of pixels, got {self.focal}")
        c2w = np.asarray(self.c2w, dtype=np.float64)
        if c2w.shape != (4, 4) or not np.isfinite(c2w).all():
            raise InputError(f"Camera: c2w must be a finite 4x4 matrix, got shape {c2w.shape}")
        rotation = c2w[:3, :3]
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise InputError("Camera: c2w must be a rotation and a translation, got another matrix")
        object.__setattr__(self, "c2w", c2w)

    @property
    def angle_x(self) -> float:
        """Horizontal field of view in radians, ``camera_angle_x`` of the NeRF-synthetic layout."""
        return 2.0 * math.atan(0.5 * self.width / self.focal)

    def data(self) -> CameraData:
        """The plain arrays for the kernels."""
        c2w = np.ascontiguousarray(self.c2w[:3])
        return CameraData(c2w, float(self.focal), float(self.focal), 0.5 * self.width, 0.5 * self.height)


@jit
def pixel_ray(camera, x, y):
    """Unit direction (3 floats) through image-plane point (x, y); the centre of pixel (i, j) is (i + 0.5, j + 0.5)."""
    u = (x - camera.cx) / camera.fx
    v = -(y - camera.cy) / camera.fy
    m = camera.c2w
    dx = m[0, 0] * u + m[0, 1] * v - m[0, 2]
    dy = m[1, 0] * u + m[1, 1] * v - m[1, 2]
    dz = m[2, 0] * u + m[2, 1] * v - m[2, 2]
    s = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * s, dy * s, dz * s


def picture_rows(trace: Callable) -> Callable:
    """A function that fills rows first..last - 1 of out (H, W, 5) with the mean of side x side rays per pixel.

    They lie on a regular grid. ``trace(ray, context)`` gives (rgb, alpha, distance) of a ray.
    """

    @jit
    def rows(context, camera, side, out, first, last):
        o = (camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3])
        share = 1.0 / (side * side)
        for i in range(out.shape[1]):  # columns of a narrow band: rays one after another meet the same bricks
            for j in range(first, last):
                r, g, b, alpha, far = 0.0, 0.0, 0.0, 0.0, 0.0
                for s in range(side * side):
                    ray = (o, pixel_ray(camera, i + (s % side + 0.5) / side, j + (s // side + 0.5) / side))
                    L, a, t = trace(ray, context)
                    r, g, b, alpha, far = r + L[0], g + L[1], b + L[2], alpha + a, far + t
                out[j, i, 0], out[j, i, 1], out[j, i, 2] = r * share, g * share, b * share
                out[j, i, 3], out[j, i, 4] = alpha * share, far * share

    return rows


def look_at(eye: ArrayLike, target: ArrayLike = (0.0, 0.0, 0.0), up: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Camera-to-world (4, 4) of a camera at ``eye`` looking at ``target``, its y axis as close to ``up`` as can be."""
    eye, target, up = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
    back = eye - target
    right = np.cross(up, back)
    if np.linalg.norm(right) <= 1e-12 * np.linalg.norm(back) * np.linalg.norm(up):
        raise InputError("look_at: eye must differ from target and the view must not be parallel to up")
    back /= np.linalg.norm(back)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :4] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return c2w


@dataclass(frozen=True)
class Viewpoints:
    """Where a scene is photographed from: a band of a sphere around ``target``.

    radius in scene units, elevations and horizontal field of view in degrees.
    """

    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 4.0
    elevation: tuple[float, float] = (5.0, 75.0)
    fov: float = 40.0

    def __post_init__(self) -> None:
        vector(self.target, "viewpoints: target")
        vector((self.radius, *self.elevation), "viewpoints: radius and two elevations")
        low, high = self.elevation
        if not self.radius > 0 or not 0 < self.fov < 180 or not -90 < low <= high < 90:
            raise InputError(
                "viewpoints: expected a positive radius, elevations within (-90, 90) and fov within (0, 180), "
                f"got {self.radius}, {self.elevation} and {self.fov}"
            )

    def camera(self, azimuth: float, elevation: float, width: int, height: int) -> Camera:
        """The camera at the given angles in degrees."""
        az, el = math.radians(azimuth), math.radians(elevation)
        offset = np.array([math.cos(az) * math.cos(el), math.sin(az) * math.cos(el), math.sin(el)])
        c2w = look_at(np.asarray(self.target) + self.radius * offset, self.target)
        return Camera(width, height, 0.5 * width / math.tan(0.5 * math.radians(self.fov)), c2w)

    def spread(self, n: int, width: int, height: int, seed: int) -> list[Camera]:
        """``n`` cameras spread evenly over the band: a golden-angle spiral of equal areas, turned by the seed."""
        rng = np.random.default_rng(seed)
        turn, shift = 360.0 * rng.random(), rng.random()
        low, high = (math.sin(math.radians(e)) for e in self.elevation)
        cameras = []
        for k in range(n):
            elevation = math.degrees(math.asin(low + (high - low) * ((k + shift) / n)))
            cameras.append(self.camera(turn + k * 137.50776405, elevation, width, height))
        return cameras

    def orbit(self, n: int, width: int, height: int, elevation: float | None = None) -> list[Camera]:
        """``n`` cameras on one circle, by default in the middle of the band."""
        if elevation is None:
            elevation = 0.5 * sum(self.elevation)
        return [self.camera(360.0 * k / n, elevation, width, height) for k in range(n)]
