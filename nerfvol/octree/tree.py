"""The sparse octree: topology, trilinear vertex values, and the operations that change it.

Conventions, once for the whole module:

- The root cube has its smallest corner at ``origin`` (scene units) and side ``size``. A cell of level l has side
  ``size / 2**l`` and integer position ``ijk`` in units of that side.
- Octant o of a node lies at offsets ``(o >> 2 & 1, o >> 1 & 1, o & 1)`` along x, y, z; corners of a leaf likewise.
- Interior nodes are stored in breadth-first order, by Morton code within a level. Two bits per child say what it is:
  ``node_mask`` an interior node, ``leaf_mask`` a leaf, neither: empty space. Where the children are follows from
  counting bits, so there are no links that could be wrong.
- Leaves are stored in the order in which the nodes name them: by level, then by Morton code.
- The field is trilinear inside a leaf between values at its eight corners, shared by all leaves that have that corner
  (a finer leaf's corner on the face of a coarser one belongs to the finer leaf alone).
- sigma = density_scale * explin(raw density); colour = 1/2 + sum_k sh_k Y_k(d), not clamped inside the integral.

Sources: sparse voxels with trilinear corner values, Plenoxels (2022) and SVRaster (2025); breadth-first child masks,
Laine & Karras, *Efficient Sparse Voxel Octrees* (2010).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nerfvol.errors import InputError
from nerfvol.native import aligned, aligned_empty
from nerfvol.octree.rows import BLOCKS, DENSITY_SLOT, EMPTY_DENSITY, convert_rows, sh_slots
from nerfvol.octree.topology import (
    MAX_LEVEL,
    OFFSETS,
    POPCOUNT,
    Transfer,
    build_masks,
    find_sources,
    first_children,
    level_starts,
    morton,
    number_corners,
    place_leaves,
    pruned_masks,
    renumber_corners,
)

if TYPE_CHECKING:
    from nerfvol.octree.rows import PrefilteredNodes


class Octree:
    """See the module's head for the conventions.

    Attributes: origin (3,) float64; size, density_scale float; sh_degree 0-3; node_mask, leaf_mask (n_nodes,) uint8;
    first_node, first_leaf (n_nodes,) int32; leaf_level (n_leaves,) int8; leaf_ijk (n_leaves, 3) int32;
    corners (n_leaves, 8) int32; values (n_vertices, 16 * blocks) float32, packed rows. The last two begin on a cache
    line; values that do not are copied when they are assigned. prefiltered: what octree.lod made of the values, or
    None; assigning values, density or sh drops it, and whoever writes into ``values`` sets it to None.
    """

    prefiltered: PrefilteredNodes | None = None

    def __init__(
        self, node_mask: ArrayLike, leaf_mask: ArrayLike, *, origin: ArrayLike, size: float, sh_degree: int,
        density_scale: float,
    ) -> None:  # fmt: skip
        """An octree with these masks (n_nodes,), whole numbers in 0..255; values as in :meth:`from_leaves`.

        Raises InputError where masks or frame (origin, size, degree, scale) describe no octree.
        """
        self.node_mask, self.leaf_mask = _as_mask("node_mask", node_mask), _as_mask("leaf_mask", leaf_mask)
        self.origin = np.asarray(origin, dtype=np.float64).reshape(3)
        self.size = float(size)
        self.sh_degree = int(sh_degree)
        self.density_scale = float(density_scale)
        _check_frame(self)
        self.first_node, self.first_leaf = first_children(self.node_mask, self.leaf_mask)
        self.leaf_level, self.leaf_ijk = place_leaves(self.node_mask, self.leaf_mask)
        self.corners, self._n_vertices = number_corners(self.leaf_level, self.leaf_ijk)
        self._values = aligned_empty((self.n_vertices, 16 * BLOCKS[self.sh_degree]), np.float32)
        self._values[:] = 0
        self._values[:, DENSITY_SLOT] = EMPTY_DENSITY

    @classmethod
    def from_leaves(
        cls, level: ArrayLike, ijk: ArrayLike, origin: ArrayLike, size: float, sh_degree: int = 1,
        density_scale: float = 1.0,
    ) -> Octree:  # fmt: skip
        """An octree with the given leaves, in any order; values are zero and raw density is -7 (nearly empty).

        level: (n,) whole numbers 1..16; ijk: (n, 3) whole numbers in [0, 2**level). Raises InputError where they are
        not, and where leaves overlap.
        """
        levels = _as_whole("leaf levels", level).reshape(-1)
        cells = _as_whole("leaf positions", ijk).reshape(-1, 3)
        if len(levels) != len(cells):
            raise InputError(f"level has {len(levels)} leaves but ijk has {len(cells)}")
        if len(levels) == 0:
            raise InputError("an octree needs at least one leaf, got none")
        if levels.min() < 1 or levels.max() > MAX_LEVEL:
            raise InputError(f"leaf levels must lie in 1..{MAX_LEVEL}, got {levels.min()}..{levels.max()}")
        if (cells < 0).any() or (cells >= (1 << levels)[:, None]).any():
            raise InputError("leaf positions must lie in [0, 2**level), some do not")
        node_mask, leaf_mask = build_masks(levels, cells)
        return cls(node_mask, leaf_mask, origin=origin, size=size, sh_degree=sh_degree, density_scale=density_scale)

    @classmethod
    def from_parts(
        cls, node_mask: np.ndarray, leaf_mask: np.ndarray, leaf_level: np.ndarray, leaf_ijk: np.ndarray,
        corners: np.ndarray, values: np.ndarray, *, origin: ArrayLike, size: float, sh_degree: int, density_scale: float,
    ) -> Octree:  # fmt: skip
        """An octree of arrays that are laid out already, as the attributes are: none is copied.

        Raises InputError where they describe no octree that can be drawn: masks that loop, corners outside the vertices.
        That corners are those of the leaves is not checked; wrong ones give a wrong picture.
        """
        self = cls.__new__(cls)
        self.node_mask, self.leaf_mask = node_mask, leaf_mask
        self.origin = np.asarray(origin, dtype=np.float64).reshape(3)
        self.size, self.sh_degree, self.density_scale = float(size), int(sh_degree), float(density_scale)
        _check_frame(self)
        self.first_node, self.first_leaf = first_children(node_mask, leaf_mask)
        levels = len(level_starts(node_mask)) - 1
        if not len(corners) == len(leaf_level) == len(leaf_ijk) == int(POPCOUNT[leaf_mask].sum()):
            raise InputError("octree: its masks have another number of leaves than its arrays")
        if leaf_level.min() < 1 or leaf_level.max() > levels:
            raise InputError("octree: leaves lie on levels that it does not have")
        if leaf_ijk.min() < 0 or (leaf_ijk.max(1) >> leaf_level).any():
            raise InputError("octree: leaves lie outside the root cube")
        if corners.min() < 0 or corners.max() >= len(values):
            raise InputError("octree: corners point outside the vertices")
        self.leaf_level, self.leaf_ijk, self.corners = leaf_level, leaf_ijk, corners
        self._values, self._n_vertices = values, len(values)
        return self

    # ------------------------------------------------------------------ sizes and places
    @property
    def n_nodes(self) -> int:
        """Interior nodes, the root among them."""
        return len(self.node_mask)

    @property
    def n_leaves(self) -> int:
        """Leaves."""
        return len(self.corners)

    @property
    def n_vertices(self) -> int:
        """Distinct corners of leaves: the rows of ``values``."""
        return self._n_vertices

    @property
    def max_level(self) -> int:
        """Level of the finest leaves, 1 to 16."""
        return int(self.leaf_level.max())

    def leaf_sizes(self) -> np.ndarray:
        """Side of each leaf in scene units: (n_leaves,) float64."""
        return self.size / (1 << self.leaf_level.astype(np.int64))

    def leaf_centers(self) -> np.ndarray:
        """(n_leaves, 3) float64, scene units."""
        return self.origin + (self.leaf_ijk + 0.5) * self.leaf_sizes()[:, None]

    def vertex_positions(self) -> np.ndarray:
        """(n_vertices, 3) float64, scene units."""
        finest = self.max_level
        shift = (finest - self.leaf_level)[:, None]
        place = np.empty((self.n_vertices, 3), np.int32)
        for o in range(8):
            place[self.corners[:, o]] = (self.leaf_ijk + OFFSETS[o]) << shift
        return self.origin + place * (self.size / 2.0**finest)

    # ------------------------------------------------------------------ values
    @property
    def values(self) -> np.ndarray:
        """Packed vertex rows: (n_vertices, 16 * blocks) float32."""
        return self._values

    @values.setter
    def values(self, rows: ArrayLike) -> None:
        self._values = aligned(np.asarray(rows), np.float32)
        self.prefiltered = None

    @property
    def density(self) -> np.ndarray:
        """Raw density at the vertices: (n_vertices,), a view."""
        return self.values[:, DENSITY_SLOT]

    @density.setter
    def density(self, raw: ArrayLike) -> None:
        self.values[:, DENSITY_SLOT] = raw
        self.prefiltered = None

    @property
    def sh(self) -> np.ndarray:
        """Spherical-harmonic coefficients at the vertices: a copy (n_vertices, 3, (sh_degree + 1)**2); assign to change."""
        return self.values[:, sh_slots(self.sh_degree)]

    @sh.setter
    def sh(self, coefficients: ArrayLike) -> None:
        self.values[:, sh_slots(self.sh_degree)] = coefficients
        self.prefiltered = None

    def with_sh_degree(self, degree: int) -> Octree:
        """The same field with another SH degree: missing bands are zero, surplus ones are dropped."""
        other = Octree.__new__(Octree)
        other.__dict__.update(self.__dict__)
        other.sh_degree = int(degree)
        _check_frame(other)
        other.values = convert_rows(self.values, self.sh_degree, degree)
        return other

    # ------------------------------------------------------------------ queries
    def query(self, points: ArrayLike) -> np.ndarray:
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
            leaf = self.first_leaf[node] + POPCOUNT[leaves & below]
            result[active[is_leaf]] = leaf[is_leaf]
            node = (self.first_node[node] + POPCOUNT[nodes & below])[is_node]
            active = active[is_node]
            if not len(active):
                break
        return result

    # ------------------------------------------------------------------ changes of topology
    def prune(self, keep: ArrayLike) -> tuple[Octree, Transfer]:
        """Keeps the leaves where ``keep`` (n_leaves,) is true; the field inside them does not change.

        Returns a new octree, and how rows per vertex and leaf follow. Raises InputError where ``keep`` has another length, or
        no leaf would stay.
        """
        stays = np.asarray(keep, dtype=bool).reshape(-1)
        if len(stays) != self.n_leaves:
            raise InputError(f"keep must have one entry per leaf ({self.n_leaves}), got {len(stays)}")
        kept = np.flatnonzero(stays).astype(np.int32)
        if not len(kept):
            raise InputError("this would leave an octree without leaves")
        new = self._in_same_frame(*pruned_masks(self.node_mask, self.leaf_mask, stays))
        new.leaf_level, new.leaf_ijk = self.leaf_level[kept], self.leaf_ijk[kept]
        new.corners, new._n_vertices = renumber_corners(self.corners, kept, self.n_vertices)
        return new, self._carry_values(new, kept, np.full(len(kept), -1, np.int8))

    def subdivide(self, mask: ArrayLike) -> tuple[Octree, Transfer]:
        """Splits the leaves where ``mask`` (n_leaves,) is true into eight.

        New vertices take the trilinear value of the leaf they came from, so the field is the same, save where a new
        vertex coincides with one that a finer neighbour already owned: that vertex keeps its value.

        Returns a new octree, and how rows per vertex and leaf follow. Raises InputError where ``mask`` has another length, or a
        leaf of the finest level there is, 16, would be split.
        """
        splits = np.asarray(mask, dtype=bool).reshape(-1)
        if len(splits) != self.n_leaves:
            raise InputError(f"mask must have one entry per leaf ({self.n_leaves}), got {len(splits)}")
        if splits.any() and self.leaf_level[splits].max() >= MAX_LEVEL:
            raise InputError(f"cannot subdivide below level {MAX_LEVEL}")
        level, ijk, parent, octant = self._split_leaves(splits)
        new = self._in_same_frame(*build_masks(level, ijk))
        new.leaf_level, new.leaf_ijk = level, ijk
        new.corners, new._n_vertices = number_corners(level, ijk)
        return new, self._carry_values(new, parent, octant)

    def _split_leaves(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The leaves after :meth:`subdivide` in their order: level, position, the old leaf, and which child of it or -1."""
        split, whole = (np.flatnonzero(chosen).astype(np.int32) for chosen in (mask, ~mask))
        children = (2 * self.leaf_ijk[split][:, None] + OFFSETS.astype(np.int32)).reshape(-1, 3)
        ijk = np.concatenate([self.leaf_ijk[whole], children])
        del children
        level = np.concatenate([self.leaf_level[whole], np.repeat(self.leaf_level[split] + np.int8(1), 8)])
        order = np.lexsort((morton(ijk), level))
        level, ijk = level[order], ijk[order]
        parent = np.concatenate([whole, np.repeat(split, 8)])[order]
        octant = np.concatenate([np.full(len(whole), -1, np.int8), np.tile(np.arange(8, dtype=np.int8), len(split))])
        return level, ijk, parent, octant[order]

    def _in_same_frame(self, node_mask: np.ndarray, leaf_mask: np.ndarray) -> Octree:
        """Another octree in the same root cube, whose leaves have no places, corners or values yet."""
        new = Octree.__new__(Octree)
        new.node_mask, new.leaf_mask = node_mask, leaf_mask
        new.origin, new.size, new.sh_degree, new.density_scale = (
            self.origin, self.size, self.sh_degree, self.density_scale,
        )  # fmt: skip
        new.first_node, new.first_leaf = first_children(node_mask, leaf_mask)
        return new

    def _carry_values(self, new: Octree, parent: np.ndarray, octant: np.ndarray) -> Transfer:
        transfer = Transfer(parent, self.corners, *find_sources(new.corners, new.n_vertices, parent, octant))
        new.values = transfer.vertices(self.values)
        return transfer

    def validate(self) -> None:
        """Checks every invariant that the kernels rely on; raises InputError naming the first that fails."""
        fresh = Octree.__new__(Octree)
        fresh.__dict__.update(self.__dict__)
        _check_frame(fresh)
        first_node, first_leaf = first_children(self.node_mask, self.leaf_mask)
        level, ijk = place_leaves(self.node_mask, self.leaf_mask)
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
        if self.values.shape != (self.n_vertices, 16 * BLOCKS[self.sh_degree]):
            raise InputError(f"octree: values have shape {self.values.shape}")
        if not np.isfinite(self.values).all():
            raise InputError("octree: some vertex values are not finite")


