"""Pictures through any lens, from pictures of pinholes: for what draws pinholes alone."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cameras.canvas import MAX_ANGLE, is_pinhole
from nerfvol.cameras.warp import sample

Float = NDArray[np.float32]
_MARGIN = 3  # pixels around what is looked at: the bicubic's taps


# Rotations (columns: the face's x, y, z axes in the camera's, OpenGL) of the faces ahead, right, left, up, down, behind.
_CUBE = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
], np.float64)  # fmt: skip


Pictures = Mapping[str, NDArray]


DISTANCES = ("depth", "median_depth")


SAME_SURFACE = 0.05
"""Distances that differ by a larger share belong to two surfaces."""


def through_lens(render_pinhole: Callable[[Camera], Pictures], camera: Camera) -> dict[str, Float]:
    """What ``camera`` shows through its lens, from pictures of pinholes.

    Args:
        render_pinhole: draws a pinhole camera: arrays (height, width) or (height, width, k) by name.
        camera: any lens. Without distortion it is drawn as it is. Lenses up to 60 degrees to each side of the axis are
            drawn as one canvas, wider ones as the faces of a cube that they see.

    Returns:
        The same names, float32, of the camera's size. All are resampled bicubically but "depth" and "median_depth"
        (distances along the ray): a hole (0, infinite, no number) where the nearest pixel is one, else the mean of those of
        the four pixels around that are within 5 % of the nearest one's, by bilinear weights: no distance lies between two
        surfaces. "opacity" stays within 0 and 1, "normal" is made a unit vector again.
    """
    lens = camera.intrinsics
    if is_pinhole(lens):
        return {name: np.asarray(a, np.float32) for name, a in render_pinhole(camera).items()}
    out: dict[str, Float] = {}
    for face in _plan(lens):
        pose = camera.c2w.copy()
        pose[:3, :3] = pose[:3, :3] @ face.rotation
        for name, drawn in render_pinhole(Camera(face.pinhole, pose)).items():
            picture = np.asarray(drawn, np.float32)
            shape = (lens.height * lens.width, *picture.shape[2:])
            values = _resampled(name, picture.reshape(*picture.shape[:2], -1), face.places).reshape(-1, *shape[1:])
            if isinstance(face.chosen, slice):
                out[name] = values
            else:
                out.setdefault(name, np.zeros(shape, np.float32))[face.chosen] = values
    return {name: a.reshape(lens.height, lens.width, *a.shape[1:]) for name, a in out.items()}


@dataclass(frozen=True, eq=False)
class _Face:
    """A pinhole that sees a part of what a lens sees: ``rotation`` (3, 3) to the camera's axes; ``chosen``: which pixels of the
    lens it draws; ``places`` (n, 2) float32: where they are in its picture."""

    rotation: NDArray[np.float64]
    chosen: NDArray[np.bool_] | slice
    pinhole: Intrinsics
    places: Float


@functools.lru_cache(maxsize=4)
def _plan(lens: Intrinsics) -> tuple[_Face, ...]:
    """The pinholes that together see what ``lens`` sees; kept, for the pictures of a path and of a data set share a lens."""
    directions = lens.directions().reshape(-1, 3)
    faces = []
    for rotation, chosen in _faces(directions):
        local = directions[chosen] @ rotation.astype(np.float32)
        plane = local[:, :2] / -local[:, 2:] * (lens.fx, -lens.fy)
        first = np.floor(plane.min(axis=0)) - _MARGIN
        width, height = (int(n) for n in np.ceil(plane.max(axis=0)) + _MARGIN - first)
        pinhole = Intrinsics(width, height, lens.fx, lens.fy, -float(first[0]), -float(first[1]))
        faces.append(_Face(rotation, chosen, pinhole, (plane - first).astype(np.float32)))
    return tuple(faces)


def _faces(directions: Float) -> list[tuple[NDArray[np.float64], NDArray[np.bool_] | slice]]:
    """Pinholes that together see unit directions (n, 3): rotation to the camera's axes, and which directions each draws."""
    limit = math.tan(MAX_ANGLE) * -directions[:, 2]
    if (np.abs(directions[:, :2]).max(axis=1) <= limit).all():
        return [(np.eye(3), slice(None))]
    face = np.argmax(directions @ -_CUBE[:, :, 2].astype(np.float32).T, axis=1)
    return [(_CUBE[k], face == k) for k in range(len(_CUBE)) if (face == k).any()]


def _resampled(name: str, picture: Float, places: Float) -> Float:
    """A drawn picture (h, w, k) at places (n, 2), as its kind wants it: (n, k)."""
    if name in DISTANCES:
        return _distances(picture, places)
    values = sample(picture, places, cubic=True)
    if name == "opacity":  # the bicubic goes beyond the values it lies between
        return np.clip(values, 0.0, 1.0)
    if name == "normal":
        values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)
    return values


def _distances(picture: Float, places: Float) -> Float:
    """Distances (h, w, 1) at places (n, 2): a hole where the nearest pixel is one, else the mean of those of its surface."""
    height, width = picture.shape[:2]
    distance = picture[..., 0]
    corner = np.floor(places - 0.5).astype(np.int64)
    part = places - 0.5 - corner

    def at(column: NDArray[np.int64], row: NDArray[np.int64]) -> Float:
        return distance[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    nearest = at(*np.floor(places).astype(np.int64).T)
    total, weight = np.zeros(len(places)), np.zeros(len(places))
    for dy in (0, 1):
        for dx in (0, 1):
            value = at(corner[:, 0] + dx, corner[:, 1] + dy)
            share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            with np.errstate(invalid="ignore"):  # of infinities; they belong to no surface
                share = np.where(np.abs(value - nearest) <= SAME_SURFACE * nearest, share, 0.0)
            total += np.where(share > 0, value, 0.0) * share
            weight += share
    hole = ~((nearest > 0) & np.isfinite(nearest)) | (weight <= 0)
    return np.where(hole, nearest, total / np.where(hole, 1.0, weight)).astype(np.float32)[:, None]
