"""Splats as the kernels keep them: blocks of 16, structure of arrays inside, on cache lines.

``params`` (n_blocks, 11 + 3 K, 16) float32; row 0-2 means, 3-5 log-scales, 6-9 quaternions, 10 logit, then the coefficients of
red, green and blue. Lanes beyond the last splat hold one that is never seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.native import aligned, aligned_empty
from nerfvol.splats.splats import Splats

LANES = 16
MEANS, LOG_SCALES, QUATS, LOGIT, SH = slice(0, 3), slice(3, 6), slice(6, 10), 10, 11
UNSEEN = -60.0
"""The logit of what stands in the last block's free lanes."""


@dataclass
class PackedSplats:
    """params: (n_blocks, rows, 16) float32 of ``n`` splats; origin and mode as in Splats."""

    params: NDArray[np.float32]
    n: int
    origin: NDArray[np.float64]
    mode: str

    @property
    def basis(self) -> int:
        """K: coefficients of a channel."""
        return (self.params.shape[1] - SH) // 3

    @property
    def sh_degree(self) -> int:
        """Degree of the colours' spherical harmonics."""
        return math.isqrt(self.basis) - 1


def n_blocks(n: int) -> int:
    """Blocks of 16 lanes that ``n`` splats take; the last one may have free lanes."""
    return -(-n // LANES)


def padding(rows: int) -> NDArray[np.float32]:
    """(rows,) the splat of free lanes."""
    out = np.zeros(rows, np.float32)
    out[QUATS.start], out[LOGIT] = 1.0, UNSEEN
    return out


def to_blocks(rows: NDArray[np.float32], fill: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n_blocks, k, 16) of ``rows`` (n, k); free lanes get ``fill`` (k,)."""
    n, k = rows.shape
    out = aligned_empty((n_blocks(n), k, LANES), np.float32)
    whole = n // LANES
    out[:whole] = rows[: whole * LANES].reshape(whole, LANES, k).transpose(0, 2, 1)
    if n % LANES:
        out[whole] = fill[:, None]
        out[whole, :, : n % LANES] = rows[whole * LANES :].T
    return out


def from_blocks(blocks: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """The inverse of :func:`to_blocks`: (n, k)."""
    return blocks.transpose(0, 2, 1).reshape(-1, blocks.shape[1])[:n]


def pack(splats: Splats) -> PackedSplats:
    """A copy of ``splats`` in blocks."""
    parts = (
        splats.means,
        splats.log_scales,
        splats.quats,
        splats.logits[:, None],
        splats.sh.reshape(splats.n, 3 * splats.sh.shape[2]),
    )
    rows = np.concatenate(parts, axis=1)
    return PackedSplats(to_blocks(rows, padding(rows.shape[1])), splats.n, splats.origin.copy(), splats.mode)


def unpack(packed: PackedSplats) -> Splats:
    """A copy of ``packed`` as plain arrays."""
    rows = from_blocks(packed.params, packed.n)
    sh = rows[:, SH:].reshape(packed.n, 3, packed.basis)
    return Splats(
        rows[:, MEANS].copy(), rows[:, LOG_SCALES].copy(), rows[:, QUATS].copy(), rows[:, LOGIT].copy(), sh.copy(),
        packed.origin.copy(), packed.mode,
    )  # fmt: skip


def as_packed(splats: Splats | PackedSplats) -> PackedSplats:
    """``splats`` in blocks that begin on a cache line."""
    if isinstance(splats, Splats):
        return pack(splats)
    return PackedSplats(aligned(splats.params, np.float32), splats.n, splats.origin, splats.mode)
