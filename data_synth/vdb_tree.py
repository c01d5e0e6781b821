"""The tree of an OpenVDB grid as it lies in a file (``vdb.py``): root, internal nodes, leaves, and how values are stored.

Nothing is executed and all sizes are checked against the file.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth.blosc import decompress
from data_synth.bricks import Sparse
from data_synth.errors import InputError
from data_synth.vdb_write import ZIP

BLOSC = 4  # a bit of the compression flag
LIMIT = 1 << 30  # numbers of a dense result; more is refused
BLOCKS = LIMIT // 512  # tiles, or leaves times channels: more than that cannot be used in any case
FREE_LIMIT = 1 << 27
"""Numbers of a dense result (512 MiB) that a file of any size may ask for: a few tiles are a fog of constant density."""
LARGEST_RATIO = 1024
"""Beyond, bytes of a dense result for each of the file: what deflate makes of zeros at most, and far more than clouds take
(a few dozen). Two voxels far apart would fill any memory."""
# per-node code of how inactive values are stored
MINUS, ONE_INACTIVE, MASK_NONE, MASK_ONE, MASK_TWO, ALL_VALUES = 1, 2, 3, 4, 5, 6


class Reader:
    def __init__(self, data: bytes, path: str | os.PathLike) -> None:
        self.data, self.at, self.path = data, 0, path

    def fail(self, what: str, wanted: str = "float volume") -> InputError:
        return InputError(f"{self.path}: expected an OpenVDB {wanted}, {what}")

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


class Contents(NamedTuple):
    """grids: of floats and vectors, by name. others: names of what else there is. damage: of the first grid whose head or place
    is damaged; then nobody knows which of the grids somebody meant who names none, and later ones may not be listed."""

    reader: Reader
    grids: dict[str, Any]
    others: list[str]
    damage: InputError | None = None

    def called(self, name: str) -> str:
        """A grid's name here; the first of several of one name may be asked for by its number, as OpenVDB's tools do."""
        first = name.removesuffix("[0]")
        return first if name not in self.grids and first in self.grids else name


def unused(name: str, taken: Collection[str]) -> str:
    """A grid's name, with a number where an earlier one of the file has it."""
    base, number, free = "" if name == "[0]" else name, 0, name
    while free in taken:
        number, free = number + 1, f"{base}[{number + 1}]"
    return free


