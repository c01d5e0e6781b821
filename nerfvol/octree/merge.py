"""Leaves of several sizes: eight sibling leaves become one where nothing is lost by it."""

from __future__ import annotations

import math

import numpy as np

from nerfvol.octree.rows import explin
from nerfvol.octree.topology import LATTICE_OF_CORNER, LATTICE_STRIDES, LATTICE_WEIGHTS, OFFSETS
from nerfvol.octree.tree import Octree


def merge_smooth(octree: Octree, coarsest: int, tolerance: float) -> Octree:
    """Replace eight sibling leaves by one where its trilinear field is theirs to within ``tolerance``.

    The error is the largest, over the 27 points of the siblings' lattice, of the change in opacity of a sibling and of
    the change in colour times the sibling's opacity. Repeats level by level, up to leaves of level ``coarsest``.
    """
    for level in range(octree.max_level, max(coarsest, 1), -1):
        if tolerance <= 0:
            break
        rows = np.flatnonzero(octree.leaf_level == level)
        parents, members, counts = np.unique(
            _keys(octree.leaf_ijk[rows] >> 1, level), return_inverse=True, return_counts=True
        )
        full = counts[members] == 8
        rows, members = rows[full], members[full]
        if not len(rows):
            continue
        # Siblings in octant order: (m, 8) leaf numbers.
        octant = (octree.leaf_ijk[rows] & 1) @ np.array([4, 2, 1])
        families = rows[np.lexsort((octant, members))].reshape(-1, 8)
        smooth = np.concatenate(
            [_merge_error(octree, part) <= tolerance for part in np.array_split(families, 1 + len(families) // 50000)]
        )
        if not smooth.any():
            continue
        octree = _merged(octree, families[smooth])
    return octree


def _keys(ijk: np.ndarray, level: int) -> np.ndarray:
    x, y, z = ijk.astype(np.int64).T  # three levels' worth of bits
    return (x << 2 * level) + (y << level) + z


def _merge_error(octree: Octree, families: np.ndarray) -> np.ndarray:
    """(m,) error of replacing families (m, 8) by their parents."""
    vertices = np.empty((len(families), 27), dtype=np.int64)
    vertices[:, LATTICE_OF_CORNER.reshape(-1)] = octree.corners[families].reshape(len(families), 64)
    corners = vertices[:, (OFFSETS * 2) @ LATTICE_STRIDES]
    weights = LATTICE_WEIGHTS.T.astype(np.float32)
    edge = octree.leaf_sizes()[families[:, :1]]
    scale = octree.density_scale * edge
    raw = octree.density.astype(np.float32)
    truth = -np.expm1(-scale * explin(raw[vertices]))
    guess = -np.expm1(-scale * explin(raw[corners] @ weights))
    error = np.abs(guess - truth).max(1)
    sh = octree.sh
    for channel in range(3):
        for k in range(sh.shape[-1]):
            own = sh[:, channel, k]
            change = np.abs(own[corners] @ weights - own[vertices])
            # |Y_k| <= sqrt((2 l + 1) / (4 pi))
            bound = math.sqrt((2 * math.isqrt(k) + 1) / (4 * math.pi))
            error = np.maximum(error, bound * (change * truth).max(1))
    return error


def _merged(octree: Octree, families: np.ndarray) -> Octree:
    """The octree with families (m, 8) of leaves replaced by their parents; values of kept vertices are copied."""
    gone = np.zeros(octree.n_leaves, dtype=bool)
    gone[families.reshape(-1)] = True
    level = np.concatenate([octree.leaf_level[~gone], octree.leaf_level[families[:, 0]] - 1])
    ijk = np.concatenate([octree.leaf_ijk[~gone], octree.leaf_ijk[families[:, 0]] >> 1])
    new = Octree.from_leaves(level, ijk, octree.origin.tolist(), octree.size, octree.sh_degree, octree.density_scale)
    finest = octree.max_level

    def lattice(tree: Octree) -> np.ndarray:
        at = np.rint((tree.vertex_positions() - octree.origin) * (2.0**finest / octree.size)).astype(np.int64)
        return (at[:, 0] << 40) + (at[:, 1] << 20) + at[:, 2]

    old = lattice(octree)
    order = np.argsort(old)
    new.values[:] = octree.values[order[np.searchsorted(old[order], lattice(new))]]
    return new
