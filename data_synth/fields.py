"""What varies in a grid medium besides its density: albedo, Le, g and S, each a grid of its own (PHYSICS 5).

All of them are stored sample by sample in the medium's bricks, as the columns of one array, and are trilinear in between:
    albedo, Le   one number, or RGB
    g            mean cosine of the (first) Henyey-Greenstein lobe; between samples it stays in (-1, 1)
    S            six numbers of an SGGX matrix: a mixture of positive definite matrices is one, so that S(x) is; and the
                 squared projected area w' S(x) w is then trilinear as well, at most that of the largest sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth.bricks import SIDE, Sparse, cut_to
from data_synth.errors import InputError
from data_synth.jit import inlined, jit
from data_synth.sggx import matrices
from data_synth.vec import trilinear

ROUNDING = 2.0**-23
"""Of single precision."""


class Columns(NamedTuple):
    """The first columns of albedo, Le, g and S among the ``width`` of ``Medium.fields``, -1 for what is no grid. A colour's
    channels lie a step apart: 1, or 0 where one column serves all three."""

    albedo: int = -1
    albedo_step: int = 0
    Le: int = -1
    Le_step: int = 0
    g: int = -1
    S: int = -1
    width: int = 0


NOTHING = Columns()


def is_grid(value: ArrayLike | Sparse | None) -> bool:
    """Whether a coefficient is given sample by sample, not as a colour or a table of colours."""
    return isinstance(value, Sparse) or (value is not None and not np.isscalar(value) and np.ndim(value) > 2)


class Given(NamedTuple):
    """The grids of one medium: dense arrays or ``Sparse``, None for what is none."""

    albedo: ArrayLike | Sparse | None
    Le: ArrayLike | Sparse | None
    g: ArrayLike | Sparse | None
    S: ArrayLike | None


def stored(given: Given, shape: tuple[int, ...], kept: np.ndarray) -> tuple[Columns, np.ndarray, float]:
    """(columns, samples of the stored bricks, largest projected area of flakes, 1 without) of a grid of ``shape`` samples.

    Raises:
        InputError: a grid of another shape, or with samples that are no such coefficient.
    """
    at, width, parts = {}, 0, []
    for name, value in given._asdict().items():
        if value is None:
            continue
        sizes = {"g": ((),), "S": ((6,),)}.get(name, ((), (3,)))
        found = value.shape if isinstance(value, Sparse) else np.shape(value)
        if found not in [(*shape, *size) for size in sizes]:
            wanted = " or ".join(str((*shape, *size)) for size in sizes)
            raise InputError(f"medium: {name} must have the density's samples, shape {wanted}, got {found}")
        values = cut_to(value, kept).reshape(len(kept), -1, int(np.prod(found[3:], dtype=int)))
        at[name] = width
        if name in ("albedo", "Le"):
            at[f"{name}_step"] = 1 if values.shape[2] == 3 else 0
        width += values.shape[2]
        parts.append(_checked(name, values))
    if not parts:
        return NOTHING, np.zeros(1, np.float32), 1.0
    area = float(np.sqrt(max(_largest_area(part) for part in parts))) if given.S is not None else 1.0
    return Columns(**at, width=width), np.ascontiguousarray(np.concatenate(parts, axis=2)).ravel(), area


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    """float32 of the same shape; S so that rounding leaves it positive definite."""
    if name == "S":
        s = values.astype(float)
        if not np.isfinite(s).all() or (s.size and np.linalg.eigvalsh(matrices(s))[..., 0].min() <= 0):
            raise InputError("medium: S must be positive definite at every sample: six numbers xx, yy, zz, xy, xz, yz")
        s[..., :3] += ROUNDING * s[..., :3].sum(axis=-1, keepdims=True)  # rounding takes away half of that at most
        return s.astype(np.float32)
    values = values.astype(np.float32)
    low, high, span = {"albedo": (0.0, 1.0, "in [0, 1]"), "g": (-1.0, 1.0, "in (-1, 1)")}.get(
        name, (0.0, np.inf, "finite and not negative")
    )
    inside = values.size == 0 or (values.min() >= low and values.max() <= high and np.isfinite(values).all())
    if not inside or (name == "g" and values.size and np.abs(values).max() >= 1):
        raise InputError(f"medium: {name} must be {span} at every sample")
    return values


def _largest_area(part: np.ndarray) -> float:
    return (
        float(np.linalg.eigvalsh(matrices(part.astype(float)))[..., -1].max(initial=0.0)) if part.shape[2] == 6 else 0.0
    )


@inlined
def cell_of(m, p):
    """(first, u, v, w): the stored sample at the lower corner of the cell around p, negative where no brick is, and where p is
    in it. p: in cells from the lowest corner of the box."""
    n = m.cells
    i = min(max(int(p[0]), 0), n[0] - 1)
    j = min(max(int(p[1]), 0), n[1] - 1)
    k = min(max(int(p[2]), 0), n[2] - 1)
    # unsigned, because an index that may be negative is checked each time
    first = m.offsets[np.uintp(((i >> 3) * m.bricks[1] + (j >> 3)) * m.bricks[2] + (k >> 3))]
    first += ((i & 7) * SIDE + (j & 7)) * SIDE + (k & 7) if first >= 0 else 0
    return first, p[0] - i, p[1] - j, p[2] - k


@inlined
def cell_at(m, p):
    """``cell_of`` a point of the scene."""
    return cell_of(m, ((p[0] - m.lo[0]) / m.cell[0], (p[1] - m.lo[1]) / m.cell[1], (p[2] - m.lo[2]) / m.cell[2]))


@inlined
def mixed(values, width, column, where):
    """Column ``column`` of ``width`` at a place in a cell (``cell_at``), 0 where no brick is."""
    first, u, v, w = where
    if first < 0:
        return 0.0
    a, z, y = np.uintp(first * width + column), np.uintp(width), np.uintp(SIDE * width)
    b = a + np.uintp(SIDE * SIDE * width)
    near = (values[a], values[a + z], values[a + y], values[a + y + z])
    far = (values[b], values[b + z], values[b + y], values[b + y + z])
    return trilinear(near + far, u, v, w)  # noqa: RUF005


@jit
def colour(m, column, step, where):
    """RGB of a colour's grid."""
    x, n = m.fields, m.columns.width
    r = mixed(x, n, column, where)
    return (r, r, r) if step == 0 else (r, mixed(x, n, column + 1, where), mixed(x, n, column + 2, where))


@jit
def matrix(m, where):
    """The six numbers of S."""
    x, n, c = m.fields, m.columns.width, m.columns.S
    return (
        mixed(x, n, c, where), mixed(x, n, c + 1, where), mixed(x, n, c + 2, where),
        mixed(x, n, c + 3, where), mixed(x, n, c + 4, where), mixed(x, n, c + 5, where),
    )  # fmt: skip


@jit
def at_sample(m, column, step, s):
    """RGB of a colour's grid at stored sample number s."""
    a = s * m.columns.width + column
    return (m.fields[a], m.fields[a + step], m.fields[a + 2 * step])
