"""Where a ray crosses level sets: surfaces that signed distances on a grid state (Osher & Sethian 1988; OpenVDB's "level set").

The surface is where the trilinear function through the samples is 0; below 0 is inside. Along a ray that function is a cubic
polynomial in every cell (Parker et al. 1998), so that a hit is the first root of a cubic, isolated between its extrema (Marmitt
et al. 2004) and found to rounding (between two cells, to 1e-9 of one); nothing is stepped over, however thin. The normal is the
gradient of the same function: exact for the surface that is drawn, and it jumps a little from cell to cell.

Against a smooth distance function of curvature radii >= R, sampled at a spacing h: interpolation lies above it (where it is
convex) by at most h^2/8 times the sum of its second derivatives along the axes, 2/(R - d) for a sphere at depth d: the surface
lies within h^2 / (4 (R - 2h)) of the true one; a component of the gradient is off by at most h / (2 (R - 2h)) to first order.

Samples lie in the bricks of ``media.py``, but those alone that the surface crosses; the others say whether they are inside.

Renderers call this code through its address, as they call densities that are functions (``functions.py``): it is compiled by
itself, the first time that a scene has a level set, and is no part of what others compile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.ccallback import CFunc
from numba.extending import intrinsic, overload
from numba.np.numpy_support import carray

from data_synth import jit as compiling
from data_synth.bricks import SIDE
from data_synth.fields import cell_at, mixed
from data_synth.jit import jit
from data_synth.media import GRID
from data_synth.traverse import cells, traversal
from data_synth.vec import RELATIVE, along, bilinear, dot, extent, scale, slab, trilinear, unit

OUTSIDE, INSIDE = -1, -2  # what the offset of a brick says that the surface does not cross


class LevelSet(NamedTuple):
    """One solid. lo: the lowest vertex; cell: edges of a cell in u; bricks: their numbers along the axes; offsets: (bricks,)
    place of a brick's first sample, ``OUTSIDE`` or ``INSIDE``; samples: float32, of the bricks that the surface crosses, after
    one number that is none."""

    material: int
    lo: tuple[float, float, float]
    cell: tuple[float, float, float]
    bricks: tuple[int, int, int]
    offsets: np.ndarray
    samples: np.ndarray


class Levels(NamedTuple):
    """All solids of a scene, arrays one behind the other. code: address of ``_answer``, 0 where there is no solid; numbers:
    (n, 10) material, lo, cell, bricks; first: (n + 1, 2)."""

    code: int
    numbers: np.ndarray
    first: np.ndarray
    offsets: np.ndarray
    samples: np.ndarray


class Solid(NamedTuple):
    """One of them, as ``traverse.py`` and ``fields.py`` see a medium. brick_max: the offsets, positive where to look."""

    kind: int
    lo: tuple[float, float, float]
    hi: tuple[float, float, float]
    cells: tuple[int, int, int]
    bricks: tuple[int, int, int]
    cell: tuple[float, float, float]
    offsets: np.ndarray
    samples: np.ndarray
    brick_max: np.ndarray


def collected(level_sets: Sequence[LevelSet]) -> Levels:
    """What kernels take, of a type that does not depend on how many there are."""
    numbers, first = np.zeros((len(level_sets), 10)), np.zeros((len(level_sets) + 1, 2), np.int64)
    for k, s in enumerate(level_sets):
        numbers[k] = [s.material, *s.lo, *s.cell, *s.bricks]
        first[k + 1] = first[k] + [len(s.offsets), len(s.samples)]
    offsets = np.concatenate([np.zeros(0, np.int64), *(s.offsets for s in level_sets)])
    samples = np.concatenate([np.zeros(0, np.float32), *(s.samples for s in level_sets)])
    return Levels(_address() if level_sets else 0, numbers, first, offsets, samples)


@jit
def solid_at(levels, k):
    """Solid k."""
    n, a, b = levels.numbers[k], levels.first[k], levels.first[k + 1]
    lo, cell = (n[1], n[2], n[3]), (n[4], n[5], n[6])
    bricks = (int(n[7]), int(n[8]), int(n[9]))
    cells = (8 * bricks[0], 8 * bricks[1], 8 * bricks[2])
    hi = (lo[0] + cells[0] * cell[0], lo[1] + cells[1] * cell[1], lo[2] + cells[2] * cell[2])
    offsets = levels.offsets[a[0] : b[0]]
    return Solid(GRID, lo, hi, cells, bricks, cell, offsets, levels.samples[a[1] : b[1]], offsets)


@jit
def corners_at(m, first):
    """The eight samples of a cell, the last axis fastest."""
    a = np.uintp(first)
    y, b = a + np.uintp(SIDE), a + np.uintp(SIDE * SIDE)
    z, x = np.uintp(1), b + np.uintp(SIDE)
    s = m.samples
    low = (np.float64(s[a]), np.float64(s[a + z]), np.float64(s[y]), np.float64(s[y + z]))
    high = (np.float64(s[b]), np.float64(s[b + z]), np.float64(s[x]), np.float64(s[x + z]))
    return low + high  # noqa: RUF005


@jit
def gradient(c, u, v, w):
    """Of the trilinear function of eight corners, along u, v and w."""
    x = bilinear(c[4] - c[0], c[5] - c[1], c[6] - c[2], c[7] - c[3], v, w)
    y = bilinear(c[2] - c[0], c[3] - c[1], c[6] - c[4], c[7] - c[5], u, w)
    z = bilinear(c[1] - c[0], c[3] - c[2], c[5] - c[4], c[7] - c[6], u, v)
    return (x, y, z)


@jit
def first_root(p, inside):
    """The first x in [-1, 1] at which a cubic changes sign (below 0 is inside), and whether it is inside then; x = 2: nowhere.

    p: its coefficients, of 1 first. inside: 1 or 0, before -1; -1: as it is there. Between extrema it is monotone: bisected, by
    Newton's steps where they stay in the bracket.
    """
    at = p[0] - p[1] + p[2] - p[3] < 0.0
    if inside >= 0.0 and (inside > 0.0) != at:
        return -1.0, at
    r1, r2 = 2.0, 2.0
    disc = p[2] * p[2] - 3.0 * p[1] * p[3]
    if disc > 0.0:
        q = -(p[2] + math.copysign(math.sqrt(disc), p[2]))
        r1, r2 = q / (3.0 * p[3]) if p[3] != 0.0 else 2.0, p[1] / q
    low, high, found = -1.0, -1.0, False
    for k in range(3):
        high = min(r1, r2) if k == 0 else max(r1, r2) if k == 1 else 1.0
        if low < high <= 1.0:
            found = (p[0] + high * (p[1] + high * (p[2] + high * p[3])) < 0.0) != at
            if found:
                break
            low = high
    if not found:
        return 2.0, at
    x = 0.5 * (low + high)
    for _ in range(64):
        f, slope = p[0] + x * (p[1] + x * (p[2] + x * p[3])), p[1] + x * (2.0 * p[2] + x * 3.0 * p[3])
        if (f < 0.0) == at:
            low = x
        else:
            high = x
        step = x - f / slope if slope != 0.0 else low
        if abs(step - x) < 1e-16:
            break
        if not low < step < high:
            step = 0.5 * (low + high)
            if step == low or step == high:
                break
        x = step
    return x, not at


@jit
def surface_event(m, ray, t, width, state, context):
    """A cell's chord. state: whether the ray is inside (1 or 0, -1 if not known), and t and n of the hit."""
    where = cell_at(m, along(ray, t))
    if where[0] < 0:
        return state, False
    c, d, half = corners_at(m, where[0]), ray[1], 0.5 * width
    least, most = min(c[0], c[1], c[2], c[3]), max(c[0], c[1], c[2], c[3])
    least, most = min(least, c[4], c[5], c[6], c[7]), max(most, c[4], c[5], c[6], c[7])
    inside, u, v, w = state[0], where[1], where[2], where[3]
    if (least >= 0.0 and inside == 0.0) or (most < 0.0 and inside == 1.0):
        return state, False
    du, dv, dw = half * d[0] / m.cell[0], half * d[1] / m.cell[1], half * d[2] / m.cell[2]
    a, b = trilinear(c, u - du, v - dv, w - dw), trilinear(c, u + du, v + dv, w + dw)
    middle, slope = trilinear(c, u, v, w), dot(gradient(c, u, v, w), (du, dv, dw))
    x, after = first_root((middle, slope, 0.5 * (a + b) - middle, 0.5 * (b - a) - slope), inside)
    if x > 1.0:
        return (1.0 if after else 0.0, state[1], state[2], state[3], state[4]), False
    g = gradient(c, u + x * du, v + x * dv, w + x * dw)
    n = (g[0] / m.cell[0], g[1] / m.cell[1], g[2] / m.cell[2])
    facing = -1.0 if after else 1.0  # sign of n . d
    if dot(n, d) * facing <= 0.0:  # by rounding, where the surface is only touched or has no gradient
        n = scale(facing, d)
    n = unit(n)
    return (1.0 if after else 0.0, t + x * half, n[0], n[1], n[2]), True


