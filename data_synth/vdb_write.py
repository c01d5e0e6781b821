"""Writing sparse OpenVDB files: grids of numbers and of vectors (Museth 2013; the layout follows OpenVDB's io, version 224).

The one writer of the project: ground truth (``volumes.write_density``) and exported models (``nerfvol.export.vdb``) go
through it. Only active voxels are stored, in half or single precision, deflated block by block ("zip + active values"). A
grid carries the metadata without which programs show it as a nameless volume of size 0: its name, class and bounding box.
"""

from __future__ import annotations

import os
import struct
import uuid
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from data_synth.errors import InputError
from data_synth.files import replacing

MAGIC = 0x56444220
VERSION = 224
ZIP, ACTIVE_MASK = 1, 2  # bits of the compression flag
LARGEST_HALF = 65504.0
FARTHEST = 1 << 30  # of an index; OpenVDB's are 32 bits
_OUTSIDE_IS_BACKGROUND = b"\0"  # how inactive values are stored: not at all
_LEVEL = 9  # of deflate: blocks are small, so that it costs little


@dataclass
class SparseGrid:
    """A grid of active voxels; all others are 0.

    name: what programs call it. coords: (n, 3) whole numbers, the voxels' indices, each once. values: (n,) numbers or (n, 3)
    vectors. voxel_size, origin: (3,), the world position of index i is origin + voxel_size * i, the middle of its voxel.
    kind: OpenVDB's class, "fog volume" for densities.
    """

    name: str
    coords: np.ndarray
    values: np.ndarray
    voxel_size: ArrayLike = (1.0, 1.0, 1.0)
    origin: ArrayLike = (0.0, 0.0, 0.0)
    kind: Literal["fog volume", "unknown"] = "fog volume"


def write_grids(path: str | os.PathLike, grids: Sequence[SparseGrid], half: bool = True) -> int:
    """Writes ``grids`` to one file, atomically and block by block; its bytes.

    half: 16-bit floats, 11 bits of precision; values beyond 65504 are refused then.

    Raises:
        InputError: a grid without active voxels, values that are not finite or too large, an index given twice or out of range.
    """
    layouts = [_Layout(path, grid, half) for grid in grids]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<qIII?", MAGIC, VERSION, 10, 0, True) + str(uuid.UUID(int=0)).encode())
        file.write(_entries({"creator": ("string", b"nerfvol")}) + struct.pack("<I", len(grids)))
        for layout in layouts:
            file.write(_text(layout.grid.name) + _text(layout.type_name) + _text(""))
            at = file.tell()
            file.write(bytes(24))
            start = file.tell()
            file.write(layout.head())
            for part in layout.topology():
                file.write(part)
            block = file.tell()
            for part in layout.buffers():
                file.write(part)
            end = file.tell()
            file.seek(at)
            file.write(struct.pack("<qqq", start, block, end))
            file.seek(end)
        return file.tell()


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _entries(entries: dict[str, tuple[str, bytes]]) -> bytes:
    """A map of metadata: name -> (type, bytes)."""
    parts = [_text(name) + _text(kind) + struct.pack("<I", len(d)) + d for name, (kind, d) in entries.items()]
    return struct.pack("<I", len(parts)) + b"".join(parts)


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask, bitorder="little").tobytes()


def _zipped(data: bytes) -> bytes:
    """OpenVDB's zip: bytes of the deflated data before them, or minus the bytes of data left as they are."""
    packed = zlib.compress(data, _LEVEL)
    return struct.pack("<q", len(packed)) + packed if len(packed) < len(data) else struct.pack("<q", -len(data)) + data


