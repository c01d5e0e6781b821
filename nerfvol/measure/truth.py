"""A recovered density against the true one that a synthetic scene carries: `nerfvol eval RUN --truth density.npz`.

Colour alone fixes the density only where light passes through: deep inside an opaque medium any density renders alike.
So opacity along chords is reported next to it. Both are compared inside the box of the true grid alone: what is outside,
such as the floor under a smoke, is no part of that truth, and an octree holds it as well. A medium that was fitted under known
light has an albedo as well, which the scene's truth.npz tells: `--truth truth.npz`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files import pictures
from nerfvol.files.numpyfile import read_npz
from nerfvol.kernels import ops
from nerfvol.octree.points import octree_density
from nerfvol.octree.topology import MAX_LEVEL
from nerfvol.octree.tree import Octree

if TYPE_CHECKING:
    from nerfvol.medium.model import MediumModel

Float = NDArray[np.float64]
CHORDS = 4096
TRUTH = "truth.npz"
"""All that a synthetic scene is made of (data_synth.truth)."""


@dataclass(frozen=True)
class Grid:
    """True extinction (nx, ny, nz) in 1/unit, trilinear between samples at ``first`` + index * ``voxel``; 0 outside.

    lo, hi: (3,) corners of the box that holds the medium; on a chord the truth counts inside it alone.
    """

    sigma: Float
    first: Float
    voxel: Float
    lo: Float
    hi: Float

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
    """The grid in ``density.npz`` of a synthetic scene: arrays density, lo, hi, voxel_size; of a ``truth.npz`` that of its
    first medium, with its green extinction.

    Raises:
        InputError: missing or unreadable file, or arrays that are no grid of finite, non-negative numbers.
    """
    if Path(path).name == TRUTH:
        return load_medium(path)[0]
    found = read_npz(path, ("density", "lo", "hi", "voxel_size"), "the density.npz of a synthetic scene")
    if not all(np.issubdtype(array.dtype, np.number) and np.isrealobj(array) for array in found.values()):
        raise InputError(f"{path}: expected the density.npz of a synthetic scene, but its arrays are no real numbers")
    sigma, lo, hi, voxel = (array.astype(np.float64) for array in found.values())
    if sigma.ndim != 3 or not sigma.size or not np.isfinite(sigma).all() or sigma.min() < 0 or not (voxel > 0).all():
        raise InputError(f"{path}: expected a 3-D grid of finite, non-negative densities, got shape {sigma.shape}")
    if any(a.shape != (3,) for a in (lo, hi, voxel)) or not (np.isfinite([lo, hi]).all() and (lo < hi).all()):
        raise InputError(
            f"{path}: expected a box with lo < hi and a voxel_size of 3 numbers each, got {lo}, {hi}, {voxel}"
        )
    centred = np.allclose(voxel * sigma.shape, hi - lo, rtol=1e-4)  # samples at cell centres, else from face to face
    return Grid(sigma, lo + voxel / 2 if centred else lo, voxel, lo, hi)


def load_medium(path: str | Path) -> tuple[Grid, Float]:
    """Extinction and albedo (nx, ny, nz, 3), at its samples, of the first medium of a synthetic scene's truth.npz.

    Raises:
        InputError: missing or unreadable file, or its first medium is no grid.
    """
    names = ("kind", "density", "sigma_t", "albedo", "lo", "hi")
    found = read_npz(
        path, [f"medium0_{name}" for name in names], "the truth.npz of a synthetic scene with a grid of density"
    )
    kind, density, sigma_t, table, lo, hi = (found[f"medium0_{name}"] for name in names)
    if str(kind) != "grid" or density.ndim != 3 or min(density.shape) < 2 or table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"{path}: expected a scene whose first medium is a grid of density, it is {kind}")
    albedo = np.broadcast_to(table[0], (*density.shape, 3)).astype(np.float64)
    if len(table) > 1:
        rows = read_npz(path, ["medium0_attribute"], "the truth.npz of a medium with an attribute")["medium0_attribute"]
        place = np.clip(rows, 0, 1) * (len(table) - 1)
        albedo = np.stack([np.interp(place, np.arange(len(table)), table[:, c]) for c in range(3)], -1)
    voxel = (hi - lo) / (np.array(density.shape) - 1)
    return Grid(density.astype(np.float64) * float(sigma_t[1]), lo, voxel, lo, hi), albedo


def within_box(octree: Octree, lo: Float, hi: Float, side: float) -> Octree | None:
    """What ``octree`` holds inside the box lo..hi, (3,) each; None if that is nothing.

    Leaves on a face of the box are subdivided down to ``side``; then a leaf belongs to the box if its centre does.
    """
    while True:
        center, half = octree.leaf_centers(), octree.leaf_sizes() / 2
        beyond = np.maximum(lo - center, center - hi).max(1)  # how far outside a centre lies, negative inside
        split = (np.abs(beyond) < half) & (2 * half > side) & (octree.leaf_level < MAX_LEVEL)
        if not split.any():
            return octree.prune(beyond < 0)[0] if (beyond < 0).any() else None
        octree = octree.subdivide(split)[0]


def random_chords(lo: Float, hi: Float, seed: int = 0) -> tuple[Float, Float, Float]:
    """Entry points (n, 3), unit directions (n, 3) and lengths (n,) of the parts of random chords inside the box lo..hi.

    The ``CHORDS`` chords join two uniform points on the sphere through the corners of the box; n of them meet it.
    """
    ends = np.random.default_rng(seed).normal(size=(2, CHORDS, 3))
    ends = (lo + hi) / 2 + np.linalg.norm(hi - lo) / 2 * ends / np.linalg.norm(ends, axis=-1, keepdims=True)
    direction = ends[1] - ends[0]
    length = np.linalg.norm(direction, axis=1)
    direction /= length[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.sort((np.stack([lo, hi])[:, None] - ends[0]) / direction, axis=0)
    enter, leave = np.fmax(faces[0].max(1), 0), np.fmin(faces[1].min(1), length)
    meets = leave > enter
    start = ends[0] + enter[:, None] * direction
    return start[meets], direction[meets], (leave - enter)[meets]


def compare(octree: Octree, grid: Grid, seed: int = 0) -> dict[str, float]:
    """Relative L1 and correlation of density at the grid's samples, and of opacity along random chords in its box.

    The true opacity is that of the trapezoid rule at half a voxel. Relative L1: sum |recovered - true| / sum true.
    """
    shape = np.array(grid.sigma.shape)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    found = np.concatenate(
        [octree_density(octree, grid.first + part * grid.voxel) for part in np.array_split(index, 64)]
    )
    start, direction, length = random_chords(grid.lo, grid.hi, seed)
    depth = np.array([_optical_depth(grid, *chord) for chord in zip(start, direction, length, strict=True)])
    # An octree's ray has no end of its own: it ends with the part of the octree that lies in the box.
    medium, opacity = within_box(octree, grid.lo, grid.hi, float(grid.voxel.min())), np.zeros(len(start))
    if medium is not None:
        opacity = ops.render_rays(medium, start, direction, early_stop_eps=0.0, outputs=("opacity",))["opacity"]
    return {
        **_agreement("density", found, grid.sigma.reshape(-1)),
        **_agreement("opacity", opacity.astype(np.float64), -np.expm1(-depth)),
    }


def compare_medium(model: MediumModel, grid: Grid, albedo: Float | None = None) -> dict[str, float]:
    """What :func:`compare` returns, of a medium; with a true albedo at the grid's samples also the mean error of the albedo,
    weighted by the true extinction: albedo_error."""
    lo, hi = model.box
    voxel = (hi - lo) / (np.array(model.sigma_t.shape) - 1)
    recovered = Grid(model.sigma_t.astype(np.float64), lo, voxel, lo, hi)
    index = np.stack(np.meshgrid(*map(np.arange, grid.sigma.shape), indexing="ij"), -1).reshape(-1, 3)
    sigma, colour = model.at(grid.first + index * grid.voxel)
    chords = list(zip(*random_chords(grid.lo, grid.hi), strict=True))
    found, true = (np.array([_optical_depth(g, *chord) for chord in chords]) for g in (recovered, grid))
    scores = _agreement("density", sigma, grid.sigma.reshape(-1)) | _agreement(
        "opacity", -np.expm1(-found), -np.expm1(-true)
    )
    if albedo is not None:
        weight = grid.sigma.reshape(-1)
        error = np.abs(colour - albedo.reshape(-1, 3)).mean(1)
        scores["albedo_error"] = float((weight * error).sum() / weight.sum())
    return scores


def _optical_depth(grid: Grid, start: Float, direction: Float, length: float) -> float:
    n = max(2, int(np.ceil(length / (0.5 * grid.voxel.min()))))
    t = np.linspace(0, length, n + 1)
    sigma = grid.at(start + t[:, None] * direction)
    return float(
        (sigma.sum() - (sigma[0] + sigma[-1]) / 2) * length / n
    )  # numpy's own rule has another name before 2.0


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
