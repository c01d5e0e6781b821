"""The field of an octree at points and in the middle of leaves: density and colour, for exporters, truth and tests."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nerfvol.octree.rows import explin, sh_slots
from nerfvol.octree.tree import Octree

Float = NDArray[np.float64]
Y00 = math.sqrt(1 / (4 * math.pi))
"""The constant spherical harmonic."""


def octree_density(octree: Octree, points: Float) -> Float:
    """Extinction of ``octree`` at points (n, 3), 1/unit: (n,); 0 in empty space."""
    inside, raw = _interpolated(octree, points, octree.density[:, None])
    sigma = np.zeros(len(points))
    sigma[inside] = octree.density_scale * explin(raw[:, 0])
    return sigma


def octree_colour(octree: Octree, points: Float) -> Float:
    """Colour of ``octree`` at points (n, 3), the mean over all directions, not clipped: (n, 3); 0 in empty space."""
    inside, constant = _interpolated(octree, points, octree.values[:, sh_slots(octree.sh_degree)[:, 0]])
    colour = np.zeros((len(points), 3))
    colour[inside] = 0.5 + Y00 * constant
    return colour


def _interpolated(octree: Octree, points: Float, rows: NDArray) -> tuple[NDArray[np.int64], Float]:
    """Which points lie in leaves (m,), and the trilinear values (m, k) there of ``rows`` (n_vertices, k)."""
    leaf = octree.query(points)
    inside = np.flatnonzero(leaf >= 0)
    sides = octree.size / 2.0 ** octree.leaf_level[leaf[inside]].astype(np.float64)
    place = (points[inside] - octree.origin) / sides[:, None] - octree.leaf_ijk[leaf[inside]]
    values = np.zeros((len(inside), rows.shape[1]))
    for o, corner in enumerate(np.ndindex(2, 2, 2)):
        weight = np.prod(np.where(corner, place, 1 - place), axis=1)
        values += weight[:, None] * rows[octree.corners[leaf[inside], o]]
    return inside, values


def at_leaves(octree: Octree, rows: NDArray) -> Float:
    """What ``rows`` (n_vertices, ...) are in the middle of the leaves: (n_leaves, ...), the mean of the eight corners."""
    total = np.zeros((octree.n_leaves, *rows.shape[1:]))
    for corner in range(8):
        total += rows[octree.corners[:, corner]]
    return total / 8


def leaf_density(octree: Octree) -> Float:
    """Extinction in the middle of each leaf, 1/unit: (n_leaves,)."""
    return octree.density_scale * explin(at_leaves(octree, octree.density))


def leaf_colour(octree: Octree) -> Float:
    """Colour in the middle of each leaf, the mean over all directions, not clipped: (n_leaves, 3)."""
    return 0.5 + Y00 * at_leaves(octree, octree.values[:, sh_slots(octree.sh_degree)[:, 0]])
