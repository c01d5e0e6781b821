"""Reading NanoVDB files (Museth 2021), as far as volumes and level sets need them: grids of float, also quantised, and vec3f.

The layout is that of NanoVDB.h and PNanoVDB.h, major version 32, which files since 2021 have: tables at fixed offsets, children
by byte offsets from their parents. Segments are stored as they are, in zip, or in Blosc. Sizes, offsets and counts are checked
against the file before anything is read at them, so that damage is an ``InputError``. What is read is a ``vdb_tree.Tree``.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_synth.blosc import decompress
from data_synth.errors import InputError
from data_synth.vdb_tree import LARGEST_RATIO, Contents, Reader, Tree, unused

MAGIC = (b"NanoVDB0", b"NanoVDB2")  # of files; of grids NanoVDB0 or NanoVDB1
MAJOR = 32
KINDS = {1: "level set", 2: "fog volume"}
CODECS = ("none", "zip", "blosc")
HEADER, META, GRID, TREE = 16, 176, 672, 64
LARGEST = 9 << 29  # bytes of a grid: beyond, its voxels are refused in any case
PLACES = 1 << 16  # of a root: 4096 voxels a side each
NAMES = ("unknown float double int16 int32 int64 vec3f vec3d mask half uint32 bool rgba8 fp4 fp8 fp16 fpN vec4f vec4d "
         "index").split()  # fmt: skip
"""Of the types of grids, for messages."""


class Layout(NamedTuple):
    """How grids of one type lie: bytes of the root before its places, of an entry of an internal node, and of a leaf, where a
    leaf's values begin, and their bits where they are quantised."""

    channels: int
    root: int
    entry: int
    leaf: int
    table: int
    bits: int = 0


LAYOUTS = {
    1: Layout(1, 64, 8, 2144, 96), 6: Layout(3, 96, 16, 6272, 128),
    13: Layout(1, 64, 8, 352, 96, 4), 14: Layout(1, 64, 8, 608, 96, 8), 15: Layout(1, 64, 8, 1120, 96, 16),
}  # fmt: skip
"""Of float, vec3f, fp4, fp8 and fp16, by the number of the type."""


class Stored(NamedTuple):
    """A grid in a file: where its bytes are, how they are packed, and how many they are then."""

    name: str
    type: int
    kind: str
    at: int
    stored: int
    size: int
    codec: int

    @property
    def channels(self) -> int:
        return LAYOUTS[self.type].channels if self.type in LAYOUTS else 0


class _File(Reader):
    def fail(self, what: str, wanted: str = "float volume") -> InputError:
        return InputError(f"{self.path}: expected a NanoVDB {wanted}, {what}")


