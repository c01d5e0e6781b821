"""Point clouds: read from PLY files of any common writer, and made into Gaussians that draw them.

Drawn by EWA splatting (Zwicker et al., "EWA splatting", 2002) a point is a Gaussian as wide as the points are apart: a disc
where it has a normal, a ball where not.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.errors import InputError
from nerfvol.octree.points import Y00
from nerfvol.rotations import turning_z_to
from nerfvol.splats.neighbours import nearest
from nerfvol.splats.plyfile import PlyFile
from nerfvol.splats.splats import Splats

NEIGHBOURS = 8
OPAQUE = 1 - 1 / 255
_FLAT = 1e-3  # of a disc's radius: its thickness, since a Gaussian of none has no logarithm
_FARTHEST = 1e15  # as for cameras
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


@dataclass(frozen=True, eq=False)
class PointCloud:
    """``positions`` (n, 3) float64, scene units; ``colours`` (n, 3) float32 in [0, 1]; ``normals`` (n, 3) float32 unit
    vectors or None."""

    positions: NDArray[np.float64]
    colours: NDArray[np.float32]
    normals: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, chosen: NDArray[Any] | Sequence[int] | slice) -> PointCloud:
        """The chosen points (numbers, mask or slice)."""
        normals = None if self.normals is None else self.normals[chosen]
        return PointCloud(self.positions[chosen], self.colours[chosen], normals)

    @staticmethod
    def empty() -> PointCloud:
        """A cloud without points."""
        return PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))

    @staticmethod
    def joined(a: PointCloud, b: PointCloud) -> PointCloud:
        """Both clouds' points; normals only where both have them."""
        normals = None
        if a.normals is not None and b.normals is not None:
            normals = np.concatenate([a.normals, b.normals])
        return PointCloud(np.concatenate([a.positions, b.positions]), np.concatenate([a.colours, b.colours]), normals)


def read_points(path: str | os.PathLike[str]) -> PointCloud:
    """The points of a PLY file, binary or ascii: x y z, colours (bytes, 16 bits or in [0, 1]; grey where there are none)
    and normals where they are given for all points.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    with PlyFile(path) as file:
        table = file.read()
        for name in ("x", "y", "z"):
            if name not in table:
                raise file.fault(f"its vertices have no property {name!r}")
        with np.errstate(invalid="ignore"):  # what is no number is refused below
            positions = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
        if not (np.abs(positions) < _FARTHEST).all():  # fails for what is no number as well
            bad = int((~(np.abs(positions) < _FARTHEST)).any(axis=1).argmax())
            raise file.fault(f"the position of point {bad} is not finite or beyond {_FARTHEST:g}")
        colours = _first_of(table, _COLOURS, _unit)
        normals = _first_of(table, _NORMALS, lambda a: a.astype(np.float64))
        if colours is None:
            colours = np.full((len(positions), 3), 0.5)
        return PointCloud(positions, colours.astype(np.float32), _unit_normals(normals))


def _first_of(
    table: Mapping[str, NDArray], choices: Sequence[tuple[str, str, str]], convert: Callable[[NDArray], NDArray]
) -> NDArray | None:
    """The first triple of properties that the table has, as an array (n, 3)."""
    for names in choices:
        if all(name in table for name in names):
            return np.stack([convert(table[name]) for name in names], axis=1)
    return None


def _unit(values: NDArray) -> NDArray[np.float64]:
    """Colours in [0, 1]: whole numbers count from 0 to their type's largest."""
    if np.issubdtype(values.dtype, np.integer):
        return np.clip(values.astype(np.float64) / np.iinfo(values.dtype).max, 0.0, 1.0)
    return np.clip(np.nan_to_num(values.astype(np.float64), nan=0.5), 0.0, 1.0)


def _unit_normals(normals: NDArray[np.float64] | None) -> NDArray[np.float32] | None:
    """Unit vectors; None where any is missing: many writers fill the columns with zeros."""
    if normals is None or not np.isfinite(normals).all():
        return None
    with np.errstate(over="ignore"):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not ((length > 1e-12) & np.isfinite(length)).all():
        return None
    return (normals / length).astype(np.float32)


def dc_of_colour(colours: ArrayLike) -> NDArray[np.float32]:
    """First SH coefficients (n, 3, 1) of Gaussians that show colours (n, 3) in [0, 1] to all sides."""
    return ((np.asarray(colours, np.float64) - 0.5) / Y00).astype(np.float32)[:, :, None]


def logit(opacity: float) -> float:
    """The logit of an opacity between 0 and 1."""
    return math.log(opacity / (1 - opacity))


def spacing(positions: ArrayLike, neighbours: int) -> NDArray[np.float64]:
    """(n,) root mean square distance to the nearest ``neighbours`` points; NaN for a point without any.

    Every point counts, also one at the same place. A point with fewer neighbours than asked for takes those it has.
    """
    squared, index = nearest(positions, neighbours)
    there = index >= 0
    count = there.sum(axis=1)
    total = np.where(there, squared, 0.0).sum(axis=1)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def splats_of_points(cloud: PointCloud, scale: float = 0.5) -> Splats:
    """Gaussians that draw a cloud: as wide as its points are apart, almost opaque, mode "mip".

    A Gaussian's standard deviation is ``scale`` times the mean distance to its 8 nearest neighbours (root mean square; on
    a square grid that is 1.22 times the grid's step). With normals they are discs across them, else balls.

    Raises:
        InputError: there are no points, or all of them are at one place.
    """
    if not len(cloud):
        raise InputError("a point cloud without points cannot be drawn")
    size = scale * spacing(cloud.positions, NEIGHBOURS)
    apart = size[np.isfinite(size) & (size > 0)]
    if not len(apart):
        raise InputError(f"the {len(cloud)} points are all at one place, so nothing says how large to draw them")
    typical = float(np.median(apart))
    size = np.where(np.isfinite(size) & (size > 0), np.maximum(size, 1e-3 * typical), typical)
    scales = np.repeat(size[:, None], 3, axis=1)
    quats = np.zeros((len(cloud), 4))
    quats[:, 0] = 1
    if cloud.normals is not None:
        scales[:, 2] *= _FLAT
        quats = turning_z_to(cloud.normals.astype(np.float64))
    origin = 0.5 * (cloud.positions.min(axis=0) + cloud.positions.max(axis=0))
    return Splats(
        means=(cloud.positions - origin).astype(np.float32), log_scales=np.log(scales).astype(np.float32),
        quats=quats.astype(np.float32), logits=np.full(len(cloud), logit(OPAQUE), np.float32),
        sh=dc_of_colour(cloud.colours), origin=origin, mode="mip",
    )  # fmt: skip
