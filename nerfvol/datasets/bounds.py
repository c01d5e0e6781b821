"""Where the scene is, worked out from the cameras; alpha decides only whether a background belongs to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.focus import focus_point
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds, cube

MARGIN = 1.03
BACKGROUND_FACTOR = 16
_FORWARD_FACING = 0.05  # optical axes within about 13 degrees of one another: the point they meet in is ill-defined
INSTANT_NGP_SCALE = 0.33
"""instant-ngp maps scene x to 0.33 x + 1/2, unless a file states another scale, and models a cube of side aabb_scale there."""


@dataclass(frozen=True)
class BoundsHint:
    """What a file says of the scene: an explicit ``aabb``, near and far (scene units), instant-ngp's ``aabb_scale`` and how
    many of its units a scene unit is."""

    aabb: NDArray[np.float64] | None = None
    aabb_scale: float | None = None
    near_far: tuple[float, float] | None = None
    unit: float = INSTANT_NGP_SCALE


def _half_angle_tangent(camera: Camera) -> float:
    """Tangent of the half field of view along the longer side of the image, the lens taken as undistorted."""
    intrinsics = camera.intrinsics
    return max(0.5 * intrinsics.width / intrinsics.fx, 0.5 * intrinsics.height / intrinsics.fy)


def bounds_of_box(box: NDArray[np.float64], has_alpha: bool, bounded: bool | None = None) -> SceneBounds:
    """Bounds with a stated aabb (2, 3), scene units, and around photographs the background cube, 16 times as large.

    ``bounded``: whether there is no background; None: where the pictures are transparent.
    """
    background = cube(box.mean(axis=0), BACKGROUND_FACTOR * float((box[1] - box[0]).max()) / 2)
    return SceneBounds(box, None if (has_alpha if bounded is None else bounded) else background, has_alpha)


def estimate_bounds(
    cameras: Sequence[Camera], has_alpha: bool, hint: BoundsHint | None = None, kind: str | None = None
) -> tuple[SceneBounds, str]:
    """Bounds, in scene units, from the cameras (at least one) and what the file says; a sentence on how they were found.

    ``kind``: of datasets.kinds; None: an object where ``has_alpha``, else photographs of what the cameras' axes suggest.

    - An explicit aabb is taken as it is.
    - Objects: a cube around the point all cameras look at, as large as their images reach there: half = 1.03 x distance x
      tan(half the field of view), 90th percentile over the cameras. NeRF-synthetic (distance 4.03, 0.691 rad) gives 1.495:
      the classical [-1.5, 1.5]^3.
    - Photographs around a subject: the cube reaches to the median camera, the background cube 16 times as far.
    - Forward-facing photographs with near/far: the cube holds what the cameras see between the two.
    - Rooms, and cameras whose axes do not meet: a guess from the cameras' spread, which what the views share can better.
    - instant-ngp's aabb_scale is an upper bound on the region of detail.
    """
    hint = hint or BoundsHint()
    bounded = has_alpha if kind is None else kind == "object"
    if hint.aabb is not None:
        return bounds_of_box(hint.aabb, has_alpha, bounded), "scene bounds: the aabb of the file"
    positions = np.stack([camera.position for camera in cameras])
    focus = focus_point(cameras)
    distances = np.linalg.norm(positions - focus.point, axis=1)
    if hint.near_far is not None and (kind == "forward" or kind is None and focus.certainty < _FORWARD_FACING):
        box, sentence = _between(cameras, hint.near_far)
        return bounds_of_box(box, has_alpha, bounded), sentence
    spread = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    still = float(distances.max()) <= 1e-12 * max(1.0, float(np.abs(positions).max()))
    if len(cameras) < 2 or not focus.is_clear or still or kind in ("room", "forward"):
        if kind == "room":
            box, sentence = _room(positions, spread)
        else:
            box, sentence = _guess(cameras)
        return replace(bounds_of_box(box, has_alpha, bounded), is_guess=True), sentence
    if bounded:
        reach = [d * _half_angle_tangent(camera) for d, camera in zip(distances, cameras, strict=True)]
        half = MARGIN * float(np.percentile(reach, 90))
    else:
        half = float(np.median(distances))
    if hint.aabb_scale is not None:
        half = min(half, 0.5 * hint.aabb_scale / hint.unit)
    how = "the point all cameras look at, as far as " + ("their images reach" if bounded else "the median camera")
    sentence = f"scene bounds: a cube of half side {half:.4g} around {how}"
    return bounds_of_box(cube(focus.point, half), has_alpha, bounded), sentence


def _between(cameras: Sequence[Camera], near_far: tuple[float, float]) -> tuple[NDArray[np.float64], str]:
    """The cube around what forward-facing cameras see between near and far."""
    near, far = near_far
    corners = []
    for camera in cameras:
        i = camera.intrinsics
        pixels = np.array([[0, 0], [i.width, 0], [0, i.height], [i.width, i.height]], dtype=np.float64)
        directions = i.directions_where(pixels)[0] @ camera.c2w[:3, :3].T
        depth = directions @ camera.forward
        for distance in (near, far):
            corners.append(camera.position + directions * (distance / depth)[:, None])
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * float((high - low).max())
    return cube((low + high) / 2, half), f"scene bounds: what is seen between near {near:g} and far {far:g}"


def _guess(cameras: Sequence[Camera]) -> tuple[NDArray[np.float64], str]:
    """Cameras whose axes do not meet say nothing of the distance to the scene; take three times their spread (or 3)."""
    positions = np.stack([camera.position for camera in cameras])
    middle = np.median(positions, axis=0)
    spread = float(np.percentile(np.linalg.norm(positions - middle, axis=1), 95))
    forward = np.mean([camera.forward for camera in cameras], axis=0)
    length = np.linalg.norm(forward)
    forward = forward / length if length > 1e-6 else np.zeros(3)
    reach = 3 * spread if spread > 1e-12 * max(1.0, float(np.abs(middle).max())) else 3.0
    half = max(1.0, float(np.median([_half_angle_tangent(camera) for camera in cameras]))) * reach
    how = "scene bounds: a guess, since the cameras look at no common point; state the scene's aabb if it is wrong"
    return cube(middle + reach * forward, half), how


def _room(positions: NDArray[np.float64], spread: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Around cameras that look outwards: three times as far as they stand from their middle (or 3)."""
    reach = 3 * float(np.percentile(spread, 95))
    half = reach if reach > 1e-12 * max(1.0, float(np.abs(positions).max())) else 3.0
    how = (
        "scene bounds: a guess around the cameras, which look at no common point; state the scene's aabb if it is wrong"
    )
    return cube(np.median(positions, axis=0), half), how


