"""What a distilled octree holds at its vertices: a field's coefficient and spherical harmonics, averaged around each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerfvol import sh as spherical
from nerfvol.field.layout import PointField
from nerfvol.octree.rows import DENSITY_SLOT, EMPTY_DENSITY, explin_inverse, sh_slots
from nerfvol.octree.tree import Octree
from nerfvol.starts import cells

REACH, WIDE_REACH = 0.125, 0.25
"""How far around a vertex a field is averaged, in sides of a leaf: what loses least (docs/experiments.md), and what sees walls
half as thick as a leaf that stand in the middle of it."""
THICKEST = 20.0
"""Optical thickness of a leaf beyond which it is opaque: larger numbers change nothing and are hard to optimise."""
_TETRAHEDRON = 4 * cells.TETRAHEDRON - 2  # corners at -1 and 1
_FAINT = 1e-6  # coefficient that colour counts with where there is none: empty space has its own colour, not 0 / 0


def write_values(octree: Octree, field: PointField, reach: float = REACH) -> None:
    """Fill an octree's vertices from a field.

    A vertex is the mean over four points around it, corners of a tetrahedron, ``reach`` away along each axis in sides of the
    finest leaf that has the vertex, or with ``reach`` 0 the vertex itself; colour is weighted by the coefficient, so that
    space in front of a surface has its colour.
    """
    positions, spacing = octree.vertex_positions(), finest_sides(octree)
    to_sh, slots = sh_of(field, octree.sh_degree), sh_slots(octree.sh_degree).reshape(-1)
    offsets = reach * _TETRAHEDRON if reach else np.zeros((1, 3))
    some = max(1, cells.CHUNK // len(offsets))
    values = octree.values
    for start in range(0, octree.n_vertices, some):
        part = slice(start, start + some)
        rows = cells.evaluate(to_sh, positions[part], spacing[part, None, None] * offsets)
        sigmas = rows[..., 0].astype(np.float64)
        weights = sigmas + _FAINT
        weights /= weights.sum(1, keepdims=True)
        values[part, slots] = (weights[:, None] @ rows[..., 1:])[:, 0]
        sigma = np.minimum(sigmas.mean(1), THICKEST / spacing[part])
        raw = explin_inverse(np.maximum(sigma / octree.density_scale, 1e-30))
        values[part, DENSITY_SLOT] = np.maximum(raw, EMPTY_DENSITY)
    octree.prefiltered = None


def finest_sides(octree: Octree) -> np.ndarray:
    """(n_vertices,) side of the finest leaf that has the vertex, scene units."""
    sides = np.empty(octree.n_vertices)
    for level in np.unique(octree.leaf_level):  # leaves lie in this order: finer ones overwrite
        sides[octree.corners[octree.leaf_level == level]] = octree.size / 2.0 ** int(level)
    return sides


def sh_of(field: PointField, degree: int) -> Callable[[np.ndarray], np.ndarray]:
    """Function from positions (n, 3) to rows (n, 1 + 3 * basis_dim): coefficient, then SH by channel."""
    dim = spherical.basis_dim(degree)
    if field.has_sh:

        def from_head(points: np.ndarray) -> np.ndarray:
            sigma, sh = field.sh(points)
            rows = np.zeros((len(points), 1 + 3 * dim), np.float32)
            held = min(dim, sh.shape[-1])
            rows[:, 0], rows[:, 1:].reshape(-1, 3, dim)[..., :held] = sigma, sh[..., :held]
            return rows

        return from_head
    dirs, weights = _sphere(degree + 3)
    projector = (weights[:, None] * spherical.eval_basis(degree, dirs)).astype(np.float32)

    def by_quadrature(points: np.ndarray) -> np.ndarray:
        rows = np.zeros((len(points), 3, dim), np.float32)
        sigma = np.zeros(len(points), np.float32)
        for direction, row in zip(dirs.astype(np.float32), projector, strict=True):
            sigma, rgb = field(points, np.broadcast_to(direction, points.shape))
            rows += (rgb - np.float32(0.5))[..., None] * row
        return np.concatenate([sigma[:, None], rows.reshape(len(points), -1)], axis=1)

    return by_quadrature


def _sphere(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights of a product quadrature, exact for polynomials of degree < 2 n."""
    z, w = np.polynomial.legendre.leggauss(n)
    z, phi = (a.reshape(-1) for a in np.meshgrid(z, np.pi * np.arange(2 * n) / n, indexing="ij"))
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1), np.repeat(w, 2 * n) * np.pi / n
