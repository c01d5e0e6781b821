"""Camera moves that people ask for by name, fitted to a scene: orbit, ellipse, spiral, lemniscate.

All of them are closed, look at the scene's centre and keep the orbit's lens (paths.describe_orbit). ``ellipse`` is the one
through the training cameras' plane (mip-NeRF 360), ``spiral`` that of LLFF for scenes seen from one side, ``lemniscate`` a
figure of eight (Gerono's) in azimuth and elevation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.cameras.paths import DEFAULT_ANGLE_X, DEFAULT_SIZE, orbit_cameras
from nerfvol.cameras.pose import orbit_axes
from nerfvol.errors import InputError

Float = NDArray[np.float64]
_WIDE, _HIGH = 45.0, 15.0
"""Degrees to either side that a lemniscate swings, where nothing is known of the sides that were seen."""
_HIGHEST = 80.0


def moving_cameras(
    name: str, count: int, orbit: Mapping[str, Any], size: tuple[int, int] | None, seen: Sequence[Camera] = ()
) -> list[Camera]:
    """``count`` cameras of the move ``name``, one of MOVES.

    Args:
        orbit: of paths.describe_orbit; says centre, radius, elevation, up and lens.
        size: (width, height); None: the orbit's.
        seen: the training cameras, for ellipse and spiral; without them both go by the orbit.

    Raises:
        InputError: there is no such move, or fewer than one camera is asked for.
    """
    if name not in MOVES:
        raise InputError(f"unknown path {name!r}: expected {', '.join(MOVES)}, or a file")
    if count < 1:
        raise InputError(f"a path needs at least one camera, got {count}")
    return MOVES[name](count, orbit, size, seen)


def _orbit(count: int, orbit: Mapping[str, Any], size: tuple[int, int] | None, seen: Sequence[Camera]) -> list[Camera]:
    return orbit_cameras(count, orbit, size)


def _towards(eyes: Float, orbit: Mapping[str, Any], size: tuple[int, int] | None) -> list[Camera]:
    """Cameras at ``eyes`` (n, 3) that look at the orbit's centre."""
    width, height = size or tuple(orbit.get("size") or DEFAULT_SIZE)
    focal = 0.5 * width / math.tan(0.5 * float(orbit.get("camera_angle_x", DEFAULT_ANGLE_X)))
    lens = Intrinsics(int(width), int(height), focal, focal, 0.5 * width, 0.5 * height)
    up = orbit.get("up", (0.0, 0.0, 1.0))
    return [Camera(lens, look_at(eye, orbit["center"], up)) for eye in eyes]


def _circle(count: int) -> Float:
    return 2 * np.pi * np.arange(count) / count


def _positions(orbit: Mapping[str, Any], seen: Sequence[Camera]) -> Float:
    """Where the training cameras stood, or some of the orbit's."""
    return np.stack([camera.position for camera in (seen or orbit_cameras(24, orbit, None))])


def _ellipse(
    count: int, orbit: Mapping[str, Any], size: tuple[int, int] | None, seen: Sequence[Camera]
) -> list[Camera]:
    """Half axes: the 90th percentile of the cameras' distances along their two main directions across up; their mean height."""
    center = np.asarray(orbit["center"], np.float64)
    up, start, side = orbit_axes(orbit.get("up", (0.0, 0.0, 1.0)))
    offsets = _positions(orbit, seen) - center
    flat = np.stack([offsets @ start, offsets @ side], axis=1)
    main = np.linalg.eigh(flat.T @ flat)[1][:, ::-1]
    reach = np.quantile(np.abs(flat @ main), 0.9, axis=0)
    reach = np.maximum(reach, 0.05 * float(orbit["radius"]))  # cameras in a row
    angle = _circle(count)[:, None]
    around = reach * np.hstack([np.cos(angle), np.sin(angle)]) @ main.T
    eyes = center + around @ np.stack([start, side]) + float(np.mean(offsets @ up)) * up
    return _towards(eyes, orbit, size)


def _spiral(count: int, orbit: Mapping[str, Any], size: tuple[int, int] | None, seen: Sequence[Camera]) -> list[Camera]:
    """Two turns about the mean camera, as wide as nine of ten training cameras stood off it, half a period in depth."""
    center = np.asarray(orbit["center"], np.float64)
    (middle,) = _towards(_mean_place(orbit, seen)[None], orbit, size)
    axes = middle.c2w[:3, :3]
    if seen:
        reach = np.quantile(np.abs((_positions(orbit, seen) - middle.position) @ axes), 0.9, axis=0)
    else:
        reach = float(orbit["radius"]) * np.array([0.15, 0.15, 0.05])
    distance = float(np.linalg.norm(middle.position - center))
    reach = np.clip(reach, 0.02 * distance, 0.6 * distance)  # cameras all round would send it through the middle
    angle = 2 * _circle(count)
    local = np.stack([np.cos(angle), -np.sin(angle), -np.sin(angle / 2)], axis=1) * reach
    return _towards(middle.position + local @ axes.T, orbit, size)


def _mean_place(orbit: Mapping[str, Any], seen: Sequence[Camera]) -> Float:
    """The training cameras' mean position where they stood on one side; else the orbit's first."""
    center, radius = np.asarray(orbit["center"], np.float64), float(orbit["radius"])
    if "arc_deg" in orbit and seen:
        return _positions(orbit, seen).mean(axis=0)
    offset = orbit_cameras(1, orbit, None)[0].position - center
    return center + offset * (radius / np.linalg.norm(offset))


def _lemniscate(
    count: int, orbit: Mapping[str, Any], size: tuple[int, int] | None, seen: Sequence[Camera]
) -> list[Camera]:
    up, start, side = orbit_axes(orbit.get("up", (0.0, 0.0, 1.0)))
    angle = _circle(count)
    wide = min(0.5 * float(orbit["arc_deg"]), _WIDE) if "arc_deg" in orbit else _WIDE
    high = _HIGH * wide / _WIDE
    azimuth = np.radians(float(orbit.get("azimuth_deg", 0.0)) + wide * np.sin(angle))
    elevation = np.radians(np.clip(float(orbit["elevation_deg"]) + high * np.sin(2 * angle), -_HIGHEST, _HIGHEST))
    outward = np.cos(azimuth)[:, None] * start + np.sin(azimuth)[:, None] * side
    eyes = np.cos(elevation)[:, None] * outward + np.sin(elevation)[:, None] * up
    return _towards(np.asarray(orbit["center"], np.float64) + float(orbit["radius"]) * eyes, orbit, size)


MOVES: dict[str, Callable[[int, Mapping[str, Any], tuple[int, int] | None, Sequence[Camera]], list[Camera]]] = {
    "orbit": _orbit, "ellipse": _ellipse, "spiral": _spiral, "lemniscate": _lemniscate,
}  # fmt: skip
