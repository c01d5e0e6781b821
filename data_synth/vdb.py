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
from data_synth.vdb_tree import Contents, Reader, Tree, unused
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
    """Where a grid lies in its file. channels: 3 for vectors. kind: OpenVDB's class, such as "level set", or "" for none, or
    where the grid's head is damaged."""

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
    found = _contents(path)
    if name is None and found.damage:
        raise found.damage
    solids = [n for n, h in found.grids.items() if h.kind == LEVEL_SET and h.channels == 1]
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
    found = _contents(path)
    return {name: h.channels for name, h in found.grids.items()}, tuple(found.others)


def _contents(path: str | os.PathLike) -> Contents:
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
    held: dict[str, _Held] = {}
    others: list[str] = []
    damage = None
    for _ in range(r.number("I")):
        try:
            name, one, end = _listed(r)
        except InputError as error:  # where the next one begins is not known
            damage = damage or error
            break
        if one is None:
            others.append(name)
        else:
            name = unused(name, held)
            held[name] = one
            try:
                r.at = one.position + 4
                held[name] = one._replace(kind=r.metadata().get("class", b"").decode("utf-8", "replace"))
            except InputError as error:
                damage = damage or error
        r.at = end
    return Contents(r, held, others, damage)


def _listed(r: Reader) -> tuple[str, _Held | None, int]:
    """(name, where it lies, its end) of the next grid; None for one of another type, or that shares another one's tree."""
    name, kind, instance = _label(r.string()), r.string(), r.string()
    position, block, end = (r.number("q") for _ in range(3))
    if not r.at <= position <= block <= end <= len(r.data):  # else a grid could end where it begins, for ever
        raise r.fail(f"the grid {name} says it lies at bytes {position} to {end} of {len(r.data)}")
    channels = 1 if kind.startswith("Tree_float_5_4_3") else 3 if kind.startswith("Tree_vec3s_5_4_3") else 0
    known = channels and not instance
    return name, _Held(position, kind.endswith("_HalfFloat"), channels, "") if known else None, end


def _label(unique: str) -> str:
    """A grid's name as OpenVDB's tools show it: of several of one name those after the first have their number, "density[1]",
    and grids without a name are "[0]", "[1]", ..."""
    name, numbered, number = unique.partition("\x1e")
    return f"{name}[{number}]" if numbered and (number != "0" or not name) else name or "[0]"


def _read(path: str | os.PathLike, name: str | None, density: bool) -> tuple[Any, ...]:
    """(name, names of other float grids, tree, voxel size, origin, metadata)."""
    found = _contents(path)
    r, held = found.reader, found.grids
    name = name if name is None else found.called(name)
    grids = [n for n, h in held.items() if h.channels == 1 or n == name]
    others = found.others + [n for n in held if n not in grids]
    likely = [n for n in grids if held[n].kind != LEVEL_SET] or grids
    chosen = name if name is not None else "density" if "density" in grids else next(iter(likely), "")
    if found.damage and (chosen not in grids or (name is None and chosen != "density")):
        raise found.damage
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
        voxel_size, origin = _read_transform(r, chosen)
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


def _read_transform(r: Reader, grid: str) -> tuple[np.ndarray, np.ndarray]:
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
            raise r.fail(f"the transform of its grid {grid} rotates")
        return np.diag(matrix)[:3], matrix[3, :3]
    if kind == "NonlinearFrustumMap":
        raise r.fail(
            f"the voxels of its grid {grid} lie in a camera's frustum, wider the farther they are: resample it to even voxels"
        )
    raise r.fail(f"the transform of its grid {grid} is a {kind}")
