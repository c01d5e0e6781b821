"""The field of an octree at points: density and colour coefficients, for exporters, truth and tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nerfvol.octree.rows import explin
from nerfvol.octree.tree import Octree

Float = NDArray[np.float64]


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