find_surface = traversal(cells(surface_event))


@jit
def hit_level_set(levels, k, ray, t_max):
    """(t, n) of the nearest crossing of solid k in (0, t_max), t_max if there is none."""
    m = solid_at(levels, k)
    near = RELATIVE * (extent(ray[0]) + max(extent(m.lo), extent(m.hi)))
    t0, t1 = slab(ray, m.lo, m.hi, near, t_max)
    state, found = find_surface(m, ray, t0, t1, True, (-1.0, t_max, 0.0, 0.0, 1.0), 0)
    return (state[1] if found else t_max), (state[2], state[3], state[4])


@jit
def within(levels, k, p):
    """Whether solid k holds a point."""
    m = solid_at(levels, k)
    if not (m.lo[0] < p[0] < m.hi[0] and m.lo[1] < p[1] < m.hi[1] and m.lo[2] < p[2] < m.hi[2]):
        return False
    where = cell_at(m, p)
    return where[0] == INSIDE if where[0] < 0 else mixed(m.samples, 1, 0, where) < 0.0


HIT, WITHIN = range(2)
POINTERS = tuple(types.CPointer(t) for t in (types.float64, types.int64, types.int64, types.float32))
SIGNATURE = types.void(*[types.int64] * 3, *POINTERS, *[types.float64] * 7, types.CPointer(types.float64))


