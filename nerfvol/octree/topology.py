"""From leaves to an octree's arrays: child masks, the numbering of corners, and how rows follow a change of topology.

The conventions are octree/tree.py's; what takes long has a compiled twin in kernels/csrc/topology.cpp. Arrays that live
as long as an octree are as narrow as they can be: levels int8, positions int32; arithmetic that could leave them is int64.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerfvol.errors import InputError
from nerfvol.native import aligned, aligned_empty, native

MAX_LEVEL = 16
OFFSETS = np.array([[o >> 2 & 1, o >> 1 & 1, o & 1] for o in range(8)], dtype=np.int64)
POPCOUNT = np.array([bin(i).count("1") for i in range(256)], dtype=np.int64)


def morton(ijk: np.ndarray) -> np.ndarray:
    """Interleaved bits (x highest) of integer positions (n, 3) < 2**20: (n,) int64."""
    code = np.zeros(len(ijk), dtype=np.int64)
    for axis in range(3):
        v = ijk[:, axis].astype(np.int64)
        v = (v | v << 32) & 0x1F00000000FFFF
        v = (v | v << 16) & 0x1F0000FF0000FF
        v = (v | v << 8) & 0x100F00F00F00F00F
        v = (v | v << 4) & 0x10C30C30C30C30C3
        v = (v | v << 2) & 0x1249249249249249
        code |= v << (2 - axis)
    return code


def demorton(code: np.ndarray) -> np.ndarray:
    """Inverse of :func:`morton`: (n,) -> (n, 3) int64."""
    out = np.empty((len(code), 3), dtype=np.int64)
    for axis in range(3):
        v = (code >> (2 - axis)) & 0x1249249249249249
        v = (v | v >> 2) & 0x10C30C30C30C30C3
        v = (v | v >> 4) & 0x100F00F00F00F00F
        v = (v | v >> 8) & 0x1F0000FF0000FF
        v = (v | v >> 16) & 0x1F00000000FFFF
        v = (v | v >> 32) & 0x1FFFFF
        out[:, axis] = v
    return out


@dataclass(frozen=True)
class Transfer:
    """How per-vertex and per-leaf arrays follow a change of topology.

    parent: (n_leaves_new,) the old leaf that each new leaf is or lies in. old_corners: (n_leaves_old, 8). For each new
    vertex, source: (n_vertices_new,) an old leaf, and place: index into the 27 points of that leaf's 3x3x3 lattice.
    """

    parent: np.ndarray
    old_corners: np.ndarray
    source: np.ndarray
    place: np.ndarray

    def vertices(self, rows: np.ndarray) -> np.ndarray:
        """Old per-vertex rows (n_vertices_old, k), interpolated at the new vertices."""
        out = aligned_empty((len(self.place), rows.shape[1]), rows.dtype)
        compiled = native()
        if compiled is not None and rows.dtype == np.float32:
            compiled.interpolate(np.ascontiguousarray(rows), self.old_corners, self.source, self.place, out)
            return out
        weights = LATTICE_WEIGHTS.astype(rows.dtype)
        for start in range(0, len(out), 65536):
            part = slice(start, start + 65536)
            w, corners = weights[self.place[part]], self.old_corners[self.source[part]]
            total = w[:, :1] * rows[corners[:, 0]]
            for o in range(1, 8):
                total += w[:, o : o + 1] * rows[corners[:, o]]
            out[part] = total
        return out


# The 27 points of a leaf's 3x3x3 lattice (index 9 x + 3 y + z) and their trilinear weights at its corners (27, 8).
_LATTICE = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)
LATTICE_WEIGHTS = np.prod(np.where(OFFSETS[None] == 1, _LATTICE[:, None] / 2, 1 - _LATTICE[:, None] / 2), axis=-1)
_LATTICE_CORNERS = np.flatnonzero((_LATTICE % 2 == 0).all(1))
LATTICE_STRIDES = np.array([9, 3, 1])
LATTICE_OF_CORNER = (OFFSETS[:, None] + OFFSETS) @ LATTICE_STRIDES  # (child, corner of the child) -> index of the point


def build_masks(level: np.ndarray, ijk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Breadth-first node_mask, leaf_mask (n_nodes,) uint8 of the octree with these leaves, in any order.

    level (n,), ijk (n, 3): whole numbers. Raises InputError where leaves overlap.
    """
    node_masks, leaf_masks = [], []
    nodes_below = np.empty(0, dtype=np.int64)  # Morton codes of interior nodes one level down
    for above in range(int(level.max()) - 1, -1, -1):
        leaves = np.sort(morton(ijk[level == above + 1]))
        if (np.diff(leaves) == 0).any() or np.isin(leaves, nodes_below, assume_unique=True).any():
            raise InputError("leaves overlap: one is given twice or lies inside another")
        parents_l, parents_n = leaves >> 3, nodes_below >> 3
        nodes = np.sort(np.concatenate([parents_l, parents_n]))
        nodes = nodes[np.concatenate([[True], nodes[1:] != nodes[:-1]])]
        masks = []
        for children, parents in ((leaves, parents_l), (nodes_below, parents_n)):
            at = np.searchsorted(nodes, parents)
            bits = np.bincount(at, weights=1 << (children & 7), minlength=len(nodes))  # distinct bits: a sum is an or
            masks.append(bits.astype(np.uint8))
        leaf_masks.append(masks[0])
        node_masks.append(masks[1])
        nodes_below = nodes
    return np.concatenate(node_masks[::-1]), np.concatenate(leaf_masks[::-1])