class _Layout:
    """Where a grid's voxels lie in the tree: root, nodes of 32^3 and 16^3 children, leaves of 8^3 voxels."""

    def __init__(self, path: str | os.PathLike, grid: SparseGrid, half: bool) -> None:
        self.grid, self.half = grid, half
        coords, values = np.asarray(grid.coords, np.int64), np.asarray(grid.values, np.float32)
        self._check(path, coords, values)
        self.vector = values.ndim == 2
        roots = coords >> 12
        lowest = roots.min(axis=0)
        counts = tuple(roots.max(axis=0) - lowest + 1)  # numbers are sorted in a tenth of the time that rows take
        found, root = np.unique(np.ravel_multi_index(tuple((roots - lowest).T), counts), return_inverse=True)
        self.roots = np.stack(np.unravel_index(found, counts), axis=1) + lowest
        keys = root.reshape(-1).astype(np.int64)
        for shift, bits in ((7, 5), (3, 4), (0, 3)):
            for axis in range(3):
                keys = (keys << bits) | (coords[:, axis] >> shift & ((1 << bits) - 1))
        order = np.argsort(keys, kind="stable")
        self.keys, self.order, self.values = keys[order], order, values
        if (np.diff(self.keys) == 0).any():
            raise InputError(f"{path}: the grid {grid.name} has a voxel twice")
        self.low, self.high = coords.min(axis=0), coords.max(axis=0)
        leaf = self.keys >> 9
        self.starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(leaf)), [len(leaf)]])
        self.leaves = leaf[self.starts[:-1]]

    def _check(self, path: str | os.PathLike, coords: np.ndarray, values: np.ndarray) -> None:
        name = self.grid.name
        if (
            not len(coords)
            or coords.shape != (len(values), 3)
            or values.shape not in ((len(coords),), (len(coords), 3))
        ):
            raise InputError(
                f"{path}: the grid {name} needs active voxels (n, 3) and as many values, got {coords.shape} and {values.shape}"
            )
        if not np.isfinite(values).all() or self.half and np.abs(values).max() > LARGEST_HALF:
            raise InputError(f"{path}: values of the grid {name} are not finite or too large for 16-bit floats")
        if np.abs(coords).max() > FARTHEST:
            raise InputError(f"{path}: indices of the grid {name} lie beyond {FARTHEST}")

    @property
    def _nothing(self) -> bytes:
        """No values at all, as a node without tiles has them: OpenVDB reads and writes the bytes they take, 0, save in half
        precision, where it returns before."""
        return b"" if self.half else struct.pack("<q", 0)

    @property
    def type_name(self) -> str:
        return f"Tree_{'vec3s' if self.vector else 'float'}_5_4_3{'_HalfFloat' if self.half else ''}"

    def head(self) -> bytes:
        """Flags, metadata and transform."""
        whole = lambda v: struct.pack("<3i", *(int(x) for x in v))  # noqa: E731
        metadata = {
            "name": ("string", self.grid.name.encode()),
            "class": ("string", self.grid.kind.encode()),
            "file_bbox_min": ("vec3i", whole(self.low)),
            "file_bbox_max": ("vec3i", whole(self.high)),
            "file_compression": ("string", b"zip + active values"),
            "file_voxel_count": ("int64", struct.pack("<q", len(self.keys))),
            "is_saved_as_half_float": ("bool", struct.pack("<?", self.half)),
        }
        s, origin = (np.broadcast_to(np.asarray(v, float), 3) for v in (self.grid.voxel_size, self.grid.origin))
        scale = np.concatenate([origin, s, s, 1 / s, 1 / s**2, 0.5 / s]).astype("<f8").tobytes()
        return struct.pack("<I", ZIP | ACTIVE_MASK) + _entries(metadata) + _text("ScaleTranslateMap") + scale

    def topology(self) -> Iterator[bytes]:
        """Masks of all nodes, parents before children."""
        background = bytes(12 if self.vector else 4)
        yield struct.pack("<I", 1) + background + struct.pack("<II", 0, len(self.roots))
        middle = self.leaves >> 12  # of each leaf, its node of 16^3 children, with the root's child above it
        for number, root in enumerate(self.roots):
            below = np.unique(middle[middle >> 15 == number])
            yield struct.pack("<3i", *(int(x) << 12 for x in root)) + self._node(below & 32767, 32768)
            for node in below:
                first, last = np.searchsorted(middle, [node, node + 1])
                yield self._node(self.leaves[first:last] & 4095, 4096)
                for i in range(first, last):
                    yield self._mask(i)

    def _node(self, children: np.ndarray, size: int) -> bytes:
        child = np.zeros(size, bool)
        child[children] = True
        return _bits(child) + bytes(size // 8) + _OUTSIDE_IS_BACKGROUND + self._nothing

    def _mask(self, leaf: int) -> bytes:
        active = np.zeros(512, bool)
        active[self.keys[self.starts[leaf] : self.starts[leaf + 1]] & 511] = True
        return _bits(active)

    def buffers(self) -> Iterator[bytes]:
        """Mask and active values of each leaf."""
        kind = "<f2" if self.half else "<f4"
        for i in range(len(self.leaves)):
            rows = self.order[self.starts[i] : self.starts[i + 1]]
            yield self._mask(i) + _OUTSIDE_IS_BACKGROUND + _zipped(self.values[rows].astype(kind).tobytes())


def write_vdb(
    path: str | os.PathLike,
    values: np.ndarray,
    voxel_size: ArrayLike = (1.0, 1.0, 1.0),
    origin: ArrayLike = (0.0, 0.0, 0.0),
    half: bool = False,
) -> int:
    """Writes non-negative (nx, ny, nz) values as the float grid "density"; voxels above 0 are active. Returns the bytes."""
    values = np.asarray(values, np.float32)
    if values.ndim != 3 or max(values.shape) > 4096 or not np.isfinite(values).all():
        raise InputError("write_vdb: expected a finite 3D array of at most 4096 voxels a side")
    coords = np.argwhere(values > 0)
    grid = SparseGrid("density", coords, values[tuple(coords.T)], voxel_size, origin)
    return write_grids(path, [grid], half)