def _check_frame(t: Octree) -> None:
    if t.sh_degree not in BLOCKS:
        raise InputError(f"sh_degree must be 0, 1, 2 or 3, got {t.sh_degree}")
    if not (np.isfinite(t.size) and t.size > 0 and np.isfinite(t.origin).all()):
        raise InputError(f"the root cube must be finite and of positive size, got origin {t.origin} size {t.size}")
    if not (np.isfinite(t.density_scale) and t.density_scale > 0):
        raise InputError(f"density_scale must be positive and finite, got {t.density_scale}")


def _as_mask(name: str, mask: ArrayLike) -> np.ndarray:
    """The mask as contiguous uint8, where that changes no number in it."""
    given = np.asarray(mask)
    with np.errstate(invalid="ignore"):  # NaN has no integer
        narrow = np.ascontiguousarray(given, dtype=np.uint8)
    if given.dtype != np.uint8 and not np.array_equal(narrow, given):
        raise InputError(f"octree: {name} must hold whole numbers in 0..255, it does not")
    return narrow


def _as_whole(what: str, numbers: ArrayLike) -> np.ndarray:
    """The numbers as int64, where that changes none of them."""
    given = np.asarray(numbers)
    with np.errstate(invalid="ignore"):
        whole = given.astype(np.int64)
    if not np.array_equal(whole, given):
        raise InputError(f"{what} must be whole numbers, some are not")
    return whole