def pruned_masks(node_mask: np.ndarray, leaf_mask: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the octree without the leaves where ``keep`` (n_leaves,) is false; at least one must stay."""
    leaves = bits_of(leaf_mask)
    leaves[leaves] = keep
    leaf_mask = np.packbits(leaves, axis=1, bitorder="little")[:, 0]
    starts = level_starts(node_mask)
    node_mask, alive = node_mask.copy(), leaf_mask != 0
    for i in range(len(starts) - 3, -1, -1):
        level, below = slice(starts[i], starts[i + 1]), slice(starts[i + 1], starts[i + 2])
        nodes = bits_of(node_mask[level])
        nodes[nodes] = alive[below]
        node_mask[level] = np.packbits(nodes, axis=1, bitorder="little")[:, 0]
        alive[level] |= node_mask[level] != 0
    return node_mask[alive], leaf_mask[alive]


def level_starts(node_mask: np.ndarray) -> list[int]:
    """Where the nodes of each level begin, from the root's, and behind them where the last level ends.

    node_mask: (n_nodes,) uint8; one number more than there are levels of nodes, the first 0, the last n_nodes. InputError
    where nodes do not hang on the root or lie too deep.
    """
    starts = [0, 1]
    while starts[-1] < len(node_mask):
        starts.append(starts[-1] + int(POPCOUNT[node_mask[starts[-2] : starts[-1]]].sum()))
        if starts[-1] == starts[-2]:  # links that sum up but loop: nodes that the walk from the root never meets
            raise InputError(f"octree: only {starts[-1]} of {len(node_mask)} nodes hang on the root")
        if len(starts) > MAX_LEVEL + 1:
            raise InputError(f"octree: deeper than {MAX_LEVEL} levels")
    return starts


def place_nodes(node_mask: np.ndarray, starts: list[int]) -> np.ndarray:
    """Positions (n_nodes, 3) int32 of the nodes, each in units of its side; starts as :func:`level_starts` has them."""
    codes = [np.zeros(1, dtype=np.int64)]
    for start, end in zip(starts[:-2], starts[1:-1], strict=True):
        codes.append((codes[-1][:, None] * 8 + np.arange(8))[bits_of(node_mask[start:end])])
    return demorton(np.concatenate(codes)).astype(np.int32)


def bits_of(mask: np.ndarray) -> np.ndarray:
    """(n,) uint8 as (n, 8) bool, lowest bit first."""
    return np.unpackbits(mask[:, None], axis=1, bitorder="little").view(bool)


def first_children(node_mask: np.ndarray, leaf_mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """first_node, first_leaf (n_nodes,) int32 from the masks; InputError where they contradict themselves."""
    if node_mask.ndim != 1 or node_mask.shape != leaf_mask.shape or len(node_mask) == 0:
        raise InputError(
            f"octree masks must be two equal, non-empty vectors, got {node_mask.shape} and {leaf_mask.shape}"
        )
    if (node_mask & leaf_mask).any():
        raise InputError("octree: a child is marked both as an interior node and as a leaf")
    n_children, n_leaves = POPCOUNT[node_mask], POPCOUNT[leaf_mask]
    if n_children.sum() != len(node_mask) - 1:
        raise InputError(f"octree: {len(node_mask)} nodes but {n_children.sum()} links to nodes; expected one less")
    if n_leaves.sum() == 0:
        raise InputError("octree: no leaves")
    first_node = (1 + np.cumsum(n_children) - n_children).astype(np.int32)
    return first_node, (np.cumsum(n_leaves) - n_leaves).astype(np.int32)


def place_leaves(node_mask: np.ndarray, leaf_mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Level (n_leaves,) int8 and position (n_leaves, 3) int32 of the leaves, by walking the tree from its root.

    Raises InputError where nodes do not hang on the root or lie too deep.
    """
    level, ijk = [], []
    start, end = 0, 1
    codes = np.zeros(1, dtype=np.int64)  # of the nodes in [start, end), all of one level
    for depth in range(1, MAX_LEVEL + 1):
        child = codes[:, None] * 8 + np.arange(8)
        leaves = child[bits_of(leaf_mask[start:end])]
        level.append(np.full(len(leaves), depth, dtype=np.int8))
        ijk.append(demorton(leaves).astype(np.int32))
        codes = child[bits_of(node_mask[start:end])]
        if not len(codes):
            break
        start, end = end, end + len(codes)
    else:
        raise InputError(f"octree: deeper than {MAX_LEVEL} levels")
    if end != len(node_mask):  # links that sum up but loop: nodes that the walk from the root never meets
        raise InputError(f"octree: only {end} of {len(node_mask)} nodes hang on the root")
    return np.concatenate(level), np.concatenate(ijk)


def number_corners(level: np.ndarray, ijk: np.ndarray) -> tuple[np.ndarray, int]:
    """Corners (n, 8) int32 with vertices numbered in the order in which leaves name them, and how many vertices.

    level (n,) int8, ijk (n, 3) int32, both contiguous.
    """
    n = len(level)
    compiled = native()
    if compiled is not None:
        ids = aligned_empty((n, 8), np.int32)
        return ids, compiled.number_corners(level, ijk, int(level.max()), ids)
    scale = 1 << (int(level.max()) - level.astype(np.int64)).reshape(-1, 1)
    keys = np.stack([morton((ijk + OFFSETS[o]) * scale) for o in range(8)], 1).reshape(-1)
    return _by_first_naming(keys, n)


def renumber_corners(corners: np.ndarray, kept: np.ndarray, n_vertices: int) -> tuple[np.ndarray, int]:
    """:func:`number_corners` of the leaves ``kept`` (m,) int32, rising, of an octree with these corners."""
    compiled = native()
    if compiled is not None:
        ids = aligned_empty((len(kept), 8), np.int32)
        return ids, compiled.renumber_corners(corners, kept, n_vertices, ids)
    return _by_first_naming(corners[kept].reshape(-1), len(kept))


def _by_first_naming(keys: np.ndarray, n: int) -> tuple[np.ndarray, int]:
    """Equal keys (8 n,) get equal numbers, counted up in the order of their first appearance."""
    _, at, inverse = np.unique(keys, return_index=True, return_inverse=True)
    rank = np.empty(len(at), np.int32)
    rank[np.argsort(at)] = np.arange(len(at), dtype=np.int32)
    return aligned(rank[inverse].reshape(n, 8), np.int32), len(at)


def find_sources(
    corners: np.ndarray, n_vertices: int, parent: np.ndarray, octant: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """source and place of :class:`Transfer`; a corner of an old leaf beats a point inside one, the first leaf a later.

    corners (n, 8) int32 of the new leaves; parent (n,) int32; octant (n,) int8: which child of its parent a new leaf is,
    -1 for the old leaf itself.
    """
    source, place = np.empty(n_vertices, np.int32), np.empty(n_vertices, np.int8)
    compiled = native()
    if compiled is not None:
        compiled.find_sources(corners, parent, octant, source, place)
        return source, place
    inside = OFFSETS[np.maximum(octant, 0)][:, None] + OFFSETS
    lattice = np.where((octant < 0)[:, None, None], OFFSETS * 2, inside)
    places = (lattice @ LATTICE_STRIDES).astype(np.int8).ravel()
    leaves, flat = np.repeat(parent, 8), corners.ravel()
    is_corner = np.isin(places, _LATTICE_CORNERS)
    for chosen in (np.flatnonzero(~is_corner)[::-1], np.flatnonzero(is_corner)[::-1]):  # the first one is written last
        source[flat[chosen]] = leaves[chosen]
        place[flat[chosen]] = places[chosen]
    return source, place
