"""Pinhole canvases: what part of a plane a lens sees, and how a photograph's pixels and the canvas's find each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Intrinsics
from nerfvol.errors import InputError

Float = NDArray[np.float64]

MAX_ANGLE = math.radians(60)
"""To each side of the axis, the widest a canvas is: beyond it a plane spends 4 times the pixels of its middle and more."""
_ACCURACY = 0.01  # pixels, of positions between the grid's nodes
_STEPS = (32, 16, 8, 4, 2, 1)
_BORDER_STEP = 4.0  # pixels between the places on a photograph's border that are followed through the lens


def is_pinhole(intrinsics: Intrinsics) -> bool:
    """Whether the camera has no lens to undo."""
    return not intrinsics.fisheye and not any(intrinsics.distortion)


@dataclass(frozen=True, eq=False)
class Canvas:
    """The pinhole picture that holds what a lens shows.

    ``camera``: its intrinsics; focal lengths are the lens's own, so that sizes are kept in the middle.
    ``radius``: distance from the axis, in focal lengths, beyond which nothing is on the photograph; infinite for none.
    ``cropped``: whether the photograph shows more than the canvas.
    """

    camera: Intrinsics
    radius: float
    cropped: bool


def canvas_of(intrinsics: Intrinsics, max_angle: float = MAX_ANGLE) -> Canvas:
    """The canvas that holds every pixel of the photograph, or what of it lies within ``max_angle`` of the axis.

    Raises:
        InputError: ``max_angle`` is not between 0 and 80 degrees, or the lens has no inverse at the border.
    """
    if not 0 < max_angle <= math.radians(80):
        raise InputError(f"a canvas may reach 0 to 80 degrees from the axis, got {math.degrees(max_angle):g}")
    if is_pinhole(intrinsics):
        return Canvas(intrinsics, math.inf, False)
    directions = _outermost(intrinsics)
    ahead = -directions[:, 2]
    limit = math.tan(max_angle)
    # What is far off the axis, or behind it, only needs to lie beyond the limit on its own side.
    plane = directions[:, :2] * (1, -1) / np.maximum(ahead, 1e-3)[:, None]
    angle = np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), ahead).max()
    radius = math.tan(angle) if angle < math.radians(89) else math.inf
    low, high = np.maximum(plane.min(axis=0), -limit), np.minimum(plane.max(axis=0), limit)
    cropped = bool((np.abs(plane) > limit * (1 + 1e-9)).any())
    first = np.floor(low * (intrinsics.fx, intrinsics.fy) + 1e-6)
    last = np.ceil(high * (intrinsics.fx, intrinsics.fy) - 1e-6)
    width, height = (int(n) for n in np.maximum(last - first, 1))
    camera = Intrinsics(width, height, intrinsics.fx, intrinsics.fy, -float(first[0]), -float(first[1]))
    return Canvas(camera, radius, cropped)


def _outermost(intrinsics: Intrinsics) -> Float:
    """Directions (n, 3), camera axes, of the border of what the photograph shows: its edge, or where the lens's reach ends."""
    border = _border(intrinsics)
    directions, found = intrinsics.directions_where(border)
    if found.all():
        return directions
    axis = np.array([intrinsics.cx, intrinsics.cy])
    inner, outer = np.zeros(len(border)), np.ones(len(border))
    for _ in range(30):  # of the way from the axis to the edge, how far the lens reaches
        middle = (inner + outer) / 2
        reached = intrinsics.directions_where(axis + middle[:, None] * (border - axis))[1]
        inner, outer = np.where(reached, middle, inner), np.where(reached, outer, middle)
    share = np.where(found, 1.0, inner * (1 - 1e-9))
    directions, found = intrinsics.directions_where(axis + share[:, None] * (border - axis))
    return directions[found] if found.any() else intrinsics.directions_at(border)


def _border(intrinsics: Intrinsics) -> Float:
    """Places (n, 2) on the outer edges of a photograph's pixels, in pixels."""
    w, h = float(intrinsics.width), float(intrinsics.height)
    x = np.linspace(0, w, max(2, math.ceil(w / _BORDER_STEP) + 1))
    y = np.linspace(0, h, max(2, math.ceil(h / _BORDER_STEP) + 1))
    sides = [(x, 0 * x), (x, 0 * x + h), (0 * y, y), (0 * y + w, y)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def source_grid(canvas: Canvas, intrinsics: Intrinsics) -> tuple[NDArray[np.float32], int]:
    """Where on the photograph the canvas's pixels lie: a grid of positions (rows, columns, 2) and the pixels between nodes.

    The widest spacing is taken at which positions between nodes, taken as linear, are within 0.01 pixels (by second
    differences), so that lenses are worked out at few places: a photo set may have one for every photograph.
    """
    grid, step = np.empty((0, 0, 2)), 0
    for step in _STEPS:
        grid = _positions(canvas, intrinsics, step)
        inside = np.hypot(*(_plane(canvas.camera, grid.shape[:2], step).T)).T <= canvas.radius
        bends = [np.abs(np.diff(grid, 2, axis=axis)).max(axis=2) for axis in (0, 1)]
        seen = [inside[1:-1], inside[:, 1:-1]]
        worst = sum(float(bend[at].max(initial=0.0)) for bend, at in zip(bends, seen, strict=True)) / 8
        if worst <= _ACCURACY or step == _STEPS[-1]:
            break
    return grid.astype(np.float32), step


def _plane(camera: Intrinsics, shape: tuple[int, int], step: int) -> Float:
    """(rows, columns, 2) places on the plane at distance 1 of every step-th pixel's centre."""
    x = (np.arange(shape[1]) * step + 0.5 - camera.cx) / camera.fx
    y = (np.arange(shape[0]) * step + 0.5 - camera.cy) / camera.fy
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)


def _positions(canvas: Canvas, intrinsics: Intrinsics, step: int) -> Float:
    """Positions on the photograph of the canvas's nodes.

    Beyond the canvas's radius lenses may turn back and show a second, false picture: from there on positions go straight
    outwards with the slope they had.
    """
    camera = canvas.camera
    shape = (-(-(camera.height - 1) // step) + 1, -(-(camera.width - 1) // step) + 1)
    plane = _plane(camera, shape, step).reshape(-1, 2)
    r = np.hypot(plane[:, 0], plane[:, 1])
    beyond = r > canvas.radius
    at = np.where(beyond, canvas.radius / np.maximum(r, 1e-300), 1.0)[:, None] * plane
    out = _project(intrinsics, at)
    if beyond.any():
        back = 1 - 1e-4
        slope = (out[beyond] - _project(intrinsics, back * at[beyond])) / ((1 - back) * canvas.radius)
        out[beyond] += slope * (r[beyond] - canvas.radius)[:, None]
    return out.reshape(*shape, 2)


def _project(intrinsics: Intrinsics, plane: Float) -> Float:
    points = np.concatenate([plane * (1, -1), np.full((len(plane), 1), -1.0)], axis=1)
    return intrinsics.project(points)
