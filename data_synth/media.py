"""Participating media (PHYSICS 5): where the coefficients are. ``lookups.py`` reads them.

A medium has a dimensionless density rho(x) >= 0, constant RGB extinction per density sigma_t in 1/u, and RGB albedo and
emitted radiance Le that may depend on a second field, the *attribute* in [0, 1] (a temperature, a tissue, a thread), or
be grids of their own, as g and S of the phase function may (``fields.py``):
    sigma_t(x) = sigma_t rho(x),  sigma_s = albedo sigma_t,  sigma_a = sigma_t - sigma_s,  emission = sigma_a Le.
Microflakes multiply the extinction by their projected area towards the ray.

Density grids hold samples at the *vertices* of cubic cells, trilinear in between. They are stored sparsely in bricks of
8^3 cells with their 9^3 samples, so that a lookup reads one brick; a brick without density is not stored. Every brick
knows the largest and smallest of its samples: exact bounds of the trilinear density, local majorants for free.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from data_synth import detail as details
from data_synth import phase as phases
from data_synth.bricks import BRICK, SIDE, Sparse, bricks, cut_to
from data_synth.checks import vector
from data_synth.errors import InputError
from data_synth.fields import NOTHING, Columns, Given, is_grid, stored
from data_synth.functions import address_of

Point = Sequence[float] | np.ndarray
HOMOGENEOUS, GRID, EXPONENTIAL, FUNCTION = range(4)


class Medium(NamedTuple):
    """A medium inside the box lo..hi, as plain numbers for the kernels. Make it with the functions below.

    bricks: bricks per axis; brick_size: their edges in u; cell: edges of a cell in u; offsets: (bricks,) first sample
    of a brick or -1; samples, attributes: float32; brick_max, brick_min: (bricks,) bounds of the density; sigma_t: RGB
    per density; albedo, Le: (K, 3) tables over the attribute; base, falloff: of the exponential; step: length of a
    marching step in u; flake_area: largest projected area of the microflakes (1 without). fields, columns: the samples of
    ``fields.py``. function: address of a density function (``functions.py``); faults: (3,) what is wrong with it. detail: of a
    cloud, finer than the grid.
    """

    kind: int
    lo: tuple[float, float, float]
    hi: tuple[float, float, float]
    cells: tuple[int, int, int]
    bricks: tuple[int, int, int]
    cell: tuple[float, float, float]
    offsets: np.ndarray
    samples: np.ndarray
    attributes: np.ndarray
    brick_max: np.ndarray
    brick_min: np.ndarray
    max_density: float
    sigma_t: tuple[float, float, float]
    albedo: np.ndarray
    Le: np.ndarray
    base: float
    falloff: float
    step: float
    flake_area: float
    phase: phases.Phase
    fields: np.ndarray
    columns: Columns
    function: int
    faults: np.ndarray
    detail: details.Detail


def triple(values: Iterable[float]) -> tuple[float, float, float]:
    """Three numbers as kernels take them."""
    a, b, c = map(float, values)
    return a, b, c


def rgb(value: ArrayLike, name: str, upper: float = math.inf) -> tuple[float, float, float]:
    """A grey number or three numbers as an RGB tuple, finite and in [0, upper]."""
    try:
        a = np.broadcast_to(np.asarray(value, dtype=np.float64), (3,)) if np.ndim(value) < 2 else None
    except (TypeError, ValueError):
        a = None
    if a is None or not np.isfinite(a).all() or a.min() < 0 or a.max() > upper:
        limit = "finite and not negative" if upper == math.inf else f"in [0, {upper:g}]"
        raise InputError(f"{name}: expected one or three numbers {limit}, got {value}")
    return triple(a)


def _table(value: ArrayLike, name: str, upper: float = math.inf) -> np.ndarray:
    rows = value if isinstance(value, (list, tuple, np.ndarray)) and len(value) and np.ndim(value[0]) == 1 else [value]
    return np.array([rgb(row, name, upper) for row in rows])


def homogeneous(
    lo: Point, hi: Point, sigma_t: ArrayLike = 1.0, albedo: ArrayLike = 0.0, Le: ArrayLike = 0.0,
    phase: phases.Phase | None = None,
) -> Medium:  # fmt: skip
    """Density 1 inside the box lo..hi. sigma_t in 1/u."""
    one = np.ones(1)
    return _medium(HOMOGENEOUS, lo, hi, (1, 1, 1), (one, one), sigma_t, albedo, Le, phase)


def exponential(
    lo: Point, hi: Point, height: float, sigma_t: ArrayLike = 1.0, albedo: ArrayLike = 0.0, Le: ArrayLike = 0.0,
    phase: phases.Phase | None = None,
) -> Medium:  # fmt: skip
    """Density exp(-(z - lo_z) / height): fog and atmospheres, with a closed-form optical thickness. height in u."""
    if not (math.isfinite(height) and height > 0):
        raise InputError(f"exponential: height must be positive, got {height}")
    layers = 16
    edge = np.exp(-np.linspace(0, hi[2] - lo[2], layers + 1) / height)
    medium = _medium(EXPONENTIAL, lo, hi, (1, 1, layers), (edge[:-1], edge[1:]), sigma_t, albedo, Le, phase)
    return medium._replace(base=float(lo[2]), falloff=1.0 / height)


def grid(
    density: ArrayLike | Sparse, lo: Point, hi: Point, sigma_t: ArrayLike = 1.0, albedo: ArrayLike | Sparse = 0.0,
    Le: ArrayLike | Sparse = 0.0, phase: phases.Phase | None = None, attribute: ArrayLike | Sparse | None = None,
    majorant: float | None = None, g: ArrayLike | Sparse | None = None, S: ArrayLike | None = None,
    detail: details.Detail | None = None,
) -> Medium:  # fmt: skip
    """A heterogeneous medium of (nx, ny, nz) density samples at the vertices of a regular grid from lo to hi.

    attribute: same shape, in [0, 1]. albedo, Le: a colour, a table of colours over the attribute, or grids of the density's
    shape or with three channels. g: a grid of mean cosines, of the first lobe if ``phase`` has two. S: (nx, ny, nz, 6) SGGX
    matrices. majorant: an upper bound the caller believes in; lower is an error. detail: noise that erodes the density, in
    [0, 1] then, wherever it is asked for (``detail.py``); z is up.
    """
    density = density if isinstance(density, Sparse) else np.asarray(density)
    if len(density.shape) != 3 or min(density.shape) < 2:
        raise InputError(f"medium: density must be a 3D array of at least 2 samples a side, got shape {density.shape}")
    if not (math.isfinite(density.min()) and math.isfinite(density.max())) or density.min() < 0:
        raise InputError("medium: density must be finite and not negative, got a negative, infinite or NaN sample")
    if majorant is not None and majorant < density.max():
        raise InputError(f"medium: majorant {majorant:g} lies below the largest density {density.max():g}")
    found = attribute.shape if isinstance(attribute, Sparse) else np.shape(attribute) if attribute is not None else None
    if found is not None and found != density.shape:
        raise InputError(f"medium: attribute must have the density's shape {density.shape}, got {found}")
    b = bricks(density if isinstance(density, Sparse) else density.astype(np.float32, copy=False))
    given = Given(albedo if is_grid(albedo) else None, Le if is_grid(Le) else None, g, S)
    columns, fields, area = stored(given, density.shape, b.kept)
    phase = _varying(phase, g is not None, S is not None)
    table = 0.0 if given.albedo is not None else cast(ArrayLike, albedo)
    glow = 0.0 if given.Le is not None else cast(ArrayLike, Le)
    nx, ny, nz = density.shape
    cells = (nx - 1, ny - 1, nz - 1)
    medium = _medium(GRID, lo, hi, cells, (b.top, b.bottom), sigma_t, table, glow, phase)
    attributes = np.zeros(1, np.float32) if attribute is None else cut_to(attribute, b.kept).astype(np.float32).ravel()
    medium = medium._replace(
        offsets=b.offsets, samples=b.samples, attributes=attributes, fields=fields, columns=columns,
        flake_area=area if S is not None else medium.flake_area,
    )  # fmt: skip
    return medium if detail is None else _detailed(medium, detail)


def _detailed(m: Medium, d: details.Detail) -> Medium:
    """The medium eroded by detail, marched in steps of two samples of the finest noise, at the least a cell's eighth."""
    if m.max_density > 1:
        raise InputError(f"medium: a density with detail must be in [0, 1], got {m.max_density:g}")
    sizes = [2 * (b - a) / n for a, b, n in zip(m.lo, m.hi, details.finest(d), strict=True)]
    top = details.most(d, m.brick_max)
    return m._replace(
        detail=d, brick_max=top, max_density=float(top.max()), brick_min=details.least(d, m.brick_min),
        step=min(m.step, max(min(sizes), m.step / 8)),
    )  # fmt: skip


