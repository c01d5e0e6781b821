"""A recovered density against the true one that a synthetic scene carries: `nerfvol eval RUN --truth density.npz`.

Colour alone fixes the density only where light passes through: deep inside an opaque medium any density renders alike.
So transmittance along chords stands beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol import pictures
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.octree import Octree, explin

Float = NDArray[np.float64]
CHORDS = 4096


@dataclass(frozen=True)
class Grid:
    """True extinction (nx, ny, nz) in 1/unit, trilinear between samples at ``first`` + index * ``voxel``; 0 outside."""

    sigma: Float
    first: Float
    voxel: Float

    def at(self, points: Float) -> Float:
        """Extinction at points (n, 3): (n,)."""
        place = (points - self.first) / self.voxel
        size = np.array(self.sigma.shape)
        low = np.floor(place).astype(np.int64)
        total = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            index = low + corner
            weight = np.prod(np.where(corner, place - low, 1 - (place - low)), axis=1)
            inside = ((index >= 0) & (index < size)).all(axis=1)
            total[inside] += weight[inside] * self.sigma[tuple(index[inside].T)]
        return total


def load_grid(path: str | Path) -> Grid:
    """The grid in ``density.npz`` of a synthetic scene: arrays density, lo, hi, voxel_size.

    Raises:
        InputError: missing or unreadable file, or arrays that are no grid of finite, non-negative numbers.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            sigma, lo, hi, voxel = (np.asarray(file[k], np.float64) for k in ("density", "lo", "hi", "voxel_size"))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: expected the density.npz of a synthetic scene, {error}") from error
    if sigma.ndim != 3 or not np.isfinite(sigma).all() or sigma.min() < 0 or not (voxel > 0).all():
        raise InputError(f"{path}: expected a 3-D grid of finite, non-negative densities, got shape {sigma.shape}")
    centred = np.allclose(voxel * sigma.shape, hi - lo, rtol=1e-4)  # samples at cell centres, else from face to face
    return Grid(sigma, lo + voxel / 2 if centred else lo, voxel)


def octree_density(octree: Octree, points: Float) -> Float:
    """Extinction of ``octree`` at points (n, 3), 1/unit: (n,); 0 in empty space."""
    leaf = octree.query(points)
    inside = np.flatnonzero(leaf >= 0)
    sides = octree.size / 2.0 ** octree.leaf_level[leaf[inside]].astype(np.float64)
    place = (points[inside] - octree.origin) / sides[:, None] - octree.leaf_ijk[leaf[inside]]
    raw = np.zeros(len(inside))
    for o, corner in enumerate(np.ndindex(2, 2, 2)):
        weight = np.prod(np.where(corner, place, 1 - place), axis=1)
        raw += weight * octree.density[octree.corners[leaf[inside], o]]
    sigma = np.zeros(len(points))
    sigma[inside] = octree.density_scale * explin(raw)
    return sigma


def compare(octree: Octree, grid: Grid, seed: int = 0) -> dict[str, float]:
    """Relative L1 and correlation of density at the grid's samples, and of opacity along random chords.

    Chords join two uniform points on the sphere around the grid; the truth is the trapezoid rule at half a voxel.
    Relative L1: sum |recovered - true| / sum true.
    """
    shape = np.array(grid.sigma.shape)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    found = np.concatenate([octree_density(octree, grid.first + part * grid.voxel) for part in np.array_split(index, 64)])
    center = grid.first + (shape - 1) * grid.voxel / 2
    radius = float(np.linalg.norm((shape - 1) * grid.voxel)) / 2
    ends = np.random.default_rng(seed).normal(size=(2, CHORDS, 3))
    ends = center + radius * ends / np.linalg.norm(ends, axis=-1, keepdims=True)
    length = np.linalg.norm(ends[1] - ends[0], axis=1)
    direction = (ends[1] - ends[0]) / length[:, None]
    depth = np.array([_optical_depth(grid, *chord) for chord in zip(ends[0], direction, length, strict=True)])
    # An octree's ray has no end: what lies behind the far end counts for both, and the sphere holds all of the truth.
    opacity = ops.render_rays(octree, ends[0], direction, early_stop_eps=0.0, outputs=("opacity",))["opacity"]
    return {
        **_agreement("density", found, grid.sigma.reshape(-1)),
        **_agreement("opacity", opacity.astype(np.float64), -np.expm1(-depth)),
    }


def _optical_depth(grid: Grid, start: Float, direction: Float, length: float) -> float:
    n = max(2, int(np.ceil(length / (0.5 * grid.voxel.min()))))
    t = np.linspace(0, length, n + 1)
    return float(np.trapezoid(grid.at(start + t[:, None] * direction), t))


def _agreement(name: str, found: Float, true: Float) -> dict[str, float]:
    together = np.corrcoef(found, true)[0, 1] if found.std() > 0 and true.std() > 0 else float("nan")
    relative = float(np.abs(found - true).sum() / true.sum()) if true.sum() > 0 else float("nan")
    return {f"{name}_relative_l1": relative, f"{name}_correlation": float(together)}


def write_slices(path: str | Path, octree: Octree, grid: Grid) -> None:
    """A PNG of the middle slices across x, y and z, truth | recovered, both grey up to the truth's largest value."""
    panels = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        index = np.stack(np.meshgrid(*(np.arange(grid.sigma.shape[k]) for k in others), indexing="ij"), -1)
        cells = np.insert(index.reshape(-1, 2), axis, grid.sigma.shape[axis] // 2, axis=1)
        for values in (grid.sigma[tuple(cells.T)], octree_density(octree, grid.first + cells * grid.voxel)):
            slice_ = np.clip(values / max(grid.sigma.max(), 1e-12), 0, 1).reshape(index.shape[:2])
            panels.append(np.rot90(slice_).astype(np.float32))
    height = max(panel.shape[0] for panel in panels)
    padded = [np.pad(p, ((0, height - p.shape[0]), (0, 0)), constant_values=1.0) for p in panels]
    pictures.write_png(Path(path), pictures.side_by_side(padded))