def _answer(mode, k, n, numbers, first, offsets, samples, ox, oy, oz, dx, dy, dz, t_max, out):
    """``hit_level_set`` or ``within`` of solid k of n, as C calls it: arrays by their addresses, the answer in out[0..3]."""
    starts = carray(first, (n + 1, 2))
    own = Levels(
        0, carray(numbers, (n, 10)), starts, carray(offsets, (starts[n, 0],)),
        carray(samples, (starts[n, 1],)),
    )  # fmt: skip
    answer = carray(out, (4,))
    if mode == WITHIN:
        answer[0] = 1.0 if within(own, k, (ox, oy, oz)) else 0.0
    else:
        t, normal = hit_level_set(own, k, ((ox, oy, oz), (dx, dy, dz)), t_max)
        answer[0], answer[1], answer[2], answer[3] = t, normal[0], normal[1], normal[2]


@cache
def _code() -> Any:
    """``_answer`` as machine code, kept on disk as kernels are."""
    code = CFunc(_answer, (SIGNATURE.args, SIGNATURE.return_type), {}, {"error_model": "numpy"})
    code.enable_caching()
    index: Any = getattr(getattr(code, "_cache", None), "_cache_file", None)
    if index is not None and hasattr(index, "_source_stamp"):
        index._source_stamp = compiling._stamp(__file__)  # see ``jit.kernel``
    code.compile()
    return code


def _address() -> int:
    return 0 if numba.config.DISABLE_JIT else int(cast(int, _code().address))  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


@intrinsic
def _ask(
    typing: Any, code: Any, mode: Any, k: Any, numbers: Any, first: Any, offsets: Any, samples: Any, seven: Any
) -> Any:
    """Call ``_answer`` at an address; seven: o, d and t_max."""
    asked = (types.int64, mode, k, numbers, first, offsets, samples, types.UniTuple(types.float64, 7))

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number, whole = ir.DoubleType(), ir.IntType(64)
        pointers = [t.as_pointer() for t in (number, whole, whole, ir.FloatType())]
        kind = ir.FunctionType(ir.VoidType(), [whole] * 3 + pointers + [number] * 7 + [number.as_pointer()])
        arrays = [
            context.make_array(t)(context, builder, value=a)
            for t, a in zip(signature.args[3:7], args[3:7], strict=True)
        ]
        out = cgutils.alloca_once(builder, number, size=4)
        mode, k = (
            context.cast(builder, a, t, types.int64) for a, t in zip(args[1:3], signature.args[1:3], strict=True)
        )
        n = builder.extract_value(arrays[0].shape, 0)
        plain = [builder.bitcast(a.data, t) for a, t in zip(arrays, pointers, strict=True)]
        seven = [builder.extract_value(args[7], i) for i in range(7)]
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), [mode, k, n, *plain, *seven, out])
        found = [builder.load(builder.gep(out, [ir.Constant(ir.IntType(32), i)])) for i in range(4)]
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(types.float64, 4)(*asked), generate


def crossing(levels: Levels, k: int, ray: Any, t_max: float) -> Any:
    """``hit_level_set``, for renderers."""
    return hit_level_set(levels, k, ray, t_max)


@overload(crossing)
def _compiled_crossing(levels, k, ray, t_max):
    def asked(levels, k, ray, t_max):
        o, d = ray
        v = levels
        seven = (o[0], o[1], o[2], d[0], d[1], d[2], t_max)
        t, x, y, z = _ask(v.code, HIT, k, v.numbers, v.first, v.offsets, v.samples, seven)  # pyright: ignore[reportCallIssue]
        return t, (x, y, z)

    return asked


def inside_of(levels: Levels, k: int, p: Any) -> bool:
    """``within``, for renderers."""
    return within(levels, k, p)


@overload(inside_of)
def _compiled_inside(levels, k, p):
    def asked(levels, k, p):
        v = levels
        seven = (p[0], p[1], p[2], 0.0, 0.0, 1.0, 0.0)
        return _ask(v.code, WITHIN, k, v.numbers, v.first, v.offsets, v.samples, seven)[0] > 0.0  # pyright: ignore[reportCallIssue]

    return asked
