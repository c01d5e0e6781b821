"""Distributions of microflakes as tables over the upper hemisphere, bilinear in polar angle and azimuth (PHYSICS 11).

sigma by quadrature at the same nodes; normals by the inverse of the cumulative sum over cells and rejection in a cell,
exactly distributed as the table says.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth.checks import direction
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.rng import uniform
from data_synth.vec import bilinear, dot, neg

RESOLUTION = 48  # cells from pole to equator; twice as many around


class Table(NamedTuple):
    """``kinds`` distributions. values: one array, since every array makes every kernel that is handed a medium slower to
    compile: D, then sigma, each (kinds, rows + 1, columns) at polar angles 0 ... pi/2 and azimuths 0 ... 2 pi, then (kinds,
    rows * columns) cumulative sums of the cells' largest D times their solid angle."""

    values: np.ndarray
    kinds: int
    rows: int
    columns: int

    @property
    def D(self) -> np.ndarray:
        """(kinds, rows + 1, columns) area per sr."""
        return self._part(0)

    @property
    def sigma(self) -> np.ndarray:
        """(kinds, rows + 1, columns) projected areas."""
        return self._part(1)

    def _part(self, k: int) -> np.ndarray:
        n = self.kinds * (self.rows + 1) * self.columns
        return self.values[k * n : (k + 1) * n].reshape(self.kinds, self.rows + 1, self.columns)

    @property
    def cumulative(self) -> np.ndarray:
        """(kinds, rows * columns)."""
        return self.values[2 * self.D.size :].reshape(self.kinds, self.rows * self.columns)


EMPTY = Table(np.zeros(0), 0, 1, 1)


