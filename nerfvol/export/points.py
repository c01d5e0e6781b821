"""``.ply`` of coloured points: x y z in scene units, float32, or double where that would lose them (map coordinates), red green
blue bytes as in the training images.

``surface``: what views of the model see, at the median depth of each pixel, one point a voxel, with normals; a point is
kept where a second view agrees. ``centers``: of an octree the centres of leaves, of splats their means, each with the
colour that it shows on average over all directions, where it is opaque enough: a leaf along its side, a splat in its
middle. A cloud has its points.
"""

from __future__ import annotations

import os
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.clouds import PointModel
from nerfvol.errors import InputError
from nerfvol.export.part import Up, turn_to
from nerfvol.export.surface import Cameras, Shot, bytes_of_shots, shoot
from nerfvol.models import Model
from nerfvol.octree.points import leaf_colour, leaf_density
from nerfvol.splats.plyfile import write_ply
from nerfvol.splats.points import Y00, PointCloud
from nerfvol.views import OctreeModel, SplatModel

Method = Literal["surface", "centers"]
VIEWS = 40
RESOLUTION = 512
_OPAQUE = {"surface": 0.9, "centers": 0.5}
_DIGITS = 1e-4
"""Share of the model's size: where float32 rounds positions by more, they are doubles."""
_AGREE = 2.0  # voxels between a point and the surface that another view sees


def memory(
    model: Model, method: Method = "surface", threshold: float | None = None, views: int = VIEWS,
    cameras: Cameras | None = None, resolution: int = RESOLUTION, up: Up = "none",
) -> int:  # fmt: skip
    """Bytes that writing takes: the views and their points, or positions, colours, densities and what they are made of."""
    if _by_views(model, method):
        return 3 * bytes_of_shots(views, cameras, resolution)
    if isinstance(model, OctreeModel):
        return 600 * model.octree.n_leaves
    return 300 * (len(model.cloud) if isinstance(model, PointModel) else model.splats.n)  # type: ignore[attr-defined]


def write(
    model: Model, path: str | os.PathLike[str], method: Method = "surface", threshold: float | None = None,
    views: int = VIEWS, cameras: Cameras | None = None, resolution: int = RESOLUTION, up: Up = "none",
) -> int:  # fmt: skip
    """Points of opacity ``threshold`` (0.9 on surfaces, else 0.5) or more; resolution: voxels along the longest side.

    Raises:
        InputError: nothing is so opaque, or the path cannot be written.
    """
    least = _OPAQUE[method] if threshold is None else threshold
    if _by_views(model, method):
        cloud = _surface(model, shoot(model, views, cameras, resolution), least, resolution)
    else:
        cloud = _opaque(model, least)
    turn = turn_to(model, up)
    positions = cloud.positions @ turn.T
    extent = float(np.ptp(positions, axis=0).max(initial=0.0))
    rounding = float(np.spacing(np.float32(np.abs(positions).max(initial=0.0))))
    kind = np.float64 if rounding > _DIGITS * extent > 0 else np.float32
    columns: dict[str, NDArray] = {name: positions[:, k].astype(kind) for k, name in enumerate("xyz")}
    if cloud.normals is not None:
        normals = cloud.normals @ turn.T
        columns |= {name: normals[:, k].astype(np.float32) for k, name in enumerate(("nx", "ny", "nz"))}
    bytes_ = np.round(255 * np.clip(cloud.colours, 0, 1)).astype(np.uint8)
    columns |= {name: bytes_[:, k] for k, name in enumerate(("red", "green", "blue"))}
    return write_ply(path, [], columns)


def _by_views(model: Model, method: Method) -> bool:
    return method == "surface" and not isinstance(model, PointModel)


def _surface(model: Model, shots: list[Shot], least: float, resolution: int) -> PointCloud:
    """What ``shots`` see, the mean in each voxel, where a second one agrees."""
    low, high = model.aabb()
    voxel = float((high - low).max() / resolution)
    places, rows = [], []
    for shot in shots:
        points, pixels = shot.points(least)
        inside = ((points >= low - voxel) & (points <= high + voxel)).all(axis=1)
        places.append(points[inside])
        rows.append(np.hstack([part.reshape(-1, 3)[pixels[inside]] for part in (shot.rgb, shot.normal)]))
    points, values = np.concatenate(places), np.concatenate(rows)
    if not len(points):
        most = max(float(shot.opacity.max()) for shot in shots)
        raise InputError(
            f"nothing that the views see is as opaque as {least:g}, the most is {most:.3g}: lower --threshold"
        )
    cells = np.floor((points - low) / voxel).astype(np.int64) + 1
    _, cell = np.unique(cells @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)
    count = np.bincount(cell)
    mean = lambda column: np.bincount(cell, column) / count  # noqa: E731
    points = np.stack([mean(points[:, k]) for k in range(3)], axis=1)
    values = np.stack([mean(values[:, k]) for k in range(6)], axis=1)
    length = np.linalg.norm(values[:, 3:], axis=1)
    kept = (_agreed(shots, points, _AGREE * voxel) >= 2) & (
        length > 1e-3
    )  # a voxel with both sides of a sheet has no normal
    if not kept.any():
        raise InputError("no two views agree on a point of the surface: give more --views")
    normals = values[kept, 3:] / length[kept, None]
    return PointCloud(points[kept], values[kept, :3].astype(np.float32), normals.astype(np.float32))


def _agreed(shots: list[Shot], points: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """(n,) how many views see their surface at each point."""
    views = np.zeros(len(points), np.int64)
    for shot in shots:
        pixel, distance, shown = shot.look(points)
        views += shown & (np.abs(shot.depth.reshape(-1)[pixel] - distance) < tolerance)
    return views


def _opaque(model: Model, least: float) -> PointCloud:
    """Leaves, splats or points, where they are opaque enough."""
    if isinstance(model, PointModel):
        return model.cloud
    if isinstance(model, OctreeModel):
        octree = model.octree
        opacity = -np.expm1(-leaf_density(octree) * octree.leaf_sizes())
        positions, colours = octree.leaf_centers(), leaf_colour(octree)
    else:
        assert isinstance(model, SplatModel)
        splats = model.splats
        positions, colours = splats.means.astype(np.float64) + splats.origin, 0.5 + Y00 * splats.sh[:, :, 0]
        opacity = 1 / (1 + np.exp(-splats.logits.astype(np.float64)))
    shown = opacity >= least
    if not shown.any():
        most = float(opacity.max(initial=0.0))
        raise InputError(f"nothing is as opaque as {least:g}, the most is {most:.3g}: lower --threshold")
    return PointCloud(positions[shown], colours[shown].astype(np.float32))
