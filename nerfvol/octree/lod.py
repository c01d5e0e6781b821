"""Level of detail: prefiltered nodes, each one cell for everything below it, and octrees cut at some of them.

A view from afar, or a small picture, meets leaves smaller than a pixel; a node that is smaller than a pixel is then drawn
in their place: a trilinear cell of the node's side with rows of its own (kernels/csrc/traverse.h). Level by level from
the finest up, a node's corner takes from the cells below what interpolation would give them (its transpose):

- density: the optical depth of a node is that of parallel rays through it: along each axis, -log of the mean transmittance
  of sixteen columns of four corners each, and the mean of the three axes. A mean of sigma would make a node that is half
  empty and half opaque as good as opaque from every side, and silhouettes fat; a mean of transmittance over points would
  let light through walls. The corners share it out as their opacity, 1 - exp(-sigma h), is restricted: weighted by the
  trilinear weight of a child's corner in the node, empty space counting with zero.
- colour: the mean weighted by that opacity, so that what is invisible does not tint.

A corner that several nodes of a level share has the mean over these nodes: neighbours meet without a step. Constant
fields stay as they are.

Source: restriction as the transpose of interpolation, Briggs, Henson & McCormick, *A Multigrid Tutorial* (2000).
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from nerfvol.errors import InputError
from nerfvol.native import aligned_empty, native
from nerfvol.octree.rows import DENSITY_SLOT, PrefilteredNodes, explin, explin_inverse
from nerfvol.octree.topology import (
    LATTICE_OF_CORNER,
    LATTICE_WEIGHTS,
    POPCOUNT,
    bits_of,
    level_starts,
    morton,
    number_corners,
    place_nodes,
    renumber_corners,
)
from nerfvol.octree.tree import Octree

OPAQUE = 1 - 1e-6
"""Prefiltered values are kept below this opacity, an optical thickness of 13.8: float32 has no numbers for more."""
CLEAREST = 1e-12
"""Prefiltered values are kept above this sigma / density_scale, whose logarithm is the raw density."""


def prefiltered_nodes(octree: Octree) -> PrefilteredNodes:
    """Values of every interior node, made when they are first asked for and kept with the octree.

    They are made again once values were assigned (``octree.values``, ``density`` or ``sh``) or trained. Writing into the
    array ``octree.values`` is not noticed: set ``octree.prefiltered`` to None then.
    """
    if octree.prefiltered is None:
        octree.prefiltered = _prefilter(octree) if (compiled := native()) is None else _compiled(compiled, octree)
    return octree.prefiltered


def _compiled(compiled: ModuleType, octree: Octree) -> PrefilteredNodes:
    """What :func:`_prefilter` makes, by csrc/prefilter.cpp, which a page calls as well."""
    masks, first = (octree.node_mask, octree.leaf_mask), (octree.first_node, octree.first_leaf)
    place = [float(x) for x in octree.origin], float(octree.size), float(octree.density_scale)
    tree = compiled.Tree(*masks, *first, octree.corners, octree.values, octree.sh_degree, *place, None, None, 0.0)
    return PrefilteredNodes(*compiled.prefilter(tree))


def _prefilter(octree: Octree) -> PrefilteredNodes:
    starts = level_starts(octree.node_mask)
    ijk = place_nodes(octree.node_mask, starts)
    sigma = (octree.density_scale * explin(octree.density)).astype(np.float32)
    rows_of_level, corners_of_level = [], []
    nothing = np.empty((0, 8), np.int32), np.empty((0, octree.values.shape[1]), np.float32), np.empty(0, np.float32)
    below: tuple[np.ndarray, np.ndarray, np.ndarray] = nothing  # corners, rows and sigma of the nodes one level down
    for level in range(len(starts) - 2, -1, -1):
        start, end = starts[level], starts[level + 1]
        side = octree.size / 2.0**level
        sums = np.zeros((end - start, 8, octree.values.shape[1]), np.float32)
        depths = np.zeros((end - start, 8, 8), np.float32)  # of each corner of each child, over a quarter of the side
        leaf_mask, node_mask = octree.leaf_mask[start:end], octree.node_mask[start:end]
        leaves = octree.corners[octree.first_leaf[start] :][: POPCOUNT[leaf_mask].sum()]
        for mask, first, cells, rows, extinction in (
            (leaf_mask, octree.first_leaf[start:end] - octree.first_leaf[start], leaves, octree.values, sigma),
            (node_mask, octree.first_node[start:end] - end, *below),
        ):
            if len(cells):
                depths[bits_of(mask)] = (extinction * np.float32(side / 4))[cells]
                _restrict(mask, first, cells, rows, -np.expm1(extinction * np.float32(-side / 2)), sums)
        _share_out(_optical_depth(depths), sums)
        corners, n_vertices = number_corners(np.full(end - start, level, np.int8), ijk[start:end])
        rows, opacity = _shared(sums, corners, n_vertices)
        extinction = -np.log1p(-opacity) / np.float32(side)
        rows[:, DENSITY_SLOT] = explin_inverse(np.maximum(extinction / octree.density_scale, CLEAREST))
        below = corners, rows, extinction
        corners_of_level.append(corners)
        rows_of_level.append(rows)
    values = aligned_empty((sum(map(len, rows_of_level)), octree.values.shape[1]), np.float32)
    np.concatenate(rows_of_level, out=values)
    first_row = np.cumsum([0, *map(len, rows_of_level)])
    of_level = [c + np.int32(first) for c, first in zip(corners_of_level, first_row, strict=False)]
    corners = np.concatenate(of_level[::-1])  # nodes from the root down, rows from the finest level up
    return PrefilteredNodes(corners, values)


def _optical_depth(depths: np.ndarray) -> np.ndarray:
    """Of nodes (n,), from their children's corners (n, 8, 8): see the module's head."""
    cubes = depths.reshape(-1, 2, 2, 2, 2, 2, 2)  # child's x, y, z, corner's x, y, z
    opacity = [-np.expm1(-cubes.sum((axis, axis + 3))).mean((1, 2, 3, 4)) for axis in (1, 2, 3)]
    return -np.log1p(-np.minimum(opacity, OPAQUE)).mean(axis=0)


def _share_out(depth: np.ndarray, sums: np.ndarray) -> None:
    """Scales the sums (n, 8, row) so that the optical depths of a node's corners fit the node's own (n,)."""
    opacity = np.minimum(sums[..., DENSITY_SLOT], OPAQUE)
    tiny = np.finfo(np.float32).tiny
    factor = depth / np.maximum(-np.log1p(-opacity.mean(axis=1)), tiny)
    wanted = -np.expm1(np.log1p(-opacity) * factor[:, None])
    sums *= (wanted / np.maximum(sums[..., DENSITY_SLOT], tiny))[..., None]


def _shared(sums: np.ndarray, corners: np.ndarray, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the vertices (n_vertices, row), means by opacity, and their opacity, from the nodes' sums (n, 8, row)."""
    total, nodes = np.zeros((n_vertices, sums.shape[2]), np.float32), np.zeros(n_vertices, np.float32)
    for o in range(8):  # two nodes do not have the same vertex at the same corner
        total[corners[:, o]] += sums[:, o]
        nodes[corners[:, o]] += 1
    opacity = total[:, DENSITY_SLOT].copy()
    total /= np.maximum(opacity, np.finfo(np.float32).tiny)[:, None]
    return total, np.minimum(opacity / nodes, OPAQUE)


