"""Reading OpenVDB files (Museth 2013; the layout follows OpenVDB's io, version 222+); vdb_write.py writes them.

Covers what density volumes need: grids of float and of vec3s (``Tree_float_5_4_3``), stored as float or half, uncompressed,
zip or blosc, with or without active-mask compression, under a scale and translation. Nothing is executed and all
sizes are checked against the file, so a truncated or hostile file is an ``InputError``.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from data_synth.blosc import decompress
from data_synth.errors import InputError
from data_synth.vdb_write import MAGIC, ZIP

BLOSC = 4  # a bit of the compression flag
LIMIT = 1 << 30  # numbers of a dense result; more is refused
FREE_LIMIT = 1 << 27
"""Numbers of a dense result (512 MiB) that a file of any size may ask for: a few tiles are a fog of constant density."""
LARGEST_RATIO = 1024
"""Beyond, bytes of a dense result for each of the file: what deflate makes of zeros at most, and far more than clouds take
(a few dozen). Two voxels far apart would fill any memory."""
# per-node code of how inactive values are stored
ONE_INACTIVE, MASK_NONE, MASK_ONE, MASK_TWO, ALL_VALUES = 2, 3, 4, 5, 6


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


class _Reader:
    def __init__(self, data: bytes, path: str | os.PathLike) -> None:
        self.data, self.at, self.path = data, 0, path

    def fail(self, what: str) -> InputError:
        return InputError(f"{self.path}: expected an OpenVDB float volume, {what}")

    def take(self, n: int) -> bytes:
        if n < 0 or self.at + n > len(self.data):
            raise self.fail("the file ends too early")
        self.at += n
        return self.data[self.at - n : self.at]

    def number(self, kind: str) -> Any:
        return struct.unpack("<" + kind, self.take(struct.calcsize("<" + kind)))[0]

    def numbers(self, kind: str, n: int) -> np.ndarray:
        return np.frombuffer(self.take(np.dtype(kind).itemsize * n), dtype=kind)

    def string(self) -> str:
        return self.take(self.number("I")).decode("utf-8", "replace")

    def mask(self, bits: int) -> np.ndarray:
        return np.unpackbits(self.numbers("u1", bits // 8), bitorder="little").astype(bool)

    def metadata(self) -> dict[str, bytes]:
        entries = {}
        for _ in range(self.number("I")):
            name = self.string()
            self.string()
            entries[name] = self.take(self.number("I"))
        return entries


def read_vdb(path: str | os.PathLike, name: str | None = None) -> VdbGrid:
    """The grid called ``name``, of numbers or vectors, as a dense array; by default the float grid called density, else the
    first of numbers."""
    try:
        r = _Reader(Path(path).read_bytes(), path)
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
    grids, others = {}, []
    for _ in range(r.number("I")):
        grid_name, kind, instance = r.string().split("\x1e")[0], r.string(), r.string()
        position, block, end = (r.number("q") for _ in range(3))
        if not r.at <= position <= block <= end <= len(r.data):  # else a grid could end where it begins, for ever
            raise r.fail(f"the grid {grid_name} says it lies at bytes {position} to {end} of {len(r.data)}")
        vectors = kind.startswith("Tree_vec3s_5_4_3") and name == grid_name
        if (vectors or kind.startswith("Tree_float_5_4_3")) and not instance:
            grids.setdefault(grid_name, (position, kind.endswith("_HalfFloat"), 3 if vectors else 1))
        else:
            others.append(grid_name)
        r.at = end
    chosen = name if name is not None else "density" if "density" in grids else next(iter(grids), "")
    if chosen not in grids:
        held = f"the float grids {', '.join(grids)}" if grids else "no float grid"
        held += f" and {', '.join(others)} of other kinds" if others else ""
        raise r.fail(f"it holds {held}" + (f", not {name}" if name is not None else ""))
    r.at, half, channels = grids[chosen]
    return replace(_read_grid(r, chosen, half, channels), others=tuple(other for other in grids if other != chosen))


def _read_grid(r: _Reader, name: str, half: bool, channels: int = 1) -> VdbGrid:
    flags = r.number("I")
    metadata = r.metadata()
    voxel_size, origin = _read_transform(r)
    if r.number("I") != 1:
        raise r.fail("its tree has several buffers")
    tree = _Tree(r, flags, half, channels)
    first, values = tree.dense()
    return VdbGrid(name, values, first, voxel_size, origin, metadata)


def _read_transform(r: _Reader) -> tuple[np.ndarray, np.ndarray]:
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


class _Tree:
    """Root, two levels of internal nodes (32^3 and 16^3 children) and leaves of 8^3 voxels."""

    channels = 1
    """Numbers a voxel has: 3 for vectors."""

    def __init__(self, r: _Reader, flags: int, half: bool, channels: int = 1) -> None:
        self.r, self.flags, self.half, self.channels = r, flags, half, channels
        self.background = self._value()
        self.boxes: list[tuple[np.ndarray, int, Any]] = []  # active tiles: origin, edge, value
        self.leaves: list[np.ndarray] = []
        tiles, children = r.number("I"), r.number("I")
        for _ in range(tiles):
            origin, value, active = r.numbers("<i4", 3), self._value(), r.number("?")
            if active:
                self.boxes.append((origin, 4096, value))
        for _ in range(children):
            self._internal(r.numbers("<i4", 3).astype(np.int64), 5)
        self.blocks = [self._values(512, r.mask(512)) for _ in self.leaves]

    def _internal(self, origin: np.ndarray, log2: int) -> None:
        n, edge = 1 << log2, 128 if log2 == 5 else 8
        child, active = self.r.mask(n**3), self.r.mask(n**3)
        values, _ = self._values(n**3, active)
        place = np.stack(np.unravel_index(np.arange(n**3), (n, n, n)), axis=1) * edge + origin
        for k in np.flatnonzero(active & ~child):
            self.boxes.append((place[k], edge, values[k]))
        for k in np.flatnonzero(child):
            if log2 == 5:
                self._internal(place[k], 4)
            else:
                self.r.take(64)
                self.leaves.append(place[k])

    def _values(self, n: int, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The n values of a node and its active mask, undoing active-mask compression."""
        r = self.r
        code = r.number("b")
        low = self.background
        high = self.background if code == 0 else -self.background
        if code in (ONE_INACTIVE, MASK_ONE, MASK_TWO):
            low = self._value()
            high = self._value() if code == MASK_TWO else high if code == ONE_INACTIVE else self.background
        chosen = r.mask(n) if code in (MASK_NONE, MASK_ONE, MASK_TWO) else np.zeros(n, bool)
        if code == 1:
            low = -self.background
        if code == ALL_VALUES:
            return self._numbers(n), active
        chosen = chosen if self.channels == 1 else chosen[:, None]
        values = np.where(chosen, high, low).astype(np.float32)
        values[active] = self._numbers(int(active.sum()))
        return values, active

    def _value(self) -> Any:
        """One value in single precision: a number, or a vector (3,)."""
        return self.r.number("f") if self.channels == 1 else self.r.numbers("<f4", 3)

    def _numbers(self, n: int) -> np.ndarray:
        """n values: (n,), or (n, 3)."""
        flat = self._flat(n * self.channels)
        return flat if self.channels == 1 else flat.reshape(n, self.channels)

    def _flat(self, n: int) -> np.ndarray:
        if self.half and not n:  # OpenVDB's half reader returns before it reads how many bytes there are
            return np.zeros(0, np.float32)
        kind = "<f2" if self.half else "<f4"
        if not self.flags & (ZIP | BLOSC):
            return self.r.numbers(kind, n).astype(np.float32)
        size = self.r.number("q")
        if size <= 0:
            if -size != n * np.dtype(kind).itemsize:
                raise self.r.fail(f"a node of {n} values has {-size} bytes")
            return self.r.numbers(kind, n).astype(np.float32)
        data, wanted = self.r.take(size), n * np.dtype(kind).itemsize
        try:
            plain = decompress(data, wanted) if self.flags & BLOSC else zlib.decompressobj().decompress(data, wanted)
            return np.frombuffer(plain, kind, count=n).astype(np.float32)
        except (zlib.error, ValueError) as error:
            raise self.r.fail(f"its compressed data are damaged: {error}") from error

    def dense(self) -> tuple[np.ndarray, np.ndarray]:
        """(first index, values) over the active voxels."""
        low, high = [], []
        offsets = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1)
        for origin, (_, active) in zip(self.leaves, self.blocks, strict=True):
            if active.any():
                low.append(origin + offsets[active].min(axis=0))
                high.append(origin + offsets[active].max(axis=0) + 1)
        for origin, edge, _ in self.boxes:
            low.append(origin)
            high.append(origin + edge)
        if not low:
            raise self.r.fail("it has no active voxel")
        first, last = np.min(low, axis=0), np.max(high, axis=0)
        numbers = self.channels * float(np.prod((last - first).astype(float)))
        if numbers > LIMIT or (numbers > FREE_LIMIT and 4 * numbers > LARGEST_RATIO * len(self.r.data)):
            extent = "x".join(str(int(v)) for v in last - first)
            raise self.r.fail(f"its voxels lie {extent} apart, {4 * numbers / 2**30:.1f} GiB as a dense grid")
        shape = tuple(last - first) + ((self.channels,) if self.channels > 1 else ())
        out = np.full(shape, self.background, np.float32)

        def put(origin: np.ndarray, edge: int, value: ArrayLike) -> None:
            a, b = np.maximum(origin - first, 0), np.minimum(origin + edge - first, last - first)
            c, d = a - (origin - first), b - (origin - first)
            part = value if np.ndim(value) < 3 else np.asarray(value)[c[0] : d[0], c[1] : d[1], c[2] : d[2]]
            if (a < b).all():
                out[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = part

        for origin, edge, value in self.boxes:
            put(origin, edge, value)
        for origin, (values, _) in zip(self.leaves, self.blocks, strict=True):
            put(origin, 8, values.reshape(8, 8, 8, *values.shape[1:]))
        return first, out