def bounds_of_points(points: NDArray[np.float64], scene: SceneBounds) -> SceneBounds:
    """``scene`` with the region of detail that points (n, 3) found on its surfaces fill, scene units.

    The 2nd to the 98th percentile along each axis, with a twentieth more at each end: some points are always wrong.
    """
    low, high = np.percentile(points, (2, 98), axis=0)
    room = np.maximum(0.05 * (high - low), 0.02 * float((high - low).max()) + 1e-12)
    box = np.stack([low - room, high + room])
    return replace(bounds_of_box(box, scene.has_alpha, not scene.is_unbounded), is_guess=False)


def require_seen(bounds: SceneBounds, cameras: Sequence[Camera]) -> None:
    """Refuses bounds of which no camera sees anything. Cameras inside them are fine.

    Looked at: whether points of a grid in the bounds lie in an image or, for bounds narrower than the grid sees, rays of an
    image meet them (slabs, Kay and Kajiya 1986).

    Raises:
        InputError: no camera sees any of the bounds.
    """
    low, high = bounds.aabb if bounds.background_cube is None else bounds.background_cube
    steps = np.linspace(0, 1, 9)
    grid = low + (high - low) * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    for camera in cameras:
        i = camera.intrinsics
        seen = camera.project(grid)
        if ((seen >= 0) & (seen <= (i.width, i.height))).all(axis=1).any():
            return
        columns, rows = np.meshgrid(np.linspace(0, i.width, 17), np.linspace(0, i.height, 17))
        directions, found = i.directions_where(np.stack([columns.ravel(), rows.ravel()], axis=1))
        origin, directions = camera.position, directions[found] @ camera.c2w[:3, :3].T
        safe = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        t0, t1 = (low - origin) / safe, (high - origin) / safe
        enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
        if ((enter <= leave) & (leave > 0)).any():
            return
    distance = math.inf if not cameras else min(np.linalg.norm(camera.position - bounds.center) for camera in cameras)
    raise InputError(
        f"the scene bounds {bounds.aabb.round(3).tolist()} are seen by none of the {len(cameras)} cameras, the nearest "
        f"{distance:.3g} away"
    )
