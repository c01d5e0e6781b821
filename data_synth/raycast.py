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
from data_synth.cameras import pixel_ray
from data_synth.errors import InputError
from data_synth.gather import OPAQUE
from data_synth.jit import jit, kernel
from data_synth.lookups import box_interval, interpolated
from data_synth.media import Medium, Point
from data_synth.traverse import steps, traversal
from data_synth.vec import along, dot, scale

UNSHADED, LAMBERT, PHONG = range(3)
SHADING = {"none": UNSHADED, "lambert": LAMBERT, "phong": PHONG}
FINE, COARSE = 1024, 256  # nodes of the functions of v, and of the table along each side
AMBIENT, DIFFUSE, SPECULAR, EXPONENT = 0.25, 0.75, 0.3, 30.0
SHIFT = 1.0  # stored values are above 0, so that all bricks are there


class Classified(NamedTuple):
    """values: grid of v + SHIFT with the bounds of the opacity; points: opacity, r, g, b at v = 0 ... 1; sigma: 1/u."""

    values: Medium
    points: np.ndarray
    sigma: float


class Table(NamedTuple):
    """What the kernel reads. points: (FINE, 4), or (0, 4) for pre: (COARSE, COARSE, 4) over front and back; gradient: of v
    per u at which opacity is full, 0 for none; shading: one of the above."""

    points: np.ndarray
    pre: np.ndarray
    sigma: float
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
    pre = pre_integrated(c.points, c.sigma * c.values.step) if integrated else np.zeros((0, 0, 4))
    return Table(c.points, pre, c.sigma, gradient / min(c.values.cell), SHADING[shading])


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


@jit
def value(m, p):
    """v at a point, which may lie a little outside of the box."""
    q = (
        min(max(p[0], m.lo[0]), m.hi[0]),
        min(max(p[1], m.lo[1]), m.hi[1]),
        min(max(p[2], m.lo[2]), m.hi[2]),
    )
    return interpolated(m, m.samples, q) - 1.0


@jit
def gradient_at(m, p):
    """Of v, per u: central differences over a cell to each side."""
    hx, hy, hz = m.cell
    return (
        (value(m, (p[0] + hx, p[1], p[2])) - value(m, (p[0] - hx, p[1], p[2]))) / (2.0 * hx),
        (value(m, (p[0], p[1] + hy, p[2])) - value(m, (p[0], p[1] - hy, p[2]))) / (2.0 * hy),
        (value(m, (p[0], p[1], p[2] + hz)) - value(m, (p[0], p[1], p[2] - hz))) / (2.0 * hz),
    )


@jit
def at_value(points, v):
    """(opacity, r, g, b) of a value."""
    n = points.shape[0]
    x = min(max(v, 0.0), 1.0) * (n - 1)
    i = min(int(x), n - 2)
    f = x - i
    return (
        points[i, 0] + f * (points[i + 1, 0] - points[i, 0]),
        points[i, 1] + f * (points[i + 1, 1] - points[i, 1]),
        points[i, 2] + f * (points[i + 1, 2] - points[i, 2]),
        points[i, 3] + f * (points[i + 1, 3] - points[i, 3]),
    )


@jit
def between(pre, front, back):
    """(opacity, r, g, b) of a step from one value to another, bilinear in the table."""
    n = pre.shape[0]
    x, y = min(max(front, 0.0), 1.0) * (n - 1), min(max(back, 0.0), 1.0) * (n - 1)
    i, j = min(int(x), n - 2), min(int(y), n - 2)
    u, v = x - i, y - j
    a, b, c, d = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
    return (
        a * pre[i, j, 0] + b * pre[i, j + 1, 0] + c * pre[i + 1, j, 0] + d * pre[i + 1, j + 1, 0],
        a * pre[i, j, 1] + b * pre[i, j + 1, 1] + c * pre[i + 1, j, 1] + d * pre[i + 1, j + 1, 1],
        a * pre[i, j, 2] + b * pre[i, j + 1, 2] + c * pre[i + 1, j, 2] + d * pre[i + 1, j + 1, 2],
        a * pre[i, j, 3] + b * pre[i, j + 1, 3] + c * pre[i + 1, j, 3] + d * pre[i + 1, j + 1, 3],
    )


@jit
def shaded(colour, gradient, length, d, shading):
    """The colour of a surface across the gradient under a lamp at the eye; what has no gradient keeps its own."""
    if shading == UNSHADED or length <= 1e-9:
        return colour
    cosine = abs(dot(gradient, d)) / length
    light = AMBIENT + DIFFUSE * cosine
    gloss = SPECULAR * cosine**EXPONENT if shading == PHONG else 0.0
    return (light * colour[0] + gloss, light * colour[1] + gloss, light * colour[2] + gloss)


@jit
def step_event(m, ray, t, width, state, table):
    """One step: opacity and colour between its ends, or at its midpoint."""
    p, back = along(ray, t), state.v
    if table.pre.shape[0] > 0:
        start, end = t - 0.5 * width, t + 0.5 * width
        front = state.v if abs(state.t - start) < 1e-9 * (1.0 + start) else value(m, along(ray, start))
        back = value(m, along(ray, end))
        opacity, r, g, b = between(table.pre, front, back)
        state = Ray(state.L, state.T, state.far, end, back)
    else:
        opacity, r, g, b = at_value(table.points, value(m, p))
    if opacity <= 0.0:
        return state, False
    colour = (r, g, b)
    if table.gradient > 0.0 or table.shading != UNSHADED:
        gradient = gradient_at(m, p)
        length = math.sqrt(dot(gradient, gradient))
        if table.gradient > 0.0:
            opacity *= min(length / table.gradient, 1.0)
        colour = shaded(colour, gradient, length, ray[1], table.shading)
    weight = -state.T * math.expm1(-table.sigma * opacity * width)
    c = scale(weight, colour)
    T, L = state.T - weight, (state.L[0] + c[0], state.L[1] + c[1], state.L[2] + c[2])
    return Ray(L, T, state.far + weight * t, state.t, state.v), T < OPAQUE


cast = traversal(steps(step_event))


@kernel
def render_rows(m, table, camera, side, out, first, last):
    """Rows first..last - 1 of out (H, W, 5) = rgb, alpha, distance; side x side rays per pixel."""
    o = (camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3])
    share = 1.0 / (side * side)
    for j in range(first, last):
        for i in range(out.shape[1]):
            r, g, b, alpha, far = 0.0, 0.0, 0.0, 0.0, 0.0
            for s in range(side * side):
                ray = (o, pixel_ray(camera, i + (s % side + 0.5) / side, j + (s // side + 0.5) / side))
                t0, t1 = box_interval(ray, m.lo, m.hi)
                seen, _ = cast(m, ray, t0, t1, True, Ray((0.0, 0.0, 0.0), 1.0, 0.0, -1.0, 0.0), table)
                r, g, b, far = r + seen.L[0], g + seen.L[1], b + seen.L[2], far + seen.far
                alpha += 1.0 - seen.T
            out[j, i, 0], out[j, i, 1], out[j, i, 2] = r * share, g * share, b * share
            out[j, i, 3], out[j, i, 4] = alpha * share, far * share
