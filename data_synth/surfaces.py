"""Surfaces: planes, spheres, boxes, triangles and level sets (``crossings.py``), and the materials on them (PHYSICS 9).

A shape table is a (n, 12) float array: kind, material, numbers. Triangles stand in a second table, (m, 12):
material, corner, edge, edge, and are found through a bounding volume hierarchy. A hit's normal points *out* of closed
shapes, on the side of edge x edge for triangles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth.checks import direction, vector
from data_synth.crossings import Levels, LevelSet, collected, crossing
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.vec import RELATIVE, along, cross, dot, extent, slab, sub, unit

PLANE, SPHERE, BOX = range(3)
LEAF = 4


class Geometry(NamedTuple):
    """All surfaces. bvh: (nodes, 9) in depth-first order: lo, hi, first triangle, number of triangles (0 for inner
    nodes), and the node that follows when this one and all below it are done."""

    shapes: np.ndarray
    triangles: np.ndarray
    bvh: np.ndarray
    levels: Levels


def plane(material: int, point: ArrayLike, normal: ArrayLike) -> np.ndarray:
    """An infinite plane."""
    return _shape(PLANE, material, vector(point, "point"), direction(normal, "normal"))


def sphere(material: int, centre: ArrayLike, radius: float) -> np.ndarray:
    if not radius > 0:
        raise InputError(f"sphere: radius must be positive, got {radius}")
    return _shape(SPHERE, material, vector(centre, "centre"), [radius])


def box(material: int, lo: ArrayLike, hi: ArrayLike) -> np.ndarray:
    """An axis-aligned box."""
    lo, hi = vector(lo, "lo"), vector(hi, "hi")
    if not (lo < hi).all():
        raise InputError(f"box: expected lo < hi, got {lo.tolist()} and {hi.tolist()}")
    return _shape(BOX, material, lo, hi)


def mesh(material: int, vertices: ArrayLike, faces: ArrayLike) -> np.ndarray:
    """(m, 12) rows of triangles from (n, 3) vertices and (m, 3) vertex numbers."""
    points, corners = np.asarray(vertices, float), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or corners.ndim != 2 or corners.shape[1] != 3:
        raise InputError(f"mesh: expected (n, 3) vertices and (m, 3) faces, got {points.shape} and {corners.shape}")
    if corners.dtype.kind not in "iu":
        raise InputError(f"mesh: expected whole numbers of vertices as faces, got {corners.dtype}")
    if not np.isfinite(points).all() or corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise InputError("mesh: expected finite vertices and faces that number them")
    a, b, c = (points[corners[:, k]] for k in range(3))
    rows = np.zeros((len(corners), 12))
    rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7:10] = material, a, b - a, c - a
    return rows


def _shape(kind: int, material: int, *columns: ArrayLike) -> np.ndarray:
    row = np.zeros(12)
    values = np.concatenate([np.ravel(np.asarray(c, float)) for c in columns])
    if not np.isfinite(values).all():
        raise InputError("shape: expected finite numbers")
    row[0], row[1], row[2 : 2 + len(values)] = kind, material, values
    return row


def geometry(
    shapes: Sequence[np.ndarray] = (), triangles: np.ndarray | None = None, level_sets: Sequence[LevelSet] = ()
) -> Geometry:
    """Collect shapes and level sets, and triangles in a hierarchy (median split along the longest side)."""
    table, levels = np.array(shapes, float).reshape(-1, 12), collected(level_sets)
    if triangles is None or len(triangles) == 0:
        return Geometry(table, np.zeros((0, 12)), np.zeros((0, 9)), levels)
    corners = triangles[:, None, 1:4] + np.stack(
        [np.zeros_like(triangles[:, 1:4]), triangles[:, 4:7], triangles[:, 7:10]], axis=1
    )
    lo, hi = corners.min(axis=1), corners.max(axis=1)
    order = np.arange(len(triangles))
    nodes: list[list[float]] = []

    def build(first: int, last: int) -> None:
        part = order[first:last]
        index = len(nodes)
        low, high = lo[part].min(axis=0), hi[part].max(axis=0)
        nodes.append([*low, *high, first, last - first, 0])
        if last - first > LEAF:
            nodes[index][7] = 0
            axis = int(np.argmax(high - low))
            middle = (last - first) // 2
            order[first:last] = part[np.argsort((lo + hi)[part, axis], kind="stable")]
            build(first, first + middle)
            build(first + middle, last)
        nodes[index][8] = len(nodes)

    build(0, len(order))
    return Geometry(table, np.ascontiguousarray(triangles[order]), np.array(nodes, float), levels)


@jit
def sphere_roots(ray, centre, radius):
    """(t0, t1) of a ray and a sphere, t0 > t1 if it misses."""
    to = sub(centre, ray[0])
    b = dot(to, ray[1])
    off = (to[0] - b * ray[1][0], to[1] - b * ray[1][1], to[2] - b * ray[1][2])
    h = radius * radius - dot(off, off)
    if h < 0.0:
        return 1.0, 0.0
    h = math.sqrt(h)
    return b - h, b + h


@jit
def hit_shape(row, ray, t_max):
    """Nearest t in (0, t_max) of a shape, t_max if there is none. 0 is as wide as rounding makes it (RELATIVE)."""
    p, q = (row[2], row[3], row[4]), (row[5], row[6], row[7])
    if row[0] == PLANE:
        size, facing = extent(p), dot(ray[1], q)
        t0 = dot(sub(p, ray[0]), q) / facing if facing != 0.0 else -1.0
        t1 = t0
    elif row[0] == SPHERE:
        size = extent(p) + row[5]
        t0, t1 = sphere_roots(ray, p, row[5])
    else:
        size = max(extent(p), extent(q))
        t0, t1 = slab(ray, p, q, -math.inf, math.inf)
    if t0 > t1:
        return t_max
    near = RELATIVE * (extent(ray[0]) + size)
    t = t0 if t0 > near else t1
    return t if near < t < t_max else t_max


@jit
def contains(row, p):
    """Whether a closed shape holds a point; of a plane it is the side that its normal does not point to."""
    a, b = (row[2], row[3], row[4]), (row[5], row[6], row[7])
    if row[0] == PLANE:
        return dot(sub(p, a), b) < 0.0
    if row[0] == SPHERE:
        to = sub(p, a)
        return dot(to, to) < row[5] * row[5]
    return a[0] < p[0] < b[0] and a[1] < p[1] < b[1] and a[2] < p[2] < b[2]


@jit
def shape_normal(row, p):
    if row[0] == PLANE:
        return (row[5], row[6], row[7])
    if row[0] == SPHERE:
        return unit(sub(p, (row[2], row[3], row[4])))
    axis, far = 0, -1.0
    for k in range(3):
        middle, half = 0.5 * (row[2 + k] + row[5 + k]), 0.5 * (row[5 + k] - row[2 + k])
        depth = abs(p[k] - middle) / half
        if depth > far:
            axis, far = k, depth
    s = 1.0 if p[axis] > 0.5 * (row[2 + axis] + row[5 + axis]) else -1.0
    return (s if axis == 0 else 0.0, s if axis == 1 else 0.0, s if axis == 2 else 0.0)


@jit
def hit_triangle(row, ray, t_max):
    """Moller & Trumbore 1997; both sides."""
    corner, eu, ev = (row[1], row[2], row[3]), (row[4], row[5], row[6]), (row[7], row[8], row[9])
    h = cross(ray[1], ev)
    det = dot(eu, h)
    if det == 0.0:
        return t_max
    s = sub(ray[0], corner)
    u = dot(s, h) / det
    if u < 0.0 or u > 1.0:
        return t_max
    q = cross(s, eu)
    v = dot(ray[1], q) / det
    t = dot(ev, q) / det
    near = RELATIVE * (extent(ray[0]) + extent(corner) + extent(eu) + extent(ev))
    return t if v >= 0.0 and u + v <= 1.0 and near < t < t_max else t_max


@jit
def intersect(g, ray, t_max):
    """(t, n, material) of the nearest surface before t_max; material -1 if there is none."""
    best, n, material = t_max, (0.0, 0.0, 1.0), -1
    which = -1
    for k in range(g.shapes.shape[0]):
        t = hit_shape(g.shapes[k], ray, best)
        if t < best:
            best, which = t, k
    if which >= 0:
        n, material = shape_normal(g.shapes[which], along(ray, best)), int(g.shapes[which, 1])
    if g.bvh.shape[0] > 0:
        t, which = hit_mesh(g, ray, best)
        if which >= 0:
            r = g.triangles[which]
            best, material = t, int(r[0])
            n = unit(cross((r[4], r[5], r[6]), (r[7], r[8], r[9])))
    for k in range(g.levels.numbers.shape[0]):
        t, m = crossing(g.levels, k, ray, best)
        if t < best:
            best, n, material = t, m, int(g.levels.numbers[k, 0])
    return best, n, material


@jit
def hit_mesh(g, ray, t_max):
    """(t, triangle) of the nearest triangle through the hierarchy, triangle -1 if there is none."""
    index, best, which = 0, t_max, -1
    while index < g.bvh.shape[0]:
        node = g.bvh[index]
        t0, t1 = slab(ray, (node[0], node[1], node[2]), (node[3], node[4], node[5]), 0.0, best)
        if t0 > t1:
            index = int(node[8])
            continue
        for k in range(int(node[6]), int(node[6] + node[7])):
            t = hit_triangle(g.triangles[k], ray, best)
            if t < best:
                best, which = t, k
        index += 1
    return best, which