def tabulated(D: Callable[[np.ndarray], ArrayLike] | ArrayLike, resolution: int = RESOLUTION) -> Table:
    """The table of a function of (n, 3) unit normals, or of its (rows + 1, columns) values: area per sr, which is made even."""
    if callable(D):
        if not 4 <= resolution <= 256:
            raise InputError(f"microflakes: resolution must be from 4 to 256, got {resolution}")
        m = _nodes(resolution, 2 * resolution)
        values = 0.5 * (np.asarray(D(m.reshape(-1, 3)), float) + np.asarray(D(-m.reshape(-1, 3)), float))
        if values.shape != (m.size // 3,):
            raise InputError(f"microflakes: D must give one number for each normal, got shape {values.shape}")
        values = values.reshape(resolution + 1, 2 * resolution)
    else:
        values = np.array(D, float)
    shape = values.shape
    if len(shape) != 2 or min(shape) < 2 or shape[1] % 2 or max(shape) > 1024:
        raise InputError(f"microflakes: D must be a table of an even number of columns, got shape {values.shape}")
    if not np.isfinite(values).all() or values.min() < 0 or not values.max() > 0:
        raise InputError("microflakes: D must be finite, not negative, and somewhere positive")
    values[0] = values[0].mean()  # one normal, the pole
    values[-1] = 0.5 * (values[-1] + np.roll(values[-1], shape[1] // 2))  # opposite normals on the equator
    corners = np.stack([values[:-1], values[1:], np.roll(values[:-1], -1, 1), np.roll(values[1:], -1, 1)])
    steps = -np.diff(np.cos(np.linspace(0, 0.5 * np.pi, len(values))))[:, None] * 2 * np.pi / shape[1]
    cumulative = np.cumsum(corners.max(axis=0) * steps)
    parts = [values.ravel(), _projected(values).ravel(), cumulative]
    return Table(np.concatenate(parts), 1, shape[0] - 1, shape[1])


def _nodes(rows: int, columns: int) -> np.ndarray:
    """(rows + 1, columns, 3) normals."""
    return _directions(np.linspace(0, 0.5 * np.pi, rows + 1), np.arange(columns) * 2 * np.pi / columns)


def _directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def _projected(values: np.ndarray) -> np.ndarray:
    """sigma at the nodes: two by two Gauss-Legendre points in each cell of the bilinear D."""
    rows, columns = values.shape[0] - 1, values.shape[1]
    at = np.array([0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3)])
    theta = (np.arange(rows)[:, None] + at).ravel() * 0.5 * np.pi / rows
    phi = (np.arange(columns)[:, None] + at).ravel() * 2 * np.pi / columns
    along = (
        np.repeat(values[:-1], 2, 0) * np.tile(1 - at, rows)[:, None]
        + np.repeat(values[1:], 2, 0) * np.tile(at, rows)[:, None]
    )
    D = np.repeat(along, 2, 1) * np.tile(1 - at, columns) + np.repeat(np.roll(along, -1, 1), 2, 1) * np.tile(
        at, columns
    )
    area = D * np.sin(theta)[:, None] * (0.5 * np.pi / rows) * (2 * np.pi / columns) / 4
    m, w = _directions(theta, phi).reshape(-1, 3).T, _nodes(rows, columns)
    return np.stack([np.abs(part @ m) @ area.ravel() for part in w])


def beckmann(axis: ArrayLike, roughness: float, resolution: int = RESOLUTION) -> Table:
    """Flakes that face ``axis``: Beckmann's exp(-tan^2/roughness^2) / (pi roughness^2 cos^4) on both sides; sigma(axis) = 1."""
    n, a2 = direction(axis, "axis"), _checked(roughness) ** 2

    def D(m: np.ndarray) -> np.ndarray:
        c2 = np.maximum((m @ n) ** 2, 1e-12)
        return np.exp(-(1 / c2 - 1) / a2) / (np.pi * a2 * c2 * c2)

    return tabulated(D, resolution)


def ggx(axis: ArrayLike, roughness: float, resolution: int = RESOLUTION) -> Table:
    """Flakes that face ``axis``: GGX's 1 / (pi roughness^2 (cos^2 + sin^2/roughness^2)^2), what ``sggx.surface`` is exactly."""
    n, a2 = direction(axis, "axis"), _checked(roughness) ** 2
    return tabulated(lambda m: 1 / (np.pi * a2 * ((m @ n) ** 2 + (1 - (m @ n) ** 2) / a2) ** 2), resolution)


def trigonometric(axis: ArrayLike, power: float, fibre: bool = False, resolution: int = RESOLUTION) -> Table:
    """|cos|^power about ``axis``, flakes that face it, or sin^power, those of a fibre along it; the largest sigma is 1."""
    n = direction(axis, "axis")
    if not 0 <= power <= 200:
        raise InputError(f"microflakes: power must be in [0, 200], got {power}")
    table = tabulated(lambda m: (1 - (m @ n) ** 2 if fibre else (m @ n) ** 2) ** (0.5 * power), resolution)
    return table._replace(values=table.values / table.sigma.max())


def _checked(roughness: float) -> float:
    if not 0.05 <= roughness <= 1:
        raise InputError(f"microflakes: roughness of a table must be in [0.05, 1], got {roughness}")
    return roughness


def together(tables: list[Table]) -> Table:
    """One table of all the rows, which must have one resolution."""
    if not tables:
        return EMPTY
    if len({t.D.shape[1:] for t in tables}) > 1:
        raise InputError("microflakes: expected tables of one resolution")
    parts = [part.ravel() for name in ("D", "sigma", "cumulative") for part in (getattr(t, name) for t in tables)]
    return tables[0]._replace(values=np.concatenate(parts), kinds=sum(t.kinds for t in tables))


@jit
def table_at(table, block, w):
    """Block k of the table, D of row k, or kinds + k, its sigma, at a direction: both are even."""
    rows, columns, values = table.rows, table.columns, table.values
    s = 1.0 if w[2] >= 0.0 else -1.0
    v = math.acos(min(s * w[2], 1.0)) * (2.0 / math.pi) * rows
    u = math.atan2(s * w[1], s * w[0]) * (0.5 / math.pi) * columns
    if u < 0.0:
        u += columns
    i, j = min(int(v), rows - 1), min(int(u), columns - 1)
    v, u = v - i, u - j
    at = (block * (rows + 1) + i) * columns
    a = at + (j + 1) % columns
    at += j
    return bilinear(values[at], values[at + columns], values[a], values[a + columns], u, v)


@jit
def sample_table(table, k, w, rng):
    """Cells in proportion to their bounds, a uniform point of the cell, kept with the chance D |w.m| / bound."""
    rows, columns, values = table.rows, table.columns, table.values
    cells = rows * columns
    first = 2 * table.kinds * (rows + 1) * columns + k * cells  # of the cumulative sums
    while True:
        u = uniform(rng) * values[first + cells - 1]
        low, high = 0, cells - 1
        while low < high:
            middle = (low + high) // 2
            if values[first + middle] > u:
                high = middle
            else:
                low = middle + 1
        i, j = low // columns, low % columns
        at = (k * (rows + 1) + i) * columns
        a = at + (j + 1) % columns
        bound = max(values[at + j], values[at + j + columns], values[a], values[a + columns])
        top, bottom = math.cos(0.5 * math.pi * i / rows), math.cos(0.5 * math.pi * (i + 1) / rows)
        z = bottom + (top - bottom) * uniform(rng)
        phi, r = 2.0 * math.pi * (j + uniform(rng)) / columns, math.sqrt(max(1.0 - z * z, 0.0))
        m = (r * math.cos(phi), r * math.sin(phi), z)
        seen = dot(m, w)
        if uniform(rng) * bound < table_at(table, k, m) * abs(seen):
            return m if seen > 0.0 else neg(m)
