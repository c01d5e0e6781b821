"""PlenOctrees: the ``.npz`` of svox and volrend (Yu et al. 2021), both ways.

A node is 2x2x2 cells along x, y, z; ``child`` (n, 2, 2, 2) int32 says how many nodes further on the one inside a cell is,
0: the cell is a leaf. ``data`` (n, 2, 2, 2, 3 K + 1) float16: K coefficients each of red, green and blue, whose colour is
sigmoid(sum_k Y_k), then density in 1/scene unit, constant in the cell. A point x lies at ``offset`` + x * ``invradius3`` in
the root's unit cube. Ours is trilinear between vertices with colours 1/2 + sum_k Y_k: either way colours are fitted over 64
directions.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.machine import available_memory
from nerfvol.octree.points import at_leaves, leaf_density
from nerfvol.octree.rows import DENSITY_SCALE, explin_inverse
from nerfvol.octree.topology import MAX_LEVEL, OFFSETS, bits_of
from nerfvol.octree.tree import Octree
from nerfvol.sh import eval_basis

Float = NDArray[np.float64]
_DIRECTIONS = 64
_DARKEST = 1 / 1024  # colours are kept as far from 0 and 1, where the logit has no bound
_RUN = 1 << 14  # leaves that are fitted at a time
_LARGEST_HALF = 65504.0
_CLEAREST = 1e-4
"""Optical depth of a cell along its side below which it counts as empty when a file is read."""


def plenoctree_arrays(octree: Octree) -> dict[str, NDArray[Any]]:
    """What :func:`numpy.savez` writes: svox's keys."""
    n, basis = octree.n_nodes, (octree.sh_degree + 1) ** 2
    is_node, is_leaf = bits_of(octree.node_mask), bits_of(octree.leaf_mask)
    child = np.zeros((n, 8), np.int32)
    parents, cells = np.nonzero(is_node)
    numbers = np.arange(1, n)  # breadth first, as they are named
    child[parents, cells] = numbers - parents
    depth = np.zeros(n, np.int32)
    for parent, number in zip(parents, numbers, strict=True):  # parents come before their children
        depth[number] = depth[parent] + 1
    data = np.zeros((n, 8, 3 * basis + 1), np.float16)
    data[is_leaf] = _leaf_rows(octree, basis)
    radius = np.full(3, 1 / octree.size)
    return {
        "data_dim": np.array(3 * basis + 1),
        "data_format": np.array(f"SH{basis}"),
        "child": child.reshape(n, 2, 2, 2),
        "data": data.reshape(n, 2, 2, 2, -1),
        "invradius3": radius.astype(np.float32),
        "offset": (-octree.origin * radius).astype(np.float32),
        "parent_depth": np.stack([np.concatenate([[0], 8 * parents + cells]), depth], axis=1).astype(np.int32),
        "n_internal": np.array(n),
        "n_free": np.array(0),
        "depth_limit": np.array(max(10, octree.max_level)),
        "geom_resize_fact": np.array(1.0),
    }


def _leaf_rows(octree: Octree, basis: int) -> NDArray[np.float16]:
    rows = np.empty((octree.n_leaves, 3 * basis + 1), np.float16)
    rows[:, -1] = np.minimum(leaf_density(octree), _LARGEST_HALF)
    sh = at_leaves(octree, octree.sh)
    values, fit = _directions(octree.sh_degree)
    for at in range(0, len(rows), _RUN):
        colour = np.clip(0.5 + sh[at : at + _RUN] @ values.T, _DARKEST, 1 - _DARKEST)
        rows[at : at + _RUN, :-1] = (np.log(colour / (1 - colour)) @ fit.T).reshape(-1, 3 * basis)
    return rows


def _directions(degree: int) -> tuple[Float, Float]:
    """The basis (64, K) along directions that are spread evenly (a Fibonacci lattice), and the least-squares fit (K, 64)."""
    z = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(_DIRECTIONS)
    across = np.sqrt(1 - z * z)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    values = eval_basis(degree, directions)
    return values, np.linalg.pinv(values)


