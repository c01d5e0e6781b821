"""A scan as a viewer of scans shows it: emission and absorption through a transfer function, classified after interpolation.

Along a ray the value v(t) is trilinear; opacity o(v), times sigma in 1/u, and colour c(v) are looked up in it:
    L = integral of T(t) sigma o(v(t)) c(v(t)) dt,   T(t) = exp(-integral of sigma o(v)).
post: o and c at the midpoint of each step, which misses what is thinner than a step in v.
pre-integrated [Engel, Kraus & Ertl 2001]: v is taken as linear between both ends of a step; a table over the values at its
front and back holds the mean opacity, exactly, and the colour with the step's own absorption, for a step of the nominal
length. A step of another length, at the end of a brick, keeps the colour and scales the optical thickness.

As options opacity in proportion to the gradient [Levoy 1988], so that surfaces show and what is uniform does not; and local
shading by it, Lambert or Phong with a lamp at the eye. Both are for the eye: no light is transported.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth import media
from data_synth.cameras import picture_rows
from data_synth.errors import InputError
from data_synth.fields import cell_of, mixed
from data_synth.gather import in_cells
from data_synth.jit import inlined, jit, kernel
from data_synth.lookups import at_value, box_interval
from data_synth.media import Medium, Point
from data_synth.traverse import lattice, traversal
from data_synth.vec import along, bilinear, dot, scale

UNSHADED, LAMBERT, PHONG = range(3)
SHADING = {"none": UNSHADED, "lambert": LAMBERT, "phong": PHONG}
FINE, COARSE = 1024, 256  # nodes of the functions of v, and of the table along each side
AMBIENT, DIFFUSE, SPECULAR, EXPONENT = 0.25, 0.75, 0.3, 30.0
SHIFT = 1.0  # stored values are above 0, so that all bricks are there
OPAQUE = 1.0 / 512.0  # a ray whose transmittance falls below this stops: half of what 8 bits can tell


class Classified(NamedTuple):
    """values: grid of v + SHIFT with the bounds of the opacity; points: opacity, r, g, b at v = 0 ... 1; sigma: 1/u."""

    values: Medium
    points: np.ndarray
    sigma: float


class Table(NamedTuple):
    """What the kernel reads. points: (FINE, 5), or pre: (COARSE, COARSE, 5) over front and back, the other one empty: optical
    thickness and opacity of a step, r, g, b; gradient: of v per u at which opacity is full, 0 for none; shading: one of the
    above."""

    points: np.ndarray
    pre: np.ndarray
    gradient: float
    shading: int


class Ray(NamedTuple):
    """Radiance, transmittance, sum of weight times distance; v at t, where the last step ended."""

    L: tuple[float, float, float]
    T: float
    far: float
    t: float
    v: float


def classified(values: np.ndarray, lo: Point, hi: Point, points: np.ndarray, sigma: float) -> Classified:
    """values: (nx, ny, nz) in [0, 1]; points: (n, 5) of ``transfer.py`` with values in [0, 1]; sigma: 1/u at opacity 1."""
    v = np.linspace(0, 1, FINE)
    table = np.stack([np.interp(v, points[:, 0], points[:, c]) for c in range(1, 5)], axis=1)
    m = media.grid(np.asarray(values, np.float32) + np.float32(SHIFT), lo, hi)
    first = np.clip(np.floor((m.brick_min - SHIFT) * (FINE - 1)), 0, FINE - 1).astype(int)
    last = np.clip(np.ceil((m.brick_max - SHIFT) * (FINE - 1)), 0, FINE - 1).astype(int)
    top = np.array([table[a : b + 1, 0].max() for a, b in zip(first, last, strict=True)])
    return Classified(m._replace(brick_max=top, max_density=float(top.max())), table, float(sigma))


def check(gradient: float, shading: str) -> None:
    """InputError for what :func:`table_of` does not know."""
    if shading not in SHADING:
        raise InputError(f"--shading: expected one of {', '.join(SHADING)}, got '{shading}'")
    if not 0 <= gradient < math.inf:
        raise InputError(f"--gradient: expected a number from 0 on, got {gradient}")


def table_of(c: Classified, integrated: bool, gradient: float, shading: str) -> Table:
    """gradient: change of v from one voxel to the next at which opacity is full."""
    thickness = c.sigma * c.values.step
    own = pre_integrated(c.points, thickness) if integrated else c.points
    tau = thickness * own[..., :1]
    table = np.concatenate([tau, -np.expm1(-tau), own[..., 1:]], axis=-1)
    points, pre = (
        (np.zeros((0, 5)), table.astype(np.float32)) if integrated else (table, np.zeros((0, 0, 5), np.float32))
    )
    return Table(points, pre, gradient / min(c.values.cell), SHADING[shading])


def pre_integrated(points: np.ndarray, thickness: float, inside: int = 64) -> np.ndarray:
    """(COARSE, COARSE, 4) mean opacity and colour of a step whose value goes from front (first) to back.

    thickness: of a step of opacity 1; inside: parts of the step in which its own absorption is followed.
    """
    v = np.linspace(0, 1, len(points))
    ends = np.linspace(0, 1, COARSE)
    step = np.diff(v)[0]
    whole = np.concatenate([[0], np.cumsum(0.5 * step * (points[1:, 0] + points[:-1, 0]))])
    i = np.minimum((ends / step).astype(int), len(v) - 2)
    rest = ends - v[i]  # the integral of a piecewise linear function, exactly
    slope = (points[i + 1, 0] - points[i, 0]) / step
    area = whole[i] + rest * (points[i, 0] + 0.5 * slope * rest)
    gap = ends[None, :] - ends[:, None]
    same = np.eye(COARSE, dtype=bool)
    own = np.interp(ends, v, points[:, 0])
    opacity = np.where(same, own[:, None], (area[None, :] - area[:, None]) / np.where(same, 1.0, gap))
    T, colour, total = np.ones((COARSE, COARSE)), np.zeros((COARSE, COARSE, 3)), np.zeros((COARSE, COARSE))
    plain = np.zeros((COARSE, COARSE, 3))
    for k in range(inside):
        at = ends[:, None] + (k + 0.5) / inside * gap
        here = [np.interp(at, v, points[:, c]) for c in range(4)]
        weight = -T * np.expm1(-here[0] * thickness / inside)
        T -= weight
        total += weight
        colour += weight[..., None] * np.stack(here[1:], -1)
        plain += np.stack(here[1:], -1) / inside
    seen = total[..., None] > 1e-12
    colour = np.where(seen, colour / np.where(seen, total[..., None], 1.0), plain)
    return np.concatenate([np.maximum(opacity, 0.0)[..., None], colour], axis=-1)


@inlined
def value(m, p):
    """v at a point that is given in cells from the lowest corner; outside of the box as at its nearest point."""
    n = m.cells
    inside = (min(max(p[0], 0.0), n[0]), min(max(p[1], 0.0), n[1]), min(max(p[2], 0.0), n[2]))
    return mixed(m.samples, 1, 0, cell_of(m, inside)) - SHIFT


@jit
def gradient_at(m, p):
    """Of v, per u, at a point in cells: central differences over a cell to each side."""
    x, y, z = p
    return (
        (value(m, (x + 1.0, y, z)) - value(m, (x - 1.0, y, z))) / (2.0 * m.cell[0]),
        (value(m, (x, y + 1.0, z)) - value(m, (x, y - 1.0, z))) / (2.0 * m.cell[1]),
        (value(m, (x, y, z + 1.0)) - value(m, (x, y, z - 1.0))) / (2.0 * m.cell[2]),
    )


@inlined
def between(pre, front, back, c):
    """Column c of a step from one value to another, bilinear in the table."""
    n = pre.shape[0]
    x, y = min(max(front, 0.0), 1.0) * (n - 1), min(max(back, 0.0), 1.0) * (n - 1)
    i, j = min(int(x), n - 2), min(int(y), n - 2)
    return bilinear(pre[i, j, c], pre[i, j + 1, c], pre[i + 1, j, c], pre[i + 1, j + 1, c], x - i, y - j)


@inlined
def of_step(table, front, back, c):
    """Column c of the table for a step; front and back are the value at its midpoint where nothing is integrated."""
    return between(table.pre, front, back, c) if table.pre.shape[0] > 0 else at_value(table.points, front, c)


@jit
def shaded(colour, gradient, length, d, shading):
    """The colour of a surface across the gradient under a lamp at the eye; what has no gradient keeps its own."""
    if shading == UNSHADED or length <= 1e-9:
        return colour
    cosine = abs(dot(gradient, d)) / length
    light = AMBIENT + DIFFUSE * cosine
    gloss = SPECULAR * cosine**EXPONENT if shading == PHONG else 0.0
    return (light * colour[0] + gloss, light * colour[1] + gloss, light * colour[2] + gloss)


@inlined
def step_event(m, ray, t, width, state, context):
    """One step, or what of it is in the box: opacity and colour between its ends, or at its midpoint."""
    table, cells, t0, t1 = context
    start, end = max(t - 0.5 * width, t0), min(t + 0.5 * width, t1)
    if end <= start:
        return state, False
    if table.pre.shape[0] > 0:
        front = state.v if abs(state.t - start) < 1e-9 * (1.0 + start) else value(m, along(cells, start))
        back = value(m, along(cells, end))
        state = Ray(state.L, state.T, state.far, end, back)
    else:
        front = back = value(m, along(cells, 0.5 * (start + end)))
    opacity = of_step(table, front, back, 1)
    if opacity <= 0.0:
        return state, False
    colour = (of_step(table, front, back, 2), of_step(table, front, back, 3), of_step(table, front, back, 4))
    part = (end - start) / width
    if table.gradient > 0.0 or table.shading != UNSHADED:
        gradient = gradient_at(m, along(cells, 0.5 * (start + end)))
        length = math.sqrt(dot(gradient, gradient))
        if table.gradient > 0.0:
            part *= min(length / table.gradient, 1.0)
        colour = shaded(colour, gradient, length, ray[1], table.shading)
    if part < 1.0 - 1e-9:
        opacity = -math.expm1(-part * of_step(table, front, back, 0))
    weight = state.T * opacity
    c, T = scale(weight, colour), state.T - weight
    L = (state.L[0] + c[0], state.L[1] + c[1], state.L[2] + c[2])
    return Ray(L, T, state.far + weight * 0.5 * (start + end), state.t, state.v), T < OPAQUE


_cast = traversal(lattice(step_event))


@jit
def cast(ray, context):
    """(L, alpha, distance) of a ray. context: the medium of the values, and the table."""
    m, table = context
    t0, t1 = box_interval(ray, m.lo, m.hi)
    nothing = Ray((0.0, 0.0, 0.0), 1.0, 0.0, -1.0, 0.0)
    seen, _ = _cast(m, ray, t0, t1, True, nothing, (table, in_cells(m, ray), t0, t1))
    return seen.L, 1.0 - seen.T, seen.far


_rows = picture_rows(cast)


@kernel
def render_rows(m, table, camera, side, out, first, last):
    """Rows first..last - 1 of out (H, W, 5) = rgb, alpha, distance; side x side rays per pixel."""
    _rows((m, table), camera, side, out, first, last)
