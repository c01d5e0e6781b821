"""Volumes in bricks: how samples come to lie in the 8^3 cells, 9^3 samples each, that media look up (``media.py``).

``Sparse`` is a volume as OpenVDB keeps it, blocks of 8^3 samples and 0 everywhere else; it is cut into bricks without a dense
array of the whole in between.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth.errors import InputError

BRICK = 8
SIDE = BRICK + 1
TOGETHER = 2048  # blocks that are handled at once: their numbers take some 50 MiB
MOST = 1 << 28  # bricks of a medium, stored or empty: 24 bytes each


@dataclass(frozen=True)
class Sparse:
    """A volume of ``size`` samples (nx, ny, nz), 0 but for blocks. corner: (n, 3) index of each block's first sample, which may
    lie outside, as other samples of it may: those do not count. blocks: (n, 8, 8, 8) numbers or (n, 8, 8, 8, c) vectors,
    float32."""

    corner: np.ndarray
    blocks: np.ndarray
    size: tuple[int, int, int]

    @property
    def shape(self) -> tuple[int, ...]:
        """That of the dense array."""
        return (*self.size, *self.blocks.shape[4:])

    def max(self) -> float:
        """The largest sample."""
        return float(self.blocks.max(initial=0.0))

    def min(self) -> float:
        """The smallest sample."""
        return float(self.blocks.min(initial=0.0))

    def map(self, function: Any) -> Sparse:
        """``function`` of all samples, chunk by chunk; it keeps 0 and the shape."""
        out = np.empty_like(self.blocks)
        for k in range(0, len(out), TOGETHER):
            out[k : k + TOGETHER] = function(self.blocks[k : k + TOGETHER])
        return Sparse(self.corner, out, self.size)

    def upright(self) -> Sparse:
        """With y up turned to z up, right-handed: x, y, z -> x, -z, y."""
        corner = np.stack([self.corner[:, 0], self.size[2] - BRICK - self.corner[:, 2], self.corner[:, 1]], axis=1)
        blocks = self.blocks[:, :, :, ::-1].swapaxes(2, 3)
        return Sparse(corner, np.ascontiguousarray(blocks), (self.size[0], self.size[2], self.size[1]))

    def dense(self) -> np.ndarray:
        """All samples."""
        out = np.zeros(self.shape, np.float32)
        for corner, block in zip(self.corner, self.blocks, strict=True):
            a, b = np.maximum(corner, 0), np.minimum(corner + BRICK, self.size)
            c, d = a - corner, b - corner
            if (a < b).all():
                out[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = block[c[0] : d[0], c[1] : d[1], c[2] : d[2]]
        return out


class Bricks(NamedTuple):
    """counts: bricks an axis; offsets: (bricks,) first sample or -1; top, bottom: bounds of each; samples: of the stored ones;
    kept: their numbers."""

    counts: tuple[int, int, int]
    offsets: np.ndarray
    top: np.ndarray
    bottom: np.ndarray
    samples: np.ndarray
    kept: np.ndarray


def counts_of(size: Sequence[int]) -> tuple[int, int, int]:
    """Bricks an axis of a grid of ``size`` samples."""
    a, b, c = (-(-(int(n) - 1) // BRICK) for n in size)
    return a, b, c


def bricks(density: np.ndarray | Sparse) -> Bricks:
    """The bricks of a volume; those without density are not stored."""
    counts = counts_of(density.shape[:3])
    total = int(np.prod(counts))
    if total > MOST:
        raise InputError(f"medium: {density.shape} samples make {total} bricks, more than {MOST}")
    top, bottom = np.zeros(total), np.zeros(total)
    if isinstance(density, Sparse):
        mark = np.zeros(total, bool)
        for brick, _, value in _scattered(density, counts):
            mark[brick[value > 0]] = True
        kept = np.flatnonzero(mark)
        blocks = cut_to(density, kept)
        top[kept], bottom[kept] = blocks.max(axis=1), blocks.min(axis=1)
    else:
        blocks = _windows(density).reshape(-1, SIDE**3)
        top[:], bottom[:] = blocks.max(axis=1), blocks.min(axis=1)
        kept = np.flatnonzero(top > 0)
        blocks = blocks[kept]
    offsets = np.full(total, -1, np.int64)
    offsets[kept] = np.arange(len(kept)) * SIDE**3
    return Bricks(counts, offsets, top, bottom, np.ascontiguousarray(blocks).ravel(), kept)


def cut_to(values: ArrayLike | Sparse, kept: np.ndarray) -> np.ndarray:
    """(bricks kept, 9^3[, c]) samples of a volume of any shape."""
    if not isinstance(values, Sparse):
        windows = _windows(np.asarray(values), "edge")
        places = np.unravel_index(kept, windows.shape[:3])
        return np.ascontiguousarray(windows[places]).reshape(len(kept), SIDE**3, *windows.shape[6:])
    counts = counts_of(values.size)
    rank = np.full(int(np.prod(counts)), -1, np.int64)
    rank[kept] = np.arange(len(kept))
    out = np.zeros((len(kept), SIDE**3, *values.blocks.shape[4:]), np.float32)
    for brick, sample, value in _scattered(values, counts):
        at = rank[brick]
        out[at[at >= 0], sample[at >= 0]] = value[at >= 0]
    return out


def _windows(a: np.ndarray, beyond: Literal["constant", "edge"] = "constant") -> np.ndarray:
    """(bx, by, bz, 9, 9, 9[, c]) overlapping windows of a dense volume; beyond it are zeros, or its edge again."""
    counts = counts_of(a.shape[:3])
    padding = [(0, n * BRICK + 1 - size) for n, size in zip(counts, a.shape, strict=False)] + [(0, 0)] * (a.ndim - 3)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(a, padding, beyond), (SIDE,) * 3, axis=(0, 1, 2))  # type: ignore[call-overload]
    windows = windows[::BRICK, ::BRICK, ::BRICK]
    return windows if a.ndim == 3 else np.moveaxis(windows, 3, -1)


def _scattered(volume: Sparse, counts: tuple[int, int, int]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(brick, sample in it, value) of every sample that is not 0, once for each brick that holds it: neighbours share faces."""
    inner = np.stack(np.unravel_index(np.arange(BRICK**3), (BRICK,) * 3), axis=1)
    size, n = np.array(volume.size), np.array(counts)
    for k in range(0, len(volume.blocks), TOGETHER):
        values = volume.blocks[k : k + TOGETHER]
        values = values.reshape(-1, *values.shape[4:])
        there = np.flatnonzero(values if values.ndim == 1 else values.any(axis=1))
        at = volume.corner[k + (there >> 9)] + inner[there & 511]
        counted = ((at >= 0) & (at < size)).all(axis=1)
        at, values = at[counted].T, values[there[counted]]
        brick, inside = at >> 3, at & 7
        own = brick < n[:, None], (inside == 0) & (brick > 0)  # of its own brick along an axis, and of the one before
        for s in np.ndindex(2, 2, 2):
            chosen = np.flatnonzero(own[s[0]][0] & own[s[1]][1] & own[s[2]][2])
            b = [brick[axis, chosen] - s[axis] for axis in range(3)]
            i = [inside[axis, chosen] + BRICK * s[axis] for axis in range(3)]
            yield (b[0] * n[1] + b[1]) * n[2] + b[2], (i[0] * SIDE + i[1]) * SIDE + i[2], values[chosen]