def contents(path: str | os.PathLike) -> Contents:
    """What a file holds: of float and vec3f, and of other types."""
    try:
        r = _File(Path(path).read_bytes(), path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    held: dict[str, Stored] = {}
    others: list[str] = []
    try:
        while r.at < len(r.data):
            for one, kind in _segment(r):
                one = one._replace(at=r.at)
                r.take(one.stored)
                if one.channels:
                    held[unused(one.name, held)] = one
                else:
                    others.append(f"{one.name} ({kind})")
    except InputError as error:  # where the next one begins is not known
        return Contents(r, held, others, error)
    return Contents(r, held, others)


def _segment(r: Reader) -> list[tuple[Stored, str]]:
    """What the head of a segment lists; its grids' bytes come next, one after the other."""
    where = "the first bytes" if r.at == 0 else "the bytes where its next segment begins"
    if r.take(8) not in MAGIC:
        raise r.fail(f"{where} are another format's")
    version, count, codec = r.number("I"), r.number("H"), r.number("H")
    if version >> 21 != MAJOR:
        raise r.fail(f"its layout is version {version >> 21}, not {MAJOR}: nanovdb_convert makes a .vdb of it")
    if codec >= len(CODECS):
        raise r.fail(f"its codec is number {codec}")
    return [_listed(r, codec) for _ in range(count)]


def _listed(r: Reader, codec: int) -> tuple[Stored, str]:
    meta = r.take(META)
    size, stored = struct.unpack_from("<QQ", meta)
    kind, class_ = struct.unpack_from("<II", meta, 32)
    name = r.take(struct.unpack_from("<I", meta, 136)[0]).split(b"\0")[0].decode("utf-8", "replace") or "[0]"
    if size > min(LARGEST, LARGEST_RATIO * (stored + 64)):
        raise r.fail(f"the grid {name} says it has {size} bytes")
    said = NAMES[kind] if kind < len(NAMES) else f"type {kind}"
    return Stored(name, kind, KINDS.get(class_, ""), 0, stored, size, codec), said


def grid_of(r: Reader, one: Stored) -> tuple[NanoTree, np.ndarray, np.ndarray]:
    """(tree, voxel size, origin) of a grid."""
    data = _unpacked(r, one)
    if len(data) < GRID + TREE or data[:8] not in (b"NanoVDB0", b"NanoVDB1"):
        raise r.fail(f"the grid {one.name} does not begin as one")
    matrix = np.frombuffer(data, "<f8", 9, 296 + 88).reshape(3, 3)
    origin = np.frombuffer(data, "<f8", 3, 296 + 88 + 144)
    taper = struct.unpack_from("<d", data, 296 + 88 + 168)[0]
    if not (np.isfinite(matrix).all() and np.isfinite(origin).all()) or taper != 1:
        raise r.fail("its transform is a frustum's" if taper != 1 else "its transform has numbers that are none")
    if np.abs(matrix - np.diag(np.diag(matrix))).max() > 1e-9 * np.abs(matrix).max():
        raise r.fail("its transform rotates")
    return NanoTree(r, data, LAYOUTS[one.type]), np.diag(matrix).copy(), origin.copy()


def _unpacked(r: Reader, one: Stored) -> bytes:
    packed = r.data[one.at : one.at + one.stored]
    try:
        if CODECS[one.codec] == "none":
            out = packed
        elif CODECS[one.codec] == "zip":
            out = zlib.decompressobj().decompress(packed[8:], one.size)
        else:
            out = b"".join(_frames(packed, one.size))
    except (zlib.error, ValueError, struct.error) as error:
        raise r.fail(f"its compressed data are damaged: {error}") from error
    if len(out) != one.size:
        raise r.fail(f"the grid {one.name} has {len(out)} bytes, not {one.size}")
    return out


def _frames(packed: bytes, size: int) -> Iterator[bytes]:
    """Blosc frames, the bytes of each before it."""
    at = 0
    while at < len(packed):
        (length,), (wanted,) = struct.unpack_from("<Q", packed, at), struct.unpack_from("<I", packed, at + 12)
        size -= wanted
        if size < 0 or length > len(packed) - at - 8:
            raise ValueError("a frame is longer than the grid")
        yield decompress(packed[at + 8 : at + 8 + length], wanted).tobytes()
        at += 8 + length


class NanoTree(Tree):
    """The tree of a NanoVDB grid. Nodes of 32^3 and 16^3 places hold a value or the distance to a child in each."""

    def __init__(self, r: Reader, data: bytes, layout: Layout) -> None:
        self.r, self.data, self.layout, self.channels = r, data, layout, layout.channels
        self.boxes, self.inside, self.leaves = [], [], []
        self.addresses: list[int] = []
        root = GRID + self._number("<Q", GRID + 24)
        count, value = self._number("<I", root + 24), self._numbers_at(root + 28, 1)[0]
        self.background = float(value) if self.channels == 1 else value
        self.left = len(data)  # bytes that nodes can take: places that share a node would fill any memory
        if count > min(PLACES, len(data) // 32):
            raise r.fail(f"its root says it has {count} places")
        for at in range(root + layout.root, root + layout.root + 32 * count, 32):
            key, child, state = self._number("<Q", at), self._number("<q", at + 8), self._number("<I", at + 16)
            place = np.array([key >> 42 & 0xFFFFF, key >> 21 & 0xFFFFF, key & 0xFFFFF], np.int64) << 12
            place -= (place >> 31) << 32  # 32 bits with a sign
            if child:
                self._internal_at(root + child, place, 5)
            else:
                self._tiles(place[None], self._numbers_at(at + 20, 1), np.array([state != 0]), 4096)
        self._read_leaves()

    def _number(self, kind: str, at: int) -> int:
        return struct.unpack(kind, self._take(at, struct.calcsize(kind)))[0]

    def _take(self, at: int, n: int) -> bytes:
        if at < GRID or at + n > len(self.data):
            raise self.r.fail("a place in it points out of the grid")
        return self.data[at : at + n]

    def _mask_at(self, at: int, bits: int) -> np.ndarray:
        return np.unpackbits(np.frombuffer(self._take(at, bits // 8), "u1"), bitorder="little").astype(bool)

    def _numbers_at(self, at: int, n: int) -> np.ndarray:
        found = np.frombuffer(self._take(at, 4 * n * self.channels), "<f4")
        return found if self.channels == 1 else found.reshape(n, self.channels)

    def _internal_at(self, at: int, origin: np.ndarray, log2: int) -> None:
        n, edge = 1 << log2, 128 if log2 == 5 else 8
        bits, entry = n**3, self.layout.entry
        self.left -= entry * bits
        if self.left < 0:
            raise self.r.fail("it says it has more nodes than there is room for")
        active, child = self._mask_at(at + 32, bits), self._mask_at(at + 32 + bits // 8, bits)
        table = self._take(at + (8256 if log2 == 5 else 1088), entry * bits)
        place = np.stack(np.unravel_index(np.arange(bits), (n, n, n)), axis=1) * edge + origin
        values = np.frombuffer(table, "<f4").reshape(bits, entry // 4)[:, : self.channels]
        values = values[:, 0] if self.channels == 1 else values
        self._tiles(place[~child], values[~child], active[~child], edge)
        away = np.frombuffer(table, "<i8").reshape(bits, entry // 8)[:, 0]
        for k in np.flatnonzero(child):
            if log2 == 5:
                self._internal_at(at + int(away[k]), place[k], 4)
                continue
            self.leaves.append(place[k])
            self.addresses.append(at + int(away[k]))
        if len(self.leaves) * self.layout.leaf > len(self.data):
            raise self.r.fail("it says it has more leaves than there is room for")

    def _read_leaves(self) -> None:
        layout = self.layout
        self._make_room()
        for k, at in enumerate(self.addresses):
            self.active[k] = self._mask_at(at + 16, 512)
            if not layout.bits:
                self.values[k] = self._numbers_at(at + layout.table, 512)
                continue
            least, quantum = struct.unpack("<ff", self._take(at + 80, 8))
            codes = np.frombuffer(self._take(at + layout.table, 64 * layout.bits), "<u2" if layout.bits == 16 else "u1")
            if layout.bits == 4:
                codes = np.stack([codes & 15, codes >> 4], axis=1).ravel()
            self.values[k] = codes.astype(np.float32) * np.float32(quantum) + np.float32(least)