# Trilinear weights, over 8, of the children's corners at their node's corners: (child, node's corner, child's corner).
_WEIGHTS = LATTICE_WEIGHTS[LATTICE_OF_CORNER].transpose(0, 2, 1).astype(np.float32) / 8


def _restrict(
    mask: np.ndarray, first: np.ndarray, corners: np.ndarray, rows: np.ndarray, weight: np.ndarray, sums: np.ndarray
) -> None:
    """Adds to ``sums`` (n, 8, row) what the children named by ``mask`` (n,) hold; see csrc/topology.h."""
    for o in range(8):
        node = np.flatnonzero(mask >> o & 1)
        child = corners[first[node] + POPCOUNT[mask[node] & ((1 << o) - 1)]]
        part = rows[child]
        part[..., DENSITY_SLOT] = 1
        sums[node] += _WEIGHTS[o] @ (part * weight[child][..., None])


# ------------------------------------------------------------------ the LOD cut
def lod_cut(octree: Octree, origin: ArrayLike, coarse: float) -> np.ndarray:
    """The nodes that a view from ``origin`` (3,), scene units, draws in place of their leaves: (n_nodes,) bool.

    Those whose side is below ``coarse`` (radians) times the distance of their centre. The root is always opened.
    """
    starts = level_starts(octree.node_mask)
    side = octree.size / 2.0 ** np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    centre = octree.origin + (place_nodes(octree.node_mask, starts) + 0.5) * side[:, None]
    small = side < coarse * np.linalg.norm(centre - np.asarray(origin, np.float64), axis=1)
    small[0] = False
    return small


def has_lod_cut(octree: Octree, origins: ArrayLike, coarse: float) -> bool:
    """False where :func:`lod_cut` surely has no node, seen from any of ``origins`` (n, 3)."""
    finest = octree.max_level - 1
    farthest = np.linalg.norm(np.asarray(origins) - (octree.origin + octree.size / 2), axis=-1).max(initial=0)
    return finest > 0 and octree.size / 2.0**finest < coarse * (farthest + octree.size * 3**0.5 / 2)


