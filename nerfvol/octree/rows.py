"""What a vertex row of an octree holds: raw density and the spherical harmonics of the colour, packed in blocks of 16."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerfvol.native import aligned_empty

EMPTY_DENSITY = -7.0


BLOCKS = {0: 1, 1: 1, 2: 2, 3: 4}


DENSITY_SLOT = 12


DENSITY_SCALE = 300.0
"""Coefficient that a raw density of 1 means where training begins, per edge of the inner cube: leaves of 1/300 of it are then
opaque to 63 %."""


def explin(raw: np.ndarray) -> np.ndarray:
    """exp(raw - 1) below 1, raw above: positive, with a bounded slope [SVRaster]. Any shape."""
    return np.where(raw < 1, np.exp(np.minimum(raw, 1) - 1), raw)


def explin_inverse(value: np.ndarray) -> np.ndarray:
    """The raw density whose :func:`explin` is ``value`` > 0. Any shape."""
    return np.where(value < 1, np.log(np.minimum(value, 1)) + 1, value)


def sh_slots(degree: int) -> np.ndarray:
    """Where coefficient k of channel c is stored in a vertex row: (3, (degree + 1)**2) int. Density is at slot 12.

    Rows are blocks of 16: four coefficients of red, four of green, four of blue, four spare places (the first block's
    hold the density, the second's the ninth coefficients of degree 2).
    """
    k = np.arange((degree + 1) ** 2)
    c = np.arange(3)[:, None]
    slots = 16 * (k // 4) + 4 * c + k % 4
    return np.where((k == 8) & (degree == 2), 28 + c, slots)


def convert_rows(rows: np.ndarray, old_degree: int, new_degree: int) -> np.ndarray:
    """Packed vertex rows of one SH degree as those of another: missing bands zero, surplus ones dropped.

    (n, 16 * BLOCKS[old_degree]) -> (n, 16 * BLOCKS[new_degree]), a new array of the same dtype.
    """
    out = aligned_empty((len(rows), 16 * BLOCKS[new_degree]), rows.dtype)
    out[:] = 0
    k = (min(old_degree, new_degree) + 1) ** 2
    out[:, sh_slots(new_degree)[:, :k]] = rows[:, sh_slots(old_degree)[:, :k]]
    out[:, DENSITY_SLOT] = rows[:, DENSITY_SLOT]
    return out


@dataclass(frozen=True)
class PrefilteredNodes:
    """What interior nodes are drawn with: corners (n_nodes, 8) int32, rows of values (n, row) float32.

    The rows are packed like those of the octree's vertices.
    """

    corners: np.ndarray
    values: np.ndarray
