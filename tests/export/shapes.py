"""Shapes whose exports are known: a ball in shades, and a cube of which one half is red and the other blue."""

from __future__ import annotations

import numpy as np

from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree

CENTER, RADIUS = np.array([0.3, -0.2, 0.25]), 0.6
"""Off the middle of everything, so that turned or mirrored axes show."""
LOW, HIGH = np.array([-0.5, 0.25, -0.75]), np.array([0.5, 0.75, 0.25])
"""Corners of the cube, of three different extents; x < 0 is red, x > 0 blue."""
RED, BLUE = (0.75, 0.125, 0.0625), (0.0625, 0.25, 0.75)
ORIGIN, SIZE = (-1.0, -1.0, -1.0), 2.0
_Y00 = 0.28209479177387814


def _leaves(level: int, keep) -> np.ndarray:
    n = 1 << level
    cells = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return cells[keep(ORIGIN + (cells + 0.5) * (SIZE / n))]


def ball(level: int = 5, degree: int = 0) -> Octree:
    """Opaque inside RADIUS of CENTER; the raw density crosses 0 there with a slope of one leaf."""
    side = SIZE / (1 << level)
    cells = _leaves(level, lambda p: np.abs(np.linalg.norm(p - CENTER, axis=1) - RADIUS) < 2.5 * side)
    octree = Octree.from_leaves(np.full(len(cells), level), cells, ORIGIN, SIZE, degree, 20.0 / side)
    places = octree.vertex_positions()
    octree.density = np.clip((RADIUS - np.linalg.norm(places - CENTER, axis=1)) / side * 8, -9, 8)
    sh = np.zeros((octree.n_vertices, 3, (degree + 1) ** 2))
    sh[:, :, 0] = (0.5 + 0.3 * (places - CENTER) / RADIUS - 0.5) / _Y00
    octree.sh = sh
    return octree


def box(level: int = 4, mixed: bool = True) -> Octree:
    """The cube of LOW and HIGH, of optical depth 4 along a leaf of ``level``; half of its leaves are one level coarser if
    mixed."""

    def inside(p):
        return ((p > LOW) & (p < HIGH)).all(axis=1)

    coarse = _leaves(level - 1, inside)
    split = coarse[:, 2] % 2 == 0 if mixed else np.ones(len(coarse), bool)
    fine = (2 * coarse[split][:, None] + OFFSETS).reshape(-1, 3)
    levels = np.repeat([level, level - 1], [len(fine), int((~split).sum())])
    octree = Octree.from_leaves(levels, np.concatenate([fine, coarse[~split]]), ORIGIN, SIZE, 0, 1.0)
    octree.density = 4.0 * (1 << level) / SIZE
    red = octree.vertex_positions()[:, :1] < -1e-9
    octree.sh = ((np.where(red, RED, BLUE) - 0.5) / _Y00)[:, :, None]
    return octree
