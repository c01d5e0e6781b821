"""Leaves of several sizes: eight sibling leaves become one where nothing is lost by it."""

from __future__ import annotations

import math

import numpy as np

from nerfvol.native import native
from nerfvol.octree.rows import DENSITY_SLOT, explin, sh_slots
from nerfvol.octree.topology import (
    LATTICE_OF_CORNER,
    LATTICE_STRIDES,
    LATTICE_WEIGHTS,
    OFFSETS,
    build_masks,
    demorton,
    morton,
    renumber_corners,
)
from nerfvol.octree.tree import Octree


def merge_smooth(octree: Octree, coarsest: int, tolerance: float) -> Octree:
    """Replace eight sibling leaves by one where its trilinear field is theirs to within ``tolerance``.

    The error is the largest, over the 27 points of the siblings' lattice, of the change in opacity of a sibling and of
    the change in colour times the sibling's opacity. Repeats level by level, up to leaves of level ``coarsest``.
    """
    if tolerance <= 0:
        return octree
    codes, corners, starts = morton(octree.leaf_ijk), octree.corners, np.searchsorted(octree.leaf_level, range(18))
    levels: list[tuple[int, np.ndarray, np.ndarray]] = []  # of the result, finest first: level, codes, corners
    merged = codes[:0], corners[:0]  # leaves of the level at hand that were eight of the next
    for level in range(octree.max_level, 0, -1):
        own = slice(starts[level], starts[level + 1])
        code, corner = np.concatenate([codes[own], merged[0]]), np.concatenate([corners[own], merged[1]])
        if len(merged[0]):
            order = np.argsort(code)
            code, corner = code[order], np.ascontiguousarray(corner[order])
        whole = np.zeros(len(code), bool)
        if level > max(coarsest, 1):
            # Siblings are neighbours in Morton order.
            first = np.flatnonzero(code[: max(len(code) - 7, 0)] & 7 == 0)
            first = first[code[first + 7] == code[first] + 7]
            first = first[_merge_errors(octree, corner, first, octree.size / 2**level) <= tolerance]
            members = first[:, None] + np.arange(8)
            whole[members] = True
            merged = code[first] >> 3, corner[members, np.arange(8)]
        else:
            merged = codes[:0], corners[:0]
        levels.append((level, code[~whole], corner[~whole]))
    return _of_leaves(octree, levels[::-1])


def _merge_errors(octree: Octree, corners: np.ndarray, first: np.ndarray, side: float) -> np.ndarray:
    """(m,) errors of replacing families by their parents; first (m,): of a family's eight leaves in corners (n, 8)."""
    compiled = native()
    if compiled is None:
        parts = np.array_split(first, 1 + len(first) // 50000)
        return np.concatenate([_merge_error(octree, corners[part[:, None] + np.arange(8)], side) for part in parts])
    error = np.empty(len(first), np.float32)
    compiled.merge_errors(
        values=octree.values, density=DENSITY_SLOT, slots=sh_slots(octree.sh_degree).reshape(-1).astype(np.int32),
        bounds=np.tile([_largest(k) for k in range((octree.sh_degree + 1) ** 2)], 3).astype(np.float32),
        corners=corners, first=first, scale=np.full(len(first), octree.density_scale * side, np.float32), error=error,
    )  # fmt: skip
    return error


def _largest(k: int) -> float:
    """Bound of the k-th spherical harmonic: |Y_k| <= sqrt((2 l + 1) / (4 pi))."""
    return math.sqrt((2 * math.isqrt(k) + 1) / (4 * math.pi))


def _merge_error(octree: Octree, family_corners: np.ndarray, side: float) -> np.ndarray:
    """:func:`_merge_errors` of families of leaves with corners (m, 8, 8)."""
    vertices = np.empty((len(family_corners), 27), dtype=np.int64)
    vertices[:, LATTICE_OF_CORNER.reshape(-1)] = family_corners.reshape(-1, 64)
    corners = vertices[:, (OFFSETS * 2) @ LATTICE_STRIDES]
    weights = LATTICE_WEIGHTS.T.astype(np.float32)
    scale = octree.density_scale * side
    raw = octree.density.astype(np.float32)
    truth = -np.expm1(-scale * explin(raw[vertices]))
    guess = -np.expm1(-scale * explin(raw[corners] @ weights))
    error = np.abs(guess - truth).max(1)
    sh = octree.sh
    for channel in range(3):
        for k in range(sh.shape[-1]):
            own = sh[:, channel, k]
            change = np.abs(own[corners] @ weights - own[vertices])
            error = np.maximum(error, _largest(k) * (change * truth).max(1))
    return error


def _of_leaves(octree: Octree, levels: list[tuple[int, np.ndarray, np.ndarray]]) -> Octree:
    """An octree of leaves whose corners are vertices of ``octree``, coarsest level first: level, Morton codes (rising)
    and corners (n, 8); vertices that none of them has are left out."""
    level = np.repeat(np.array([row[0] for row in levels], np.int8), [len(row[1]) for row in levels])
    ijk = np.concatenate([demorton(code) for _, code, _ in levels]).astype(np.int32)
    old = np.concatenate([corner for _, _, corner in levels])
    new = octree._in_same_frame(*build_masks(level, ijk))
    new.leaf_level, new.leaf_ijk = level, ijk
    new.corners, new._n_vertices = renumber_corners(old, np.arange(len(old), dtype=np.int32), octree.n_vertices)
    vertex = np.empty(new.n_vertices, np.int64)
    vertex[new.corners] = old
    new.values = octree.values[vertex]
    return new