def is_plenoctree(path: str | os.PathLike[str]) -> bool:
    """Whether ``path`` is an .npz file with a PlenOctree's arrays."""
    try:
        with zipfile.ZipFile(path) as file:
            return {"child.npy", "data.npy"} <= set(file.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def load_plenoctree(path: str | os.PathLike[str]) -> Octree:
    """The octree in a PlenOctree's file, with spherical harmonics of degree 0 to 3.

    A vertex has the mean density of the cells around it that are not empty, and their colours weighted by opacity.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    arrays = _read(path)
    fault = lambda reason: InputError(f"{path} is not a usable PlenOctree: {reason}")  # noqa: E731
    child, data = arrays["child"].astype(np.int64), arrays["data"]
    kind = str(arrays["data_format"])
    degree = {"SH1": 0, "SH4": 1, "SH9": 2, "SH16": 3}.get(kind)
    if degree is None:
        raise fault(f"its data_format is {kind[:40]!r}, expected SH1, SH4, SH9 or SH16")
    n, channels = len(child), 3 * (degree + 1) ** 2 + 1
    if not n or child.shape != (n, 2, 2, 2) or data.shape != (n, 2, 2, 2, channels):
        raise fault(
            f"child and data have shapes {child.shape} and {data.shape}, expected (n, 2, 2, 2) and {channels} numbers a cell"
        )
    scale = np.broadcast_to(np.ravel(arrays["invradius3"]).astype(np.float64), 3)
    offset = np.broadcast_to(np.ravel(arrays["offset"]).astype(np.float64), 3)
    if not (np.isfinite(offset).all() and scale.min() > 0 and np.ptp(scale) <= 1e-3 * scale.max()):
        raise fault(f"its root is no cube of finite size (invradius3 {scale.tolist()})")
    level, ijk, cell = _walk(child.reshape(n, 8), fault)
    rows = data.reshape(8 * n, channels)[cell].astype(np.float64)
    if not np.isfinite(rows).all():
        raise fault("some of its values are not finite")
    size = 1 / float(scale.mean())
    depth = rows[:, -1] * size / 2.0**level
    kept = depth > _CLEAREST
    if not kept.any():
        raise fault("all of its cells are empty")
    octree = Octree.from_leaves(level[kept], ijk[kept], -offset * size, size, degree, DENSITY_SCALE / size)
    order = np.lexsort((_codes(ijk[kept]), level[kept]))
    _fill(octree, rows[kept][order], depth[kept][order])
    return octree


def _codes(ijk: NDArray[np.int64]) -> NDArray[np.int64]:
    from nerfvol.octree.topology import morton

    return morton(ijk)


def _read(path: str | os.PathLike[str]) -> Mapping[str, NDArray[Any]]:
    wanted, found = ("child", "data", "offset", "data_format"), {}
    try:
        with zipfile.ZipFile(path) as file:
            unpacked, free = sum(info.file_size for info in file.infolist()), available_memory()
        if free is not None and 4 * unpacked > free:
            raise InputError(f"{path} needs {4 * unpacked / 2**30:.2g} GiB of memory, {free / 2**30:.2g} GiB are free")
        with np.load(path, allow_pickle=False) as stored:
            radius = "invradius3" if "invradius3" in stored.files else "invradius"
            if missing := [name for name in (*wanted, radius) if name not in stored.files]:
                raise InputError(f"{path} is not a usable PlenOctree: it has no array {missing[0]!r}")
            found = {name: stored[name] for name in wanted}
            found["invradius3"] = stored[radius]
            used = int(stored["n_internal"]) if "n_internal" in stored.files else len(found["child"])
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path} is not a usable PlenOctree: {(str(error).splitlines() or ['it is damaged'])[0]}"
        ) from error
    if any(found[name].dtype.kind not in "iuf" for name in ("child", "data", "offset", "invradius3")):
        raise InputError(f"{path} is not a usable PlenOctree: its arrays should hold numbers")
    return {**found, "child": found["child"][:used], "data": found["data"][:used]}


def _walk(child: NDArray[np.int64], fault: Any) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Level, place (m, 3) and number among all cells of the leaves, from the root down."""
    nodes, places = np.zeros(1, np.int64), np.zeros((1, 3), np.int64)
    level, ijk, cell, seen = [], [], [], np.zeros(len(child), bool)
    seen[0] = True
    for depth in range(1, MAX_LEVEL + 1):
        inside = (2 * places[:, None] + OFFSETS).reshape(-1, 3)
        numbers, step = (8 * nodes[:, None] + np.arange(8)).reshape(-1), child[nodes].reshape(-1)
        is_leaf = step == 0
        level.append(np.full(is_leaf.sum(), depth))
        ijk.append(inside[is_leaf])
        cell.append(numbers[is_leaf])
        nodes, places = (numbers // 8 + step)[~is_leaf], inside[~is_leaf]
        if not len(nodes):
            return np.concatenate(level), np.concatenate(ijk), np.concatenate(cell)
        if nodes.min() < 0 or nodes.max() >= len(child) or seen[nodes].any() or len(np.unique(nodes)) < len(nodes):
            raise fault("its links point outside or to a node twice")
        seen[nodes] = True
    raise fault(f"it is deeper than {MAX_LEVEL} levels")


def _fill(octree: Octree, rows: Float, depth: Float) -> None:
    """Vertices from the cells (n_leaves, 3 K + 1) in the octree's order; depth (n_leaves,): optical, along the side."""
    values, fit = _directions(octree.sh_degree)
    sh = np.empty((octree.n_leaves, 3, values.shape[1]))
    for at in range(0, len(rows), _RUN):
        logits = rows[at : at + _RUN, :-1].reshape(-1, 3, values.shape[1]) @ values.T
        sh[at : at + _RUN] = (1 / (1 + np.exp(-logits)) - 0.5) @ fit.T
    opacity = -np.expm1(-depth)
    total = np.zeros((octree.n_vertices, 3, values.shape[1]))
    sigma, weight, cells = (np.zeros(octree.n_vertices) for _ in range(3))
    for corner in octree.corners.T:
        np.add.at(sigma, corner, rows[:, -1])
        np.add.at(cells, corner, 1.0)
        np.add.at(weight, corner, opacity)
        np.add.at(total, corner, sh * opacity[:, None, None])
    octree.density = explin_inverse(sigma / cells / octree.density_scale)
    octree.sh = total / weight[:, None, None]