def _varying(phase: phases.Phase | None, g: bool, S: bool) -> phases.Phase | None:
    """The phase function that a grid of g or S belongs to."""
    if g and S:
        raise InputError("medium: expected a grid of g or of S, got both")
    if S:
        phase = phase or phases.microflakes(np.eye(3))
        if phase.kind < phases.SGGX_SPECULAR or phase.table.kinds:
            raise InputError("medium: a grid of S belongs to SGGX microflakes, got another phase function")
    if g:
        phase = phase or phases.henyey_greenstein(0.0)
        if phase.kind != phases.HG:
            raise InputError("medium: a grid of g belongs to a Henyey-Greenstein phase function, got another")
    return phase


def procedural(
    function: Callable[[float, float, float], float], lo: Point, hi: Point, majorant: ArrayLike, sigma_t: ArrayLike = 1.0,
    albedo: ArrayLike = 0.0, Le: ArrayLike = 0.0, phase: phases.Phase | None = None, step: float | None = None,
) -> Medium:  # fmt: skip
    """Density function(x, y, z), in world units, evaluated where it is needed (``functions.py``).

    majorant: an upper bound of the density in the box, or of each of (bx, by, bz) equal boxes that make it up: the better they
    bound it, the fewer look-ups tracking takes, and none where it is 0. step: of marching, u; by default a 128th of the box.
    """
    top = np.asarray(majorant, float)
    top = top.reshape(1, 1, 1) if top.ndim == 0 else top
    if top.ndim != 3 or not top.size or not np.isfinite(top).all() or top.min() < 0:
        raise InputError(
            f"procedural: expected a majorant, or one for each of a grid of boxes, from 0 on, got {majorant}"
        )
    if step is not None and not 0 < step < math.inf:
        raise InputError(f"procedural: expected a positive step, got {step}")
    a, b, c = top.shape
    bounds = (top.ravel(), np.zeros(top.size))
    medium = _medium(FUNCTION, lo, hi, (a, b, c), bounds, sigma_t, albedo, Le, phase)
    return medium._replace(function=address_of(function), step=medium.step if step is None else step)