class Tree:
    """Root, two levels of internal nodes (32^3 and 16^3 children) and leaves of 8^3 voxels."""

    channels = 1
    """Numbers a voxel has: 3 for vectors."""

    def __init__(self, r: Reader, flags: int, half: bool, channels: int = 1) -> None:
        self.r, self.flags, self.half, self.channels = r, flags, half, channels
        self.background = self._value()
        self.boxes: list[tuple[np.ndarray, int, Any]] = []  # active tiles: origin, edge, value
        self.inside: list[tuple[np.ndarray, int, np.ndarray]] = []  # tiles below 0: (n, 3) origins, edge, (n,) values
        self.leaves: list[np.ndarray] = []
        tiles, children = r.number("I"), r.number("I")
        for _ in range(tiles):
            origin, value, active = r.numbers("<i4", 3), self._value(), r.number("?")
            if active:
                self.boxes.append((origin, 4096, value))
            if channels == 1 and value < 0:
                self.inside.append((origin[None].astype(np.int64), 4096, np.array([value], np.float32)))
        for _ in range(children):
            self._internal(r.numbers("<i4", 3).astype(np.int64), 5)
        self._make_room()
        for k in range(len(self.leaves)):
            self.values[k], self.active[k] = self._values(512, r.mask(512))

    def _internal(self, origin: np.ndarray, log2: int) -> None:
        n, edge = 1 << log2, 128 if log2 == 5 else 8
        child, active = self.r.mask(n**3), self.r.mask(n**3)
        values, _ = self._values(n**3, active)
        place = np.stack(np.unravel_index(np.arange(n**3), (n, n, n)), axis=1) * edge + origin
        self._tiles(place[~child], values[~child], active[~child], edge)
        for k in np.flatnonzero(child):
            if log2 == 5:
                self._internal(place[k], 4)
            else:
                self.r.take(64)
                self.leaves.append(place[k])

    def _tiles(self, places: np.ndarray, values: np.ndarray, active: np.ndarray, edge: int) -> None:
        """Keep tiles that are active, and those below 0."""
        which = np.flatnonzero(active)
        if len(self.boxes) + len(which) > BLOCKS:
            raise self.r.fail(f"it has more than {BLOCKS} active tiles")
        self.boxes += [(places[k], edge, values[k]) for k in which]
        if self.channels == 1 and (below := values < 0).any():
            self.inside.append((places[below], edge, values[below]))

    def _make_room(self) -> None:
        """``values`` and ``active``, for the leaves that there are."""
        n = len(self.leaves)
        if n * self.channels > BLOCKS:
            raise self.r.fail(f"it has {n} leaves, {n * self.channels / 2**19:.1f} GiB of values")
        one = (512,) if self.channels == 1 else (512, self.channels)
        self.values, self.active = np.empty((n, *one), np.float32), np.empty((n, 512), bool)

    def _values(self, n: int, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The n values of a node and its active mask, undoing active-mask compression."""
        r = self.r
        code = r.number("b")
        low = (
            -self.background if code in (MINUS, MASK_NONE) else self.background
        )  # of inactive values that are not chosen
        high = self.background
        if code in (ONE_INACTIVE, MASK_ONE, MASK_TWO):
            low = self._value()
            high = self._value() if code == MASK_TWO else high
        chosen = r.mask(n) if code in (MASK_NONE, MASK_ONE, MASK_TWO) else np.zeros(n, bool)
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

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """(first, last + 1) index of the active voxels."""
        low, high = [], []
        if len(self.leaves):
            corner, active = np.array(self.leaves), self.active.reshape(-1, 8, 8, 8)
            for axis in range(3):
                line = active.any(axis=tuple(a for a in (1, 2, 3) if a != axis + 1)).reshape(-1, 8)
                some = line.any(axis=1)
                low.append((corner[:, axis] + line.argmax(axis=1))[some].min(initial=1 << 40))
                high.append((corner[:, axis] + 8 - line[:, ::-1].argmax(axis=1))[some].max(initial=-(1 << 40)))
        low, high = [np.array(low)] if low else [], [np.array(high)] if high else []
        for origin, edge, _ in self.boxes:
            low.append(origin)
            high.append(origin + edge)
        if not low or (np.min(low, axis=0) >= np.max(high, axis=0)).any():
            raise self.r.fail("it has no active voxel")
        return np.min(low, axis=0), np.max(high, axis=0)

    def refuse(self, size: np.ndarray, bytes_: float, what: str) -> None:
        """Files of a few bytes must not ask for gigabytes."""
        if bytes_ > 4 * LIMIT or (bytes_ > 4 * FREE_LIMIT and bytes_ > LARGEST_RATIO * len(self.r.data)):
            extent = "x".join(str(int(v)) for v in size)
            raise self.r.fail(f"its voxels lie {extent} apart, {bytes_ / 2**30:.1f} GiB as {what}")

    def sparse(self) -> tuple[np.ndarray, Sparse]:
        """(first index, volume) over the active voxels."""
        first, last = self.box()
        tiles = [self._tile(*box, first, last) for box in self.boxes]
        blocks = len(self.leaves) + sum(float(np.prod(counts)) for _, counts, _ in tiles)
        bricks = float(np.prod(-(-(last - first).astype(float) // 8)))
        self.refuse(last - first, 2048.0 * self.channels * blocks + 24.0 * bricks, "blocks")
        corners = [np.array(self.leaves, np.int64).reshape(-1, 3)]
        values = [self.values.reshape(-1, 8, 8, 8, *self.values.shape[2:])]
        for start, counts, value in tiles:
            corners.append(8 * np.stack(np.unravel_index(np.arange(int(np.prod(counts))), counts), axis=1) + start)
            values.append(np.broadcast_to(np.asarray(value, np.float32), (len(corners[-1]), *values[0].shape[1:])))
        joined = (np.concatenate(a) if tiles else a[0] for a in (corners, values))
        corner, blocks_ = joined
        a, b, c = (int(n) for n in last - first)
        return first, Sparse(corner - first, blocks_, (a, b, c))

    def _tile(self, origin: np.ndarray, edge: int, value: Any, first: np.ndarray, last: np.ndarray) -> tuple[Any, ...]:
        """(first index, blocks an axis, value) of the part of a tile that lies in the box."""
        a, b = np.maximum(origin, first - first % 8), np.minimum(origin + edge, last)
        return a, tuple(int(n) for n in np.maximum(-(-(b - a) // 8), 0)), value

    def dense(self) -> tuple[np.ndarray, np.ndarray]:
        """(first index, values) over the active voxels."""
        first, last = self.box()
        self.refuse(last - first, 4.0 * self.channels * float(np.prod((last - first).astype(float))), "a dense grid")
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
        for origin, values in zip(self.leaves, self.values, strict=True):
            put(origin, 8, values.reshape(8, 8, 8, *values.shape[1:]))
        return first, out
