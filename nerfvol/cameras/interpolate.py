"""Smooth cameras between keyframes.

Positions: the Catmull-Rom spline with centripetal knots, which has neither cusps nor loops between keyframes (Yuksel,
Schaefer & Keyser 2011). Rotations: squad, the spherical cubic through unit quaternions (Shoemake 1987), with tangents for
the same knots: where these are even they are Shoemake's. Time runs along the knots, an interval being the square root of
how far apart two keyframes are, in place (in mean steps) and in angle (in half turns), so that speed and turning change
without a jump.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.errors import InputError
from nerfvol.rotations import product, quaternion, rotations

Float = NDArray[np.float64]
_SAME = 1e-9  # of a mean step and a half turn: keyframes that are one


def interpolated(keyframes: Sequence[Camera], count: int, loop: bool = False) -> list[Camera]:
    """``count`` cameras along the smooth path through ``keyframes``, the first at its beginning.

    The last is at its end, or, where the path is a loop, one step before the first again. Focal lengths change evenly in their
    logarithm, principal points evenly; size and lens are the first keyframe's.

    Raises:
        InputError: there is no keyframe, or fewer than one camera is asked for.
    """
    if not keyframes or count < 1:
        raise InputError(f"a path needs at least one keyframe and one camera, got {len(keyframes)} and {count}")
    first = keyframes[0].intrinsics
    keys = [camera.resized(first.width, first.height) for camera in keyframes]
    closed = [*keys, keys[0]] if loop and len(keys) > 1 else keys
    positions = np.stack([camera.position for camera in closed])
    quats = _aligned(np.stack([quaternion(camera.c2w[:3, :3]) for camera in closed]))
    steps, turns = np.diff(positions, axis=0), _log(product(_conjugate(quats[:-1]), quats[1:]))
    length = np.linalg.norm(steps, axis=1)
    mean = float(length.mean()) if len(length) and length.mean() > 0 else 1.0
    spans = np.sqrt(length / mean + np.linalg.norm(turns, axis=1) / np.pi)
    kept = np.concatenate([[True], spans > _SAME])
    if not kept[1:].any():
        return [keys[0]] * count
    spans, steps, turns, ends = spans[kept[1:]], steps[kept[1:]], turns[kept[1:]], np.flatnonzero(kept)
    knots = np.concatenate([[0.0], np.cumsum(spans)])
    times = knots[-1] * np.arange(count) / (count if loop else max(count - 1, 1))
    i = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(spans) - 1)
    u = ((times - knots[i]) / spans[i])[:, None]
    place = _hermite(positions[ends], steps, _tangents(steps, spans, loop), spans, i, u)
    turned = rotations(_squad(quats[ends], turns, _tangents(turns, spans, loop), spans, i, u))
    lenses = [closed[k].intrinsics for k in ends]
    cameras = []
    for k, t, position, rotation in zip(i, u[:, 0], place, turned, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, position
        cameras.append(Camera(_mixed(lenses[k], lenses[k + 1], float(t), first), pose))
    return cameras


def _tangents(steps: Float, spans: Float, loop: bool) -> Float:
    """(n + 1, 3) velocities at the knots: Catmull-Rom's, from the steps (n, 3) and spans (n,) to either side."""
    speed = steps / spans[:, None]
    before, after = np.concatenate([speed[-1:], speed]), np.concatenate([speed, speed[:1]])
    w_before, w_after = np.concatenate([spans[-1:], spans]), np.concatenate([spans, spans[:1]])
    mixed = (before * w_after[:, None] + after * w_before[:, None]) / (w_before + w_after)[:, None]
    if not loop:
        mixed[0], mixed[-1] = speed[0], speed[-1]
    return mixed


def _hermite(places: Float, steps: Float, tangents: Float, spans: Float, i: NDArray[np.intp], u: Float) -> Float:
    h = spans[i][:, None]
    return (
        places[i] + steps[i] * (u * u * (3 - 2 * u))
        + tangents[i] * h * (u * (1 - u) ** 2) - tangents[i + 1] * h * (u * u * (1 - u))
    )  # fmt: skip


def _squad(quats: Float, turns: Float, tangents: Float, spans: Float, i: NDArray[np.intp], u: Float) -> Float:
    """Unit quaternions: slerp between the slerps of the keyframes and of the inner ones, which make the tangents."""
    start, end = quats[i], product(quats[i], _exp(turns[i]))
    h = spans[i][:, None]
    inner_start = product(start, _exp((tangents[i] * h - turns[i]) / 2))
    inner_end = product(end, _exp((turns[i] - tangents[i + 1] * h) / 2))
    return _slerp(_slerp(start, end, u), _slerp(inner_start, inner_end, u), 2 * u * (1 - u))


def _slerp(a: Float, b: Float, u: Float) -> Float:
    return product(a, _exp(u * _log(product(_conjugate(a), b))))


def _conjugate(q: Float) -> Float:
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def _log(q: Float) -> Float:
    """(n, 3) rotation vectors, angle times axis, of unit quaternions (n, 4).

    q and -q turn alike, -q the longer way round: keyframes are given signs that are near (:func:`_aligned`), and what is made
    between them stays on its side, for a change of sides halfway is a jump.
    """
    length = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(length, q[:, :1])
    return q[:, 1:] * np.where(length > 1e-12, angle / np.maximum(length, 1e-12), 2.0)


def _exp(v: Float) -> Float:
    angle = np.linalg.norm(v, axis=1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * v * np.sinc(angle / (2 * np.pi))], axis=1)


def _aligned(quats: Float) -> Float:
    """Each with the sign that is nearer to the one before."""
    signs = np.where((quats[1:] * quats[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quats * np.concatenate([[1.0], np.cumprod(signs)])[:, None]


def _mixed(a: Intrinsics, b: Intrinsics, t: float, first: Intrinsics) -> Intrinsics:
    if a == b == first:
        return first
    return dataclasses.replace(
        first, fx=a.fx ** (1 - t) * b.fx**t, fy=a.fy ** (1 - t) * b.fy**t,
        cx=(1 - t) * a.cx + t * b.cx, cy=(1 - t) * a.cy + t * b.cy,
    )  # fmt: skip