def from_function(function: Callable, lo: Point, hi: Point, resolution: int = 128, **coefficients: Any) -> Medium:
    """A grid sampled from ``function(x, y, z)`` of broadcast arrays, ``resolution`` samples along the longest side."""
    lo, hi = np.asarray(lo, float), np.asarray(hi, float)
    spacing = (hi - lo).max() / (resolution - 1)
    shape = np.maximum(np.rint((hi - lo) / spacing).astype(int) + 1, 2)
    axes = [np.linspace(lo[k], hi[k], shape[k]) for k in range(3)]
    density = np.broadcast_to(function(*np.meshgrid(*axes, indexing="ij", sparse=True)), shape)
    return grid(density, lo, hi, **coefficients)


def _medium(
    kind: int, lo: Point, hi: Point, cells: tuple[int, int, int], bounds: Sequence[np.ndarray],
    sigma_t: ArrayLike, albedo: ArrayLike, Le: ArrayLike, phase: phases.Phase | None,
) -> Medium:  # fmt: skip
    lo, hi = triple(vector(lo, "lo")), triple(vector(hi, "hi"))
    if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(lo, hi, strict=True)):
        raise InputError(f"medium: expected a box with lo < hi, got {lo} and {hi}")
    phase = phase or phases.isotropic()
    area = phases.largest_area(phase)
    cell = triple((b - a) / n for a, b, n in zip(lo, hi, cells, strict=True))
    nx, ny, nz = (-(-n // BRICK) for n in cells) if kind == GRID else cells
    step = min(cell) if kind == GRID else max(b - a for a, b in zip(lo, hi, strict=True)) / 128
    return Medium(
        kind, lo, hi, cells, (nx, ny, nz), cell,
        np.zeros(1, np.int64), np.zeros(1, np.float32), np.zeros(1, np.float32),
        np.ascontiguousarray(bounds[0], dtype=float), np.ascontiguousarray(bounds[1], dtype=float),
        float(np.max(bounds[0], initial=0.0)), rgb(sigma_t, "sigma_t"), _table(albedo, "albedo", 1.0),
        _table(Le, "Le"), 0.0, 0.0, step, area, phase, np.zeros(1, np.float32), NOTHING, 0, np.zeros(3), details.NONE,
    )  # fmt: skip


def glows(m: Medium) -> bool:
    """Whether it emits anything."""
    return bool(np.any(m.Le)) or m.columns.Le >= 0


def dense(m: Medium) -> np.ndarray:
    """The (nx, ny, nz) float32 density samples of a grid medium, without its detail."""
    return dense_of(m, m.samples)[..., 0]


def dense_of(m: Medium, samples: np.ndarray, first: int = 0, columns: int = 1) -> np.ndarray:
    """(nx, ny, nz, columns) float32 of brick samples of a grid medium, from column ``first`` on; 0 where no brick is."""
    width = len(samples) // max(len(m.samples), 1)
    stored = samples.reshape(len(m.samples), max(width, columns))[:, first : first + columns]
    out = np.zeros((*(n * BRICK + 1 for n in m.bricks), columns), np.float32)
    side = (SIDE,) * 3
    windows = np.lib.stride_tricks.sliding_window_view(out, side, axis=(0, 1, 2), writeable=True)  # type: ignore[call-overload]
    windows = np.moveaxis(windows[::BRICK, ::BRICK, ::BRICK], 3, -1)
    windows[m.offsets.reshape(m.bricks) >= 0] = stored.reshape(
        -1, *side, columns
    )  # neighbours agree where they overlap
    return out[: m.cells[0] + 1, : m.cells[1] + 1, : m.cells[2] + 1]
