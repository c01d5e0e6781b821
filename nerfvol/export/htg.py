"""``.htg``: the octree as it is, as a hyper tree grid of VTK (XML 2.0, appended raw), which ParaView opens and cuts.

Cells carry ``density`` (1/scene unit) and ``color`` (bytes as in the training images); a cell that is refined has the mean
of its children, so that ParaView's depth limiter shows something. Empty space is masked. Cells are stored breadth first,
the children of one with x fastest: the bits of our octants, reversed. Layout: VTK 9's vtkXMLHyperTreeGridReader.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.files.atomic import atomic_write
from nerfvol.models import Model
from nerfvol.octree.points import leaf_colour, leaf_density
from nerfvol.octree.topology import POPCOUNT, bits_of
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel

X_FASTEST = np.array([4 * (i & 1) + 2 * (i >> 1 & 1) + (i >> 2) for i in range(8)])
"""Our octant of VTK's child i."""


def memory(model: Model) -> int:
    """Bytes that writing takes: the cells' arrays and what they are gathered from."""
    assert isinstance(model, OctreeModel)
    return 8 * 120 * model.octree.n_nodes + 100 * model.octree.n_leaves


@dataclass
class _Level:
    """Cells of one level in VTK's order. refined, empty: (n,) bool; sigma: (n,); colour: (n, 3)."""

    refined: NDArray[np.bool_]
    empty: NDArray[np.bool_]
    sigma: NDArray[np.float64]
    colour: NDArray[np.float64]


def write(model: Model, path: str | os.PathLike[str]) -> int:
    """The octree with one root cell, its root cube."""
    assert isinstance(model, OctreeModel)
    octree = model.octree
    levels = _levels(octree)
    bits = lambda parts: np.packbits(np.concatenate(parts))  # noqa: E731  the first in the highest bit
    cells = sum(len(level.refined) for level in levels)
    colour = np.concatenate([level.colour for level in levels])
    axes = [np.array([lo, lo + octree.size]) for lo in octree.origin]
    n = len(levels)
    arrays = {
        **{f"{axis}Coordinates": ("Float64", 2, "", places) for axis, places in zip("XYZ", axes, strict=True)},
        "Descriptors": ("Bit", cells - len(levels[-1].refined), "", bits([level.refined for level in levels[:-1]])),
        "NumberOfVerticesPerDepth": ("Int64", n, "", np.array([len(level.refined) for level in levels], np.int64)),
        "TreeIds": ("Int64", 1, "", np.zeros(1, np.int64)),
        "DepthPerTree": ("UInt32", 1, "", np.array([n], np.uint32)),
        "Mask": ("Bit", cells, "", bits([level.empty for level in levels])),
        "density": ("Float32", cells, "", np.concatenate([level.sigma for level in levels]).astype("<f4")),
        "color": ("UInt8", cells, ' NumberOfComponents="3"', np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)),
    }
    header = _header(arrays)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(header)
        for _, _, _, array in arrays.values():
            file.write(struct.pack("<Q", array.nbytes) + array.tobytes())
        file.write(b"\n  </AppendedData>\n</VTKFile>\n")
        return file.tell()


def _header(arrays: dict[str, tuple[str, int, str, NDArray]]) -> bytes:
    lines, offset = {}, 0
    for name, (kind, count, more, array) in arrays.items():
        lines[name] = (
            f'<DataArray type="{kind}" Name="{name}"{more} NumberOfTuples="{count}" format="appended" offset="{offset}"/>'
        )
        offset += 8 + array.nbytes
    listed = lambda names: "\n".join(lines[name] for name in names)  # noqa: E731
    names = list(lines)
    return f"""<?xml version="1.0"?>
<VTKFile type="HyperTreeGrid" version="2.0" byte_order="LittleEndian" header_type="UInt64">
<HyperTreeGrid BranchFactor="2" TransposedRootIndexing="0" Dimensions="2 2 2">
<Grid>
{listed(names[:3])}
</Grid>
<Trees>
{listed(names[3:8])}
</Trees>
<CellData>
{listed(names[8:])}
</CellData>
</HyperTreeGrid>
<AppendedData encoding="raw">
_""".encode()


def _levels(octree: Octree) -> list[_Level]:
    sigma, colour = leaf_density(octree), np.clip(leaf_colour(octree), 0, 1)
    root = _Level(np.ones(1, bool), np.zeros(1, bool), np.zeros(1), np.zeros((1, 3)))
    levels, nodes = [root], np.zeros(1, np.int64)
    while len(nodes):
        refined, is_leaf = (
            bits_of(mask[nodes])[:, X_FASTEST].reshape(-1) for mask in (octree.node_mask, octree.leaf_mask)
        )
        node, leaf = (
            _children(octree.node_mask, octree.first_node, nodes),
            _children(octree.leaf_mask, octree.first_leaf, nodes),
        )
        level = _Level(refined, ~(refined | is_leaf), np.zeros(len(refined)), np.zeros((len(refined), 3)))
        level.sigma[is_leaf], level.colour[is_leaf] = sigma[leaf[is_leaf]], colour[leaf[is_leaf]]
        levels.append(level)
        nodes = node[refined]
    for above, below in zip(levels[-2::-1], levels[:0:-1], strict=True):
        children, colours = below.sigma.reshape(-1, 8), below.colour.reshape(-1, 8, 3)
        above.sigma[above.refined] = children.mean(axis=1)
        weight = children / np.maximum(children.sum(axis=1, keepdims=True), 1e-300)
        above.colour[above.refined] = (colours * weight[..., None]).sum(axis=1)
    return levels


def _children(mask: NDArray, first: NDArray, nodes: NDArray) -> NDArray[np.int64]:
    """(8 n,) the index that each child of ``nodes`` (n,) would have, in VTK's order."""
    below = (1 << X_FASTEST) - 1
    return (first[nodes][:, None] + POPCOUNT[mask[nodes][:, None] & below]).reshape(-1)
