"""What kernels see of a scene, and how they walk through its surfaces and its media.

Where a ray is, is a number: for every boundary material (null or dielectric) four bits count how many closed surfaces of
it hold the point. Of the materials that count at least one the highest priority says which medium is there, and of the
dielectrics among them the highest says what the index of refraction is. Nested and overlapping boundaries need no more
(Schmidt & Budge 2002, with counters instead of a stack).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth import materials as stuff
from data_synth.crossings import inside_of
from data_synth.jit import jit
from data_synth.lights import hit_quad
from data_synth.materials import DIELECTRIC, NULL, SPONGECAKE, Materials
from data_synth.media import Medium
from data_synth.pool import Media, medium_at
from data_synth.spongecake import attenuation
from data_synth.surfaces import Geometry, contains, hit_mesh, intersect
from data_synth.trackers import shadow_transmittance
from data_synth.vec import along, cross, dot, largest, mul, neg, scale

COUNTERS = 15  # boundary materials of one scene: four bits each
RANDOM, MARCHED, SURFACES = range(3)  # how ``visible`` treats what is in between


class World(NamedTuple):
    """The scene as kernels see it.

    medium: number 0; others: numbers 1, 2, ...; ambient: the number outside of all boundaries, -1 for none. lights: what
    is sampled or summed over; quads: the lamps that stand in the scene; sky: the sky lights.
    """

    medium: Medium
    others: Media
    geometry: Geometry
    materials: Materials
    lights: np.ndarray
    quads: np.ndarray
    sky: np.ndarray
    ambient: int


def has_surfaces(w: World) -> bool:
    """Whether anything but the medium and the sky can be seen."""
    g = w.geometry
    return len(g.shapes) + len(g.triangles) + len(g.levels.numbers) + len(w.quads) > 0


def has_boundaries(w: World) -> bool:
    """Whether it depends on closed surfaces where the media are."""
    return bool(np.any(w.materials.rows[:, 15] >= 0)) or len(w.others.numbers) > 0


@jit
def crossing(row, inside, entering):
    """``inside`` behind a boundary of material row ``row``."""
    slot = int(row[15])
    if slot < 0:
        return inside
    shift = 4 * slot
    if entering:
        return inside + (1 << shift)
    return inside - (1 << shift) if (inside >> shift) & 15 > 0 else inside


@jit
def inside_at(w, p):
    """Which closed boundaries hold a point."""
    inside, rows, g = 0, w.materials.rows, w.geometry
    for k in range(g.shapes.shape[0]):
        row = rows[int(g.shapes[k, 1])]
        if row[0] >= DIELECTRIC and row[15] >= 0.0 and contains(g.shapes[k], p):
            inside = crossing(row, inside, True)
    for k in range(g.levels.numbers.shape[0]):
        row = rows[int(g.levels.numbers[k, 0])]
        if row[0] >= DIELECTRIC and row[15] >= 0.0 and inside_of(g.levels, k, p):
            inside = crossing(row, inside, True)
    if g.triangles.shape[0] == 0:
        return inside
    ray = (p, (0.4082482904638631, 0.5773502691896258, 0.7071067811865475))  # any: it counts ways out less ways in
    for _ in range(256):
        t, which = hit_mesh(g, ray, math.inf)
        if which < 0:
            break
        r = g.triangles[which]
        row = rows[int(r[0])]
        if row[0] >= DIELECTRIC and row[15] >= 0.0:
            leaving = dot(ray[1], cross((r[4], r[5], r[6]), (r[7], r[8], r[9]))) > 0.0
            inside += (1 if leaving else -1) << (4 * int(row[15]))
        ray = (along(ray, t), ray[1])
    return inside


@jit
def number_at(w, inside):
    """Number of the medium there, -1 for none."""
    if inside == 0:
        return w.ambient
    number, best = w.ambient, -math.inf
    rows = w.materials.rows
    for k in range(rows.shape[0]):
        if rows[k, 0] >= DIELECTRIC and rows[k, 15] >= 0.0 and (inside >> (4 * int(rows[k, 15]))) & 15 > 0:
            if rows[k, 14] >= best:
                number, best = int(rows[k, 13]), rows[k, 14]
    return number


@jit
def index_at(w, inside):
    """Index of refraction there."""
    ior, best = 1.0, -math.inf
    rows = w.materials.rows
    for k in range(rows.shape[0]):
        if rows[k, 0] == DIELECTRIC and rows[k, 15] >= 0.0 and (inside >> (4 * int(rows[k, 15]))) & 15 > 0:
            if rows[k, 14] >= best:
                ior, best = rows[k, 10], rows[k, 14]
    return ior


@jit
def medium_of(w, number):
    return w.medium if number == 0 else medium_at(w.others, number - 1)


@jit
def kept_behind(w, k, d, n, inside, mode):
    """(RGB fraction of light that goes straight on through a surface of material k along d, ``inside`` behind it).

    Glass lets shadow rays of the march pass straight, less what it reflects; in path tracing light behind glass is found
    by the paths themselves, and shadow rays end at it.
    """
    row = w.materials.rows[k]
    kind = row[0]
    if kind == SPONGECAKE:
        kept = attenuation(w.materials.layers, int(row[11]), int(row[12]), stuff.to_local(n, neg(d)))
        return (kept, kept, kept), inside
    if kind < DIELECTRIC:
        return (0.0, 0.0, 0.0), inside
    behind = crossing(row, inside, dot(d, n) < 0.0)
    if kind == NULL:
        return (1.0, 1.0, 1.0), behind
    here, there = index_at(w, inside), index_at(w, behind)
    if here == there:
        return stuff.tint_of(row), behind
    if mode == RANDOM:
        return (0.0, 0.0, 0.0), behind
    _, reflectance = stuff.refracted(n, neg(d), here / there)
    return scale(1.0 - reflectance, stuff.tint_of(row)), behind


@jit
def visible(w, ray, t_max, inside, mode, rng):
    """RGB fraction of light that arrives at the ray's origin from t_max: 0 behind surfaces and lamps, less in media.

    mode: RANDOM, media by ratio tracking, unbiased, and no light through glass; MARCHED, media by marching, and light
    straight through glass; SURFACES, as MARCHED without media. Media with a closed form use it in both cases.
    """
    total = (1.0, 1.0, 1.0)
    for _ in range(64):
        t, n, material = intersect(w.geometry, ray, t_max)
        if w.quads.shape[0] > 0 and hit_quad(w.quads, ray, t)[1] >= 0:
            return (0.0, 0.0, 0.0)
        kept, behind = (1.0, 1.0, 1.0), inside
        if material >= 0:
            kept, behind = kept_behind(w, material, ray[1], n, inside, mode)
            if largest(kept) <= 0.0:
                return (0.0, 0.0, 0.0)
        number = number_at(w, inside) if mode != SURFACES else -1
        if number >= 0:
            through = shadow_transmittance(medium_of(w, number), ray, t, mode == RANDOM, rng)
            kept = mul(kept, through)
        total = mul(total, kept)
        if material < 0 or largest(total) <= 0.0:
            return total
        ray, inside = (along(ray, t), ray[1]), behind
        t_max -= t
    return total


@jit
def next_surface(w, ray):
    """(t, n, material, quad): the nearest surface; or quad >= 0, a lamp that stands before it."""
    t, n, material = intersect(w.geometry, ray, math.inf)
    t, quad = hit_quad(w.quads, ray, t)
    if quad >= 0:
        material = -1
    return t, n, material, quad
