"""Reading OpenVDB files (Museth 2013; the layout follows OpenVDB's io, version 222+); vdb_write.py writes them.

Covers what density volumes need: grids of float and of vec3s (``Tree_float_5_4_3``), stored as float or half, uncompressed,
zip or blosc, with or without active-mask compression, under a scale and translation. Nothing is executed and all
sizes are checked against the file, so a truncated or hostile file is an ``InputError``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_synth import nanovdb
from data_synth.bricks import Sparse
from data_synth.errors import InputError
from data_synth.vdb_tree import Reader, Tree
from data_synth.vdb_write import MAGIC

LEVEL_SET = "level set"


@dataclass
class VdbGrid:
    """values: (nx, ny, nz), vectors (nx, ny, nz, 3), float32 of the active bounding box; first: index of values[0, 0, 0];
    voxel_size, origin: world position = origin + voxel_size * index; metadata: bytes by name; others: names of the
    file's other float grids."""

    name: str
    values: np.ndarray
    first: np.ndarray
    voxel_size: np.ndarray
    origin: np.ndarray
    metadata: dict[str, bytes]
    others: tuple[str, ...] = ()


@dataclass
class VdbBlocks:
    """volume: what of the grid is not 0, over its active bounding box; the rest as in ``VdbGrid``."""

    name: str
    volume: Sparse
    first: np.ndarray
    voxel_size: np.ndarray
    origin: np.ndarray
    others: tuple[str, ...] = ()


class _Held(NamedTuple):
    """Where a grid lies in its file. channels: 3 for vectors. kind: OpenVDB's class, such as "level set", or "" for none."""

    position: int
    half: bool
    channels: int
    kind: str


def read_vdb(path: str | os.PathLike, name: str | None = None, density: bool = False) -> VdbGrid:
    """The grid called ``name``, of numbers or vectors, as a dense array; by default the float grid called density, else the
    first of numbers. density: refuse what is a level set."""
    chosen, others, tree, voxel_size, origin, metadata = _read(path, name, density)
    first, values = tree.dense()
    return VdbGrid(chosen, values, first, voxel_size, origin, metadata, others)


def read_blocks(path: str | os.PathLike, name: str | None = None) -> VdbBlocks | None:
    """As ``read_vdb``, without a dense array; None for a grid that is not 0 where nothing is stored. Without a name it is a
    density, and a level set refused."""
    chosen, others, tree, voxel_size, origin, _ = _read(path, name, name is None)
    if np.any(tree.background):
        return None
    first, volume = tree.sparse()
    return VdbBlocks(chosen, volume, first, voxel_size, origin, others)


def read_level_set(path: str | os.PathLike, name: str | None = None) -> tuple[Tree, np.ndarray, np.ndarray]:
    """(tree, voxel size, origin) of the grid called ``name``; by default the first of class "level set", else the one that
    ``read_vdb`` takes."""
    _, held, _ = _contents(path)
    solids = [n for n, h in held.items() if h.kind == LEVEL_SET and h.channels == 1]
    chosen, _, tree, voxel_size, origin, _ = _read(path, name or (solids[0] if solids else None), False)
    if tree.channels != 1 or not tree.background > 0:
        raise tree.r.fail(
            f"its grid {chosen} is none: a distance, below 0 inside, and a background above 0", "level set"
        )
    held = [tree.background, tree.values, *(values for _, _, values in tree.inside)]
    if not all(np.isfinite(v).all() for v in held):
        raise tree.r.fail(f"its grid {chosen} has values that are infinite or no numbers", "level set")
    if not (np.isfinite(origin).all() and np.isfinite(voxel_size).all() and (voxel_size > 0).all()):
        raise tree.r.fail(f"its grid {chosen} has a voxel size of {voxel_size} and its origin at {origin}", "level set")
    return tree, voxel_size, origin


def grid_names(path: str | os.PathLike) -> tuple[dict[str, int], tuple[str, ...]]:
    """({name: numbers a voxel has} of the grids that can be read, names of the others)."""
    _, held, others = _contents(path)
    return {name: h.channels for name, h in held.items()}, tuple(others)


