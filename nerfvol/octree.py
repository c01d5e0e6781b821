"""The sparse octree: topology, trilinear vertex values, and the operations that change it.

Conventions, once for the whole module:

- The root cube has its smallest corner at ``origin`` (scene units) and side ``size``. A cell of level l has side
  ``size / 2**l`` and integer position ``ijk`` in units of that side.
- Octant o of a node lies at offsets ``(o >> 2 & 1, o >> 1 & 1, o & 1)`` along x, y, z; corners of a leaf likewise.
- Interior nodes stand in breadth-first order, by Morton code within a level. Two bits per child say what it is:
  ``node_mask`` an interior node, ``leaf_mask`` a leaf, neither: empty space. Where the children stand follows from
  counting bits, so there are no links that could be wrong.
- Leaves stand in the order in which the nodes name them: by level, then by Morton code.
- The field is trilinear inside a leaf between values at its eight corners, shared by all leaves that have that corner
  (a finer leaf's corner on the face of a coarser one belongs to the finer leaf alone).
- sigma = density_scale * explin(raw density); colour = 1/2 + sum_k sh_k Y_k(d), not clamped inside the integral.

Sources: sparse voxels with trilinear corner values, Plenoxels (2022) and SVRaster (2025); breadth-first child masks,
Laine & Karras, *Efficient Sparse Voxel Octrees* (2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfvol.errors import InputError
from nerfvol.native import aligned, aligned_empty, native

MAX_LEVEL = 16
EMPTY_DENSITY = -7.0
OFFSETS = np.array([[o >> 2 & 1, o >> 1 & 1, o & 1] for o in range(8)], dtype=np.int64)
BLOCKS = {0: 1, 1: 1, 2: 2, 3: 4}
DENSITY_SLOT = 12


def explin(raw: np.ndarray) -> np.ndarray:
    """exp(raw - 1) below 1, raw above: positive, with a bounded slope [SVRaster]. Any shape."""
    return np.where(raw < 1, np.exp(np.minimum(raw, 1) - 1), raw)


def explin_inverse(value: np.ndarray) -> np.ndarray:
    """The raw density whose :func:`explin` is ``value`` > 0."""
    return np.where(value < 1, np.log(np.minimum(value, 1)) + 1, value)


def sh_slots(degree: int) -> np.ndarray:
    """Where coefficient k of channel c stands in a vertex row: (3, (degree + 1)**2) int. Density stands at slot 12.

    Rows are blocks of 16: four coefficients of red, four of green, four of blue, four spare places (the first block's
    hold the density, the second's the ninth coefficients of degree 2).
    """
    k = np.arange((degree + 1) ** 2)
    c = np.arange(3)[:, None]
    slots = 16 * (k // 4) + 4 * c + k % 4
    return np.where((k == 8) & (degree == 2), 28 + c, slots)


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
        weights = _LATTICE_WEIGHTS.astype(rows.dtype)
        for start in range(0, len(out), 65536):
            part = slice(start, start + 65536)
            w, corners = weights[self.place[part]], self.old_corners[self.source[part]]
            total = w[:, :1] * rows[corners[:, 0]]
            for o in range(1, 8):
                total += w[:, o : o + 1] * rows[corners[:, o]]
            out[part] = total
        return out


# The 27 points of a leaf's 3x3x3 lattice (index 9 x + 3 y + z) and their trilinear weights at its corners.
_LATTICE = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)
_LATTICE_WEIGHTS = np.prod(np.where(OFFSETS[None] == 1, _LATTICE[:, None] / 2, 1 - _LATTICE[:, None] / 2), axis=-1)
_LATTICE_CORNERS = np.flatnonzero((_LATTICE % 2 == 0).all(1))
_STRIDES = np.array([9, 3, 1])


class Octree:
    """See the module's head for the conventions.

    Attributes: origin (3,) float64; size, density_scale float; sh_degree 0-3; node_mask, leaf_mask (n_nodes,) uint8;
    first_node, first_leaf (n_nodes,) int32; leaf_level (n_leaves,) int64; leaf_ijk (n_leaves, 3) int64;
    corners (n_leaves, 8) int32; values (n_vertices, 16 * blocks) float32, packed rows. The last two begin on a cache
    line; values that do not are copied when they are assigned.
    """

    def __init__(self, node_mask, leaf_mask, *, origin, size: float, sh_degree: int, density_scale: float):
        self.node_mask = np.ascontiguousarray(node_mask, dtype=np.uint8)
        self.leaf_mask = np.ascontiguousarray(leaf_mask, dtype=np.uint8)
        self.origin = np.asarray(origin, dtype=np.float64).reshape(3)
        self.size = float(size)
        self.sh_degree = int(sh_degree)
        self.density_scale = float(density_scale)
        _check_frame(self)
        self.first_node, self.first_leaf, self.leaf_level, self.leaf_ijk = _expand_topology(
            self.node_mask, self.leaf_mask
        )
        self.corners, self._vertex_ijk = _number_corners(self.leaf_level, self.leaf_ijk)
        self._values = aligned_empty((len(self._vertex_ijk), 16 * BLOCKS[self.sh_degree]), np.float32)
        self._values[:] = 0
        self._values[:, DENSITY_SLOT] = EMPTY_DENSITY

    @classmethod
    def from_leaves(
        cls, level, ijk, origin: Sequence[float], size: float, sh_degree: int = 1, density_scale: float = 1.0
    ) -> Octree:
        """An octree with the given leaves, in any order; values are zero and raw density is -7 (nearly empty).

        level: (n,) ints 1..16; ijk: (n, 3) ints in [0, 2**level). Raises InputError where leaves lie outside the root
        or overlap.
        """
        level = np.asarray(level, dtype=np.int64).reshape(-1)
        ijk = np.asarray(ijk, dtype=np.int64).reshape(-1, 3)
        if len(level) != len(ijk):
            raise InputError(f"level has {len(level)} leaves but ijk has {len(ijk)}")
        if len(level) == 0:
            raise InputError("an octree needs at least one leaf, got none")
        if level.min() < 1 or level.max() > MAX_LEVEL:
            raise InputError(f"leaf levels must lie in 1..{MAX_LEVEL}, got {level.min()}..{level.max()}")
        if (ijk < 0).any() or (ijk >= (1 << level)[:, None]).any():
            raise InputError("leaf positions must lie in [0, 2**level), some do not")
        node_mask, leaf_mask = _build_masks(level, ijk)
        return cls(node_mask, leaf_mask, origin=origin, size=size, sh_degree=sh_degree, density_scale=density_scale)

    # ------------------------------------------------------------------ sizes and places
    @property
    def n_nodes(self) -> int:
        return len(self.node_mask)

    @property
    def n_leaves(self) -> int:
        return len(self.corners)

    @property
    def n_vertices(self) -> int:
        return len(self._vertex_ijk)

    @property
    def max_level(self) -> int:
        return int(self.leaf_level.max())

    def leaf_sizes(self) -> np.ndarray:
        """Side of each leaf in scene units: (n_leaves,) float64."""
        return self.size / 2.0**self.leaf_level

    def leaf_centers(self) -> np.ndarray:
        """(n_leaves, 3) float64, scene units."""
        return self.origin + (self.leaf_ijk + 0.5) * self.leaf_sizes()[:, None]

    def vertex_positions(self) -> np.ndarray:
        """(n_vertices, 3) float64, scene units."""
        return self.origin + self._vertex_ijk * (self.size / 2.0**self.max_level)

    # ------------------------------------------------------------------ values
    @property
    def values(self) -> np.ndarray:
        """Packed vertex rows: (n_vertices, 16 * blocks) float32."""
        return self._values

    @values.setter
    def values(self, rows) -> None:
        self._values = aligned(np.asarray(rows), np.float32)

    @property
    def density(self) -> np.ndarray:
        """Raw density at the vertices: (n_vertices,), a view."""
        return self.values[:, DENSITY_SLOT]

    @density.setter
    def density(self, raw) -> None:
        self.values[:, DENSITY_SLOT] = raw

    @property
    def sh(self) -> np.ndarray:
        """Spherical-harmonic coefficients at the vertices: a copy (n_vertices, 3, (sh_degree + 1)**2); assign to change."""
        return self.values[:, sh_slots(self.sh_degree)]

    @sh.setter
    def sh(self, coefficients) -> None:
        self.values[:, sh_slots(self.sh_degree)] = coefficients

    def with_sh_degree(self, degree: int) -> Octree:
        """The same field with another SH degree: missing bands are zero, surplus ones are dropped."""
        other = Octree.__new__(Octree)
        other.__dict__.update(self.__dict__)
        other.sh_degree = int(degree)
        _check_frame(other)
        other.values = convert_rows(self.values, self.sh_degree, degree)
        return other

    # ------------------------------------------------------------------ queries
    def query(self, points) -> np.ndarray:
        """Index of the leaf that contains each point, -1 in empty space or outside: points (n, 3) -> (n,) int64.

        A leaf holds its lower faces and not its upper ones.
        """
        local = (np.asarray(points, dtype=np.float64).reshape(-1, 3) - self.origin) / self.size
        result = np.full(len(local), -1, dtype=np.int64)
        active = np.flatnonzero(((local >= 0) & (local < 1)).all(1))
        node = np.zeros(len(active), dtype=np.int64)
        for level in range(1, MAX_LEVEL + 1):
            cell = np.floor(local[active] * 2.0**level).astype(np.int64) & 1
            octant = cell @ np.array([4, 2, 1])
            below = (1 << octant) - 1
            leaves, nodes = self.leaf_mask[node].astype(np.int64), self.node_mask[node].astype(np.int64)
            is_leaf = (leaves >> octant & 1).astype(bool)
            is_node = (nodes >> octant & 1).astype(bool)
            leaf = self.first_leaf[node] + _POPCOUNT[leaves & below]
            result[active[is_leaf]] = leaf[is_leaf]
            node = (self.first_node[node] + _POPCOUNT[nodes & below])[is_node]
            active = active[is_node]
            if not len(active):
                break
        return result

    # ------------------------------------------------------------------ changes of topology
    def prune(self, keep) -> tuple[Octree, Transfer]:
        """Keeps the leaves where ``keep`` (n_leaves,) is true; the field inside them does not change."""
        keep = np.asarray(keep, dtype=bool).reshape(-1)
        if len(keep) != self.n_leaves:
            raise InputError(f"keep must have one entry per leaf ({self.n_leaves}), got {len(keep)}")
        kept = np.flatnonzero(keep)
        return self._rebuilt(self.leaf_level[kept], self.leaf_ijk[kept], kept, None)

    def subdivide(self, mask) -> tuple[Octree, Transfer]:
        """Splits the leaves where ``mask`` (n_leaves,) is true into eight.

        New vertices take the trilinear value of the leaf they came from, so the field is the same, save where a new
        vertex coincides with one that a finer neighbour already owned: that vertex keeps its value.
        """
        mask = np.asarray(mask, dtype=bool).reshape(-1)
        if len(mask) != self.n_leaves:
            raise InputError(f"mask must have one entry per leaf ({self.n_leaves}), got {len(mask)}")
        split, whole = np.flatnonzero(mask), np.flatnonzero(~mask)
        if len(split) and self.leaf_level[split].max() >= MAX_LEVEL:
            raise InputError(f"cannot subdivide below level {MAX_LEVEL}")
        level = np.concatenate([self.leaf_level[whole], np.repeat(self.leaf_level[split] + 1, 8)])
        children = (2 * self.leaf_ijk[split][:, None] + OFFSETS).reshape(-1, 3)
        ijk = np.concatenate([self.leaf_ijk[whole], children])
        parent = np.concatenate([whole, np.repeat(split, 8)])
        octant = np.concatenate([np.full(len(whole), -1), np.tile(np.arange(8), len(split))])
        return self._rebuilt(level, ijk, parent, octant)

    def _rebuilt(self, level, ijk, parent, octant) -> tuple[Octree, Transfer]:
        if len(level) == 0:
            raise InputError("this would leave an octree without leaves")
        node_mask, leaf_mask = _build_masks(level, ijk)
        new = Octree(
            node_mask,
            leaf_mask,
            origin=self.origin,
            size=self.size,
            sh_degree=self.sh_degree,
            density_scale=self.density_scale,
        )
        # Bring the description of the new leaves into the new octree's order.
        order = np.lexsort((morton(ijk), level))
        octant = np.full(len(order), -1, np.int8) if octant is None else octant[order].astype(np.int8)
        parent = parent[order]
        transfer = Transfer(parent, self.corners, *_find_sources(new, parent, octant))
        new.values = transfer.vertices(self.values)
        return new, transfer

    def validate(self) -> None:
        """Checks every invariant that the kernels rely on; raises InputError naming the first that fails."""
        fresh = Octree.__new__(Octree)
        fresh.__dict__.update(self.__dict__)
        _check_frame(fresh)
        first_node, first_leaf, level, ijk = _expand_topology(self.node_mask, self.leaf_mask)
        for name, array, wanted in (
            ("first_node", self.first_node, first_node),
            ("first_leaf", self.first_leaf, first_leaf),
            ("leaf_level", self.leaf_level, level),
            ("leaf_ijk", self.leaf_ijk, ijk),
        ):
            if not np.array_equal(array, wanted):
                raise InputError(f"octree: {name} does not follow from the masks")
        if self.corners.shape != (len(level), 8) or self.corners.min() < 0 or self.corners.max() >= self.n_vertices:
            raise InputError("octree: corners point outside the vertices")
        if self.values.shape != (len(self._vertex_ijk), 16 * BLOCKS[self.sh_degree]):
            raise InputError(f"octree: values have shape {self.values.shape}")
        if not np.isfinite(self.values).all():
            raise InputError("octree: some vertex values are not finite")


_POPCOUNT = np.array([bin(i).count("1") for i in range(256)], dtype=np.int64)


def convert_rows(rows: np.ndarray, old_degree: int, new_degree: int) -> np.ndarray:
    """Packed vertex rows of one SH degree as those of another: missing bands zero, surplus ones dropped."""
    out = aligned_empty((len(rows), 16 * BLOCKS[new_degree]), rows.dtype)
    out[:] = 0
    k = (min(old_degree, new_degree) + 1) ** 2
    out[:, sh_slots(new_degree)[:, :k]] = rows[:, sh_slots(old_degree)[:, :k]]
    out[:, DENSITY_SLOT] = rows[:, DENSITY_SLOT]
    return out


def _check_frame(t: Octree) -> None:
    if t.sh_degree not in BLOCKS:
        raise InputError(f"sh_degree must be 0, 1, 2 or 3, got {t.sh_degree}")
    if not (np.isfinite(t.size) and t.size > 0 and np.isfinite(t.origin).all()):
        raise InputError(f"the root cube must be finite and of positive size, got origin {t.origin} size {t.size}")
    if not (np.isfinite(t.density_scale) and t.density_scale > 0):
        raise InputError(f"density_scale must be positive and finite, got {t.density_scale}")


def _build_masks(level: np.ndarray, ijk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Breadth-first masks of the octree with these leaves."""
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


def _expand_topology(node_mask: np.ndarray, leaf_mask: np.ndarray):
    """first_node, first_leaf, leaf_level, leaf_ijk from the masks; InputError where they describe no octree."""
    if node_mask.ndim != 1 or node_mask.shape != leaf_mask.shape or len(node_mask) == 0:
        raise InputError(
            f"octree masks must be two equal, non-empty vectors, got {node_mask.shape} and {leaf_mask.shape}"
        )
    if (node_mask & leaf_mask).any():
        raise InputError("octree: a child is marked both as an interior node and as a leaf")
    n_children = _POPCOUNT[node_mask]
    n_leaves = _POPCOUNT[leaf_mask]
    if n_children.sum() != len(node_mask) - 1:
        raise InputError(f"octree: {len(node_mask)} nodes but {n_children.sum()} links to nodes; expected one less")
    if n_leaves.sum() == 0:
        raise InputError("octree: no leaves")
    first_node = (1 + np.cumsum(n_children) - n_children).astype(np.int32)
    first_leaf = (np.cumsum(n_leaves) - n_leaves).astype(np.int32)
    level, ijk = [], []
    start, end = 0, 1
    codes = np.zeros(1, dtype=np.int64)  # of the nodes in [start, end), all of one level
    bits = np.arange(8)
    for depth in range(1, MAX_LEVEL + 1):
        leaf_bits = (leaf_mask[start:end, None] >> bits & 1).astype(bool)
        node_bits = (node_mask[start:end, None] >> bits & 1).astype(bool)
        child = codes[:, None] * 8 + bits
        ijk.append(demorton(child[leaf_bits]))
        level.append(np.full(len(ijk[-1]), depth, dtype=np.int64))
        codes = child[node_bits]
        if not len(codes):
            break
        start, end = end, end + len(codes)
    else:
        raise InputError(f"octree: deeper than {MAX_LEVEL} levels")
    if end != len(node_mask):  # links that sum up but loop: nodes that the walk from the root never meets
        raise InputError(f"octree: only {end} of {len(node_mask)} nodes hang on the root")
    return first_node, first_leaf, np.concatenate(level), np.concatenate(ijk)


def _number_corners(level: np.ndarray, ijk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the order in which leaves name them: corners (n, 8) int32, positions at the finest level (m, 3)."""
    n = len(level)
    compiled = native()
    if compiled is not None:
        ids, position = aligned_empty((n, 8), np.int32), np.empty((8 * n, 3), np.int64)
        m = compiled.number_corners(level, np.ascontiguousarray(ijk), int(level.max()), ids, position)
        return ids, position[:m].copy()
    scale = (1 << (level.max() - level)).reshape(-1, 1)
    keys = np.stack([morton((ijk + OFFSETS[o]) * scale) for o in range(8)], 1).reshape(-1)
    unique, at, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(at)
    rank = np.empty(len(at), np.int32)
    rank[order] = np.arange(len(at), dtype=np.int32)
    return aligned(rank[inverse].reshape(n, 8), np.int32), demorton(unique[order])


def _find_sources(new: Octree, parent: np.ndarray, octant: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """source and place of :class:`Transfer`; a corner of an old leaf beats a point inside one, the first leaf a later."""
    source, place = np.empty(new.n_vertices, np.int32), np.empty(new.n_vertices, np.int8)
    compiled = native()
    if compiled is not None:
        compiled.find_sources(new.corners, parent, octant, source, place)
        return source, place
    inside = OFFSETS[np.maximum(octant, 0)][:, None] + OFFSETS
    lattice = np.where((octant < 0)[:, None, None], OFFSETS * 2, inside)
    places = (lattice @ _STRIDES).astype(np.int8).ravel()
    leaves, flat = np.repeat(parent, 8), new.corners.ravel()
    is_corner = np.isin(places, _LATTICE_CORNERS)
    for chosen in (np.flatnonzero(~is_corner)[::-1], np.flatnonzero(is_corner)[::-1]):  # the first one is written last
        source[flat[chosen]] = leaves[chosen]
        place[flat[chosen]] = places[chosen]
    return source, place