def cut(octree: Octree, nodes: ArrayLike) -> Octree:
    """The octree in which each of ``nodes`` (n_nodes,) bool, the root excepted, is a leaf with its prefiltered values.

    A leaf and a node that touch share no vertex, since they hold different values there.
    """
    closes = np.asarray(nodes, bool)
    prefiltered = prefiltered_nodes(octree)
    starts = level_starts(octree.node_mask)
    parent = np.repeat(np.arange(octree.n_nodes), POPCOUNT[octree.node_mask])  # of nodes 1, 2, ...
    opened = np.ones(octree.n_nodes, bool)
    for start, end in zip(starts[1:-1], starts[2:], strict=True):
        opened[start:end] = opened[parent[start - 1 : end - 1]] & ~closes[start:end]
    whole = np.flatnonzero(opened[np.repeat(np.arange(octree.n_nodes), POPCOUNT[octree.leaf_mask])])
    closed = 1 + np.flatnonzero(opened[parent] & closes[1:])
    level = np.searchsorted(starts, closed, side="right") - 1
    level = np.concatenate([octree.leaf_level[whole], level])
    ijk = np.concatenate([octree.leaf_ijk[whole], place_nodes(octree.node_mask, starts)[closed]])
    corners = np.concatenate([octree.corners[whole], prefiltered.corners[closed] + np.int32(octree.n_vertices)])
    order = np.lexsort((morton(ijk), level)).astype(np.int32)
    new = Octree.from_leaves(level, ijk, octree.origin, octree.size, octree.sh_degree, octree.density_scale)
    n_rows = octree.n_vertices + len(prefiltered.values)
    new.corners, new._n_vertices = renumber_corners(np.ascontiguousarray(corners), order, n_rows)
    source = np.empty(new.n_vertices, np.int64)
    source[new.corners] = corners[order]
    new.values = np.where(
        (source < octree.n_vertices)[:, None],
        octree.values[np.minimum(source, octree.n_vertices - 1)],
        prefiltered.values[np.maximum(source - octree.n_vertices, 0)],
    )
    return new


def at_level(octree: Octree, level: int) -> Octree:
    """The octree without leaves finer than ``level`` >= 1: :func:`cut` there, so to be drawn and not to be saved."""
    starts = level_starts(octree.node_mask)
    return cut(octree, np.repeat(np.arange(len(starts) - 1), np.diff(starts)) >= level)


def simplified(octree: Octree, level: int) -> Octree:
    """The octree of :func:`at_level` with shared vertices, as every proper octree has them: it can be saved and trained.

    Where leaves and nodes that touch hold different values, their vertex has the mean that prefiltered nodes have (see the
    module's head): of the opacities over the side of a cell of ``level``, and of the colours weighted by these. Other
    vertices keep their rows bit by bit. Raises InputError for a level below 1.
    """
    if level < 1:
        raise InputError(f"an octree is simplified to level 1 or finer, got {level}")
    return _with_shared_vertices(at_level(octree, level), np.float32(octree.size / 2.0**level))


def closed(octree: Octree, nodes: ArrayLike) -> Octree:
    """:func:`cut` at ``nodes`` (n_nodes,) bool with shared vertices, as :func:`simplified` has them."""
    return _with_shared_vertices(cut(octree, nodes), np.float32(octree.size / 2.0**octree.max_level))


def _with_shared_vertices(apart: Octree, side: np.float32) -> Octree:
    """``apart`` where every vertex that several cells touch is one; opacities are those of cells of ``side``."""
    octree = apart
    new = Octree.from_leaves(
        apart.leaf_level, apart.leaf_ijk, octree.origin, octree.size, octree.sh_degree, octree.density_scale
    )
    thickness = (octree.density_scale * explin(apart.density)).astype(np.float32) * side
    opacity = np.minimum(-np.expm1(-thickness), OPAQUE)
    weighted = apart.values * opacity[:, None]
    weighted[:, DENSITY_SLOT] = opacity
    rows, mean = _shared(weighted[apart.corners], new.corners, new.n_vertices)
    extinction = -np.log1p(-mean) / side
    rows[:, DENSITY_SLOT] = explin_inverse(np.maximum(extinction / octree.density_scale, CLEAREST))
    least, greatest = np.full(new.n_vertices, apart.n_vertices), np.zeros(new.n_vertices, np.int64)
    np.minimum.at(least, new.corners, apart.corners)
    np.maximum.at(greatest, new.corners, apart.corners)
    alone = least == greatest
    rows[alone] = apart.values[least[alone]]
    new.values = rows
    return new