def _contents(path: str | os.PathLike) -> tuple[Reader, dict[str, Any], list[str]]:
    """(reader, float and vec3s grids by name, names of others)."""
    if Path(path).suffix == ".nvdb":
        return nanovdb.contents(path)
    try:
        r = Reader(Path(path).read_bytes(), path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if len(r.data) < 16 or r.number("q") != MAGIC:
        raise r.fail("the first bytes are another format's")
    version = r.number("I")
    if version < 222:
        raise r.fail(f"file version {version} is older than 222")
    r.take(8)  # library version
    if not r.number("?"):
        raise r.fail("it was written without grid offsets")
    r.take(36)
    r.metadata()
    held, others = {}, []
    for _ in range(r.number("I")):
        grid_name, kind, instance = r.string().split("\x1e")[0], r.string(), r.string()
        position, block, end = (r.number("q") for _ in range(3))
        if not r.at <= position <= block <= end <= len(r.data):  # else a grid could end where it begins, for ever
            raise r.fail(f"the grid {grid_name} says it lies at bytes {position} to {end} of {len(r.data)}")
        channels = 1 if kind.startswith("Tree_float_5_4_3") else 3 if kind.startswith("Tree_vec3s_5_4_3") else 0
        if channels and not instance:
            r.at = position + 4
            said = r.metadata().get("class", b"").decode("utf-8", "replace")
            held.setdefault(grid_name, _Held(position, kind.endswith("_HalfFloat"), channels, said))
        else:
            others.append(grid_name)
        r.at = end
    return r, held, others


def _read(path: str | os.PathLike, name: str | None, density: bool) -> tuple[Any, ...]:
    """(name, names of other float grids, tree, voxel size, origin, metadata)."""
    r, held, unknown = _contents(path)
    grids = [n for n, h in held.items() if h.channels == 1 or n == name]
    others = unknown + [n for n in held if n not in grids]
    likely = [n for n in grids if held[n].kind != LEVEL_SET] or grids
    chosen = name if name is not None else "density" if "density" in grids else next(iter(likely), "")
    if chosen not in grids:
        said = f"the float grids {', '.join(grids)}" if grids else "no float grid"
        said += f" and {', '.join(others)} of other kinds" if others else ""
        raise r.fail(f"it holds {said}" + (f", not {name}" if name is not None else ""))
    channels, kind, metadata = held[chosen].channels, held[chosen].kind, {}
    if isinstance(held[chosen], nanovdb.Stored):
        tree, voxel_size, origin = nanovdb.grid_of(r, held[chosen])
    else:
        r.at = held[chosen].position
        flags, metadata = r.number("I"), r.metadata()
        voxel_size, origin = _read_transform(r)
        if r.number("I") != 1:
            raise r.fail("its tree has several buffers")
        tree = Tree(r, flags, held[chosen].half, channels)
    signed = channels == 1 and tree.background > 0 and (len(tree.inside) > 0 or bool((tree.values < 0).any()))
    if density and (kind == LEVEL_SET or (signed and kind in ("", "unknown"))):
        raise r.fail(
            f"its grid {chosen} is a level set: a scene file shows the solid, 'shapes: [{{level_set: {{material: ..., "
            f"file: {Path(path).name}}}}}]'", "density",
        )  # fmt: skip
    return chosen, tuple(n for n in grids if n != chosen), tree, voxel_size, origin, metadata


def _read_transform(r: Reader) -> tuple[np.ndarray, np.ndarray]:
    kind = r.string()
    if kind in ("UniformScaleMap", "ScaleMap"):
        return r.numbers("<f8", 15)[:3], np.zeros(3)
    if kind in ("UniformScaleTranslateMap", "ScaleTranslateMap"):
        v = r.numbers("<f8", 18)
        return v[3:6], v[:3]
    if kind == "TranslationMap":
        return np.ones(3), r.numbers("<f8", 3)
    if kind == "AffineMap":
        matrix = r.numbers("<f8", 16).reshape(4, 4)  # row vectors: p' = p M
        if np.abs(matrix[:3, :3] - np.diag(np.diag(matrix[:3, :3]))).max() > 1e-12:
            raise r.fail("its transform rotates")
        return np.diag(matrix)[:3], matrix[3, :3]
    raise r.fail(f"its transform is a {kind}")
