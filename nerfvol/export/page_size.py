"""Models in few bytes: as compact files, and coarser where a limit asks for it.

An octree's cells are drawn coarser level by level, those first that differ least from what is drawn in their place; of
splats the smallest and faintest are left out.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.models import Model
from nerfvol.octree import lod
from nerfvol.octree.io import save_octree
from nerfvol.octree.topology import POPCOUNT, level_starts
from nerfvol.octree.tree import Octree
from nerfvol.splats.io import save_splats
from nerfvol.splats.splats import Splats
from nerfvol.views import OctreeModel, SplatModel

TOLERANCE = 0.04
"""Of the limit: a file that much smaller is not made larger again."""
MOST_TRIALS = 8


def stored(model: Model) -> bytes:
    """The bytes of the model's compact file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        if isinstance(model, OctreeModel):
            save_octree(path, model.octree, model.metadata, "compact")
        else:
            model = model if isinstance(model, SplatModel) else SplatModel(model.splats, model.metadata)  # type: ignore[attr-defined]
            save_splats(path, model.splats, {**model.metadata, "near": model.near}, compact=True)
        return path.read_bytes()


def fitted(model: Model, size: int, room: int) -> bytes:
    """The model's compact file in at most ``room`` bytes; as it is it has ``size``."""
    if isinstance(model, OctreeModel):
        coarser = _coarsening(model.octree)
        return _largest(lambda share: stored(OctreeModel(coarser(share), model.metadata)), room)
    return _fitted_splats(model, size, room)


def _largest(make: Callable[[float], bytes], room: int) -> bytes:
    """``make(share)`` for nearly the largest share in (0, 1] whose bytes fit: they grow with the share."""
    low, high, best = 0.0, 1.0, None
    share = 0.5
    for _ in range(MOST_TRIALS):
        data = make(share)
        if len(data) <= room:
            low, best = share, data
            if len(data) >= (1 - TOLERANCE) * room:
                break
        else:
            high = share
        # bytes are nearly proportional to the share; never leave the bracket
        share = float(np.clip(share * 0.985 * room / len(data), low + 0.02 * (high - low), high - 0.02 * (high - low)))
    if best is None:
        raise InputError("--max-bytes leaves too little room for the coarsest model")
    return best


def _coarsening(octree: Octree) -> Callable[[float], Octree]:
    """share -> the octree in which the least visible nodes are closed until that share of the leaves is left, in cost order.

    The cost of closing a node, drawn as one cell: its surface as seen, side squared, times the mean square by which its
    children's opacities and colours differ from its own; never less than that of a node inside it, so that what is open hangs
    together.
    """
    nodes = lod.prefiltered_nodes(octree)
    starts = level_starts(octree.node_mask)
    cost = np.zeros(octree.n_nodes)
    for level in range(len(starts) - 2, 0, -1):
        first, last = starts[level], starts[level + 1]
        side = octree.size / 2.0**level
        own = _mean_rows(octree, nodes.values, nodes.corners[first:last], side)
        total = np.zeros(last - first)
        for mask, begin, cells, rows, is_node in (
            (octree.leaf_mask, octree.first_leaf, octree.corners, octree.values, False),
            (octree.node_mask, octree.first_node, nodes.corners, nodes.values, True),
        ):
            counts = POPCOUNT[mask[first:last]]
            parent = np.repeat(np.arange(last - first), counts)
            if not len(parent):
                continue
            child = int(begin[first]) + np.arange(len(parent))
            seen = _mean_rows(octree, rows, cells[child], side)
            np.add.at(total, parent, ((seen - own[parent]) ** 2).sum(1) / 8)
            if is_node:
                np.maximum.at(cost, first + parent, cost[child] * (1 + 1e-9))
        cost[first:last] = np.maximum(cost[first:last], total * side**2)
    removed = np.array([7.0])  # leaves that closing a node takes away, about
    order = np.sort(cost[1:]) if octree.n_nodes > 1 else removed

    def coarser(share: float) -> Octree:
        closed = cost < order[min(int((1 - share) * len(order)), len(order) - 1)]
        closed[0] = False
        return lod.closed(octree, closed)

    return coarser


def _mean_rows(octree: Octree, rows: NDArray, corners: NDArray, side: float) -> NDArray:
    """What cells look like, (n, 4): opacity along ``side`` and colour times opacity, at the mean of the corners."""
    mean = np.zeros((len(corners), rows.shape[1]), np.float32)
    for o in range(8):
        mean += rows[corners[:, o]] / 8
    opacity = -np.expm1(-octree.density_scale * lod.explin(mean[:, 12]) * side)
    colour = 0.5 + 0.28209479177387814 * mean[:, [0, 4, 8]]
    return np.column_stack([opacity, colour * opacity[:, None]])


def _fitted_splats(model: Model, size: int, room: int) -> bytes:
    splats: Splats = model.splats  # type: ignore[attr-defined]
    while splats.sh_degree > 0 and room < 0.6 * size:  # finer colours are worth less than half of the splats
        splats = splats.with_sh_degree(splats.sh_degree - 1)
        size = len(stored(SplatModel(splats, model.metadata)))
    sizes = np.sort(splats.log_scales.astype(np.float64), axis=1)
    weight = 1 / (1 + np.exp(-splats.logits.astype(np.float64))) * np.exp(sizes[:, 1] + sizes[:, 2])
    order = np.argsort(-weight, kind="stable")
    whole = stored(SplatModel(splats, model.metadata))
    if len(whole) <= room:
        return whole

    def make(share: float) -> bytes:
        return stored(SplatModel(splats.select(np.sort(order[: max(1, int(share * splats.n))])), model.metadata))

    return _largest(make, room)
