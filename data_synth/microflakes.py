"""Microflakes of any distribution and what a flake does with light (PHYSICS 11).

A distribution is three functions; ``Normals`` holds either one of the two kinds that have them:
    projected_area(n, w)             sigma(w) = integral of max(w.m, 0) D(m) dm
    normal_density(n, m)             D(m) = D(-m)
    sample_visible_normal(n, w, rng) m with density max(w.m, 0) D(m) / sigma(w)
SGGX has them in closed form (``sggx.py``), every other D by a table (``flake_tables.py``).

A micro-phase function p(m, wo -> wi) says where light goes that meets a flake of normal m, wo.m > 0, and
    f_p(wo -> wi) = 1/sigma(wo)  integral of p(m, wo -> wi) max(wo.m, 0) D(m) dm.
All here keep all light and are reciprocal, p(m, wo -> wi) |wo.m| = p(m, wi -> wo) |wi.m|:
    specular     the mirror: f_p = D(h) / (4 sigma(wo)), the one with a closed form
    diffuse      max(wi.m, 0) / pi
    glossy       a blurred mirror. In the disc below a hemisphere, where directions are their projections, any kernel that is
                 symmetric and integrates to 1 is reciprocal and lossless. In its polar coordinates u = sin^2 theta and phi,
                 u is shifted by up to the roughness, folded at 0 and 1, and phi + pi by a wrapped Cauchy distribution as wide
    refractive   a thin plate of glass: mirrors 2F / (1 + F) of the light, F by Fresnel, all reflections inside added, and lets
                 the rest through, parallel to how it came; both blurred as glossy flakes
"""

from __future__ import annotations

import math
from typing import NamedTuple

from data_synth import sggx
from data_synth.flake_tables import (
    EMPTY,
    RESOLUTION,
    Table,
    beckmann,
    ggx,
    sample_table,
    table_at,
    tabulated,
    together,
    trigonometric,
)  # fmt: skip
from data_synth.fresnel import reflectance
from data_synth.jit import jit
from data_synth.rng import uniform
from data_synth.vec import add, cross, dot, frame, scale, sphere_direction, sub, unit

__all__ = [
    "DIFFUSE", "EMPTY", "GLOSSY", "MICRO", "REFRACTIVE", "RESOLUTION", "SPECULAR", "Normals", "Table", "beckmann", "ggx",
    "half_vector_density", "micro_density", "micro_sample", "normal_density", "projected_area", "sample_specular",
    "sample_visible_normal", "specular_density", "table_at", "tabulated", "together", "trigonometric",
]  # fmt: skip

SPECULAR, DIFFUSE, GLOSSY, REFRACTIVE = range(4)
MICRO = {"specular": SPECULAR, "diffuse": DIFFUSE, "glossy": GLOSSY, "refractive": REFRACTIVE}


class Normals(NamedTuple):
    """One distribution: row ``row`` of the table, or the SGGX matrix S where it is negative."""

    S: tuple[float, float, float, float, float, float]
    table: Table
    row: int


@jit
def projected_area(n, w):
    return sggx.projected_area(n.S, w) if n.row < 0 else table_at(n.table, n.table.kinds + n.row, w)


@jit
def normal_density(n, m):
    return sggx.normal_density(n.S, m) if n.row < 0 else table_at(n.table, n.row, m)


@jit
def sample_visible_normal(n, w, rng):
    return sggx.sample_visible_normal(n.S, w, rng) if n.row < 0 else sample_table(n.table, n.row, w, rng)


@jit
def half_vector_density(n, wo, wi):
    h = add(wo, wi)
    length = math.sqrt(dot(h, h))
    if length < 1e-12:  # exactly forward: the half vector is any normal across the ray, never sampled
        return 0.0
    return normal_density(n, scale(1.0 / length, h))


@jit
def specular_density(n, wo, wi):
    """f_p of mirrors, D(h) / (4 sigma(wo)) in 1/sr."""
    return half_vector_density(n, wo, wi) / (4.0 * projected_area(n, wo))


@jit
def sample_specular(n, wo, rng):
    """wi with density ``specular_density``: mirror wo at a visible normal."""
    m = sample_visible_normal(n, wo, rng)
    return unit(sub(scale(2.0 * dot(wo, m), m), wo))


@jit
def plate(u, ior):
    """What a thin plate mirrors at sin^2 = u, light that went to and fro in it included."""
    F = reflectance(math.sqrt(max(1.0 - u, 0.0)), ior, 0.0)
    return 2.0 * F / (1.0 + F)


@jit
def turn_width(uo, ui, a):
    """c in [0, 1) of the wrapped Cauchy distribution of the azimuth: about as wide across as the blur of u is along."""
    both = math.sqrt(max(uo * ui, 0.0))
    return both / (both + 0.5 * a)


@jit
def blur(uo, ui, cosine, a):
    """Density over the projected disc: 2 k(ui | uo) wrapped Cauchy(turn), both symmetric. cosine: of the turn."""
    ways = 1.0 if abs(ui - uo) < a else 0.0
    ways += 1.0 if ui + uo < a else 0.0
    ways += 1.0 if 2.0 - ui - uo < a else 0.0
    c = turn_width(uo, ui, a)
    return 2.0 * ways / (2.0 * a) * (1.0 - c * c) / (2.0 * math.pi * (1.0 + c * c - 2.0 * c * cosine))


@jit
def micro_density(micro, a, ior, m, wo, wi):
    """p(m, wo -> wi) in 1/sr of all but specular flakes."""
    co, ci = dot(wo, m), dot(wi, m)
    if micro == DIFFUSE:
        return max(ci, 0.0) / math.pi
    if micro == GLOSSY and ci <= 0.0:
        return 0.0
    xo, xi = sub(wo, scale(co, m)), sub(wi, scale(ci, m))
    uo, ui = dot(xo, xo), dot(xi, xi)
    product = math.sqrt(uo * ui)
    p = abs(ci) * blur(uo, ui, -dot(xo, xi) / product if product > 0.0 else 1.0, a)
    if micro == REFRACTIVE:
        R = plate(0.5 * (uo + ui), ior)
        p *= R if ci > 0.0 else 1.0 - R
    return p


@jit
def micro_sample(micro, a, ior, m, wo, rng):
    """wi with density p(m, wo -> .)."""
    if micro == DIFFUSE:
        return sphere_direction(m, math.sqrt(1.0 - uniform(rng)), 2.0 * math.pi * uniform(rng))
    co = dot(wo, m)
    back = sub(scale(co, m), wo)
    uo = dot(back, back)
    ui = abs(uo + a * (2.0 * uniform(rng) - 1.0))
    ui = 2.0 - ui if ui > 1.0 else ui
    c = turn_width(uo, ui, a)
    turn = 2.0 * math.atan((1.0 - c) / (1.0 + c) * math.tan(math.pi * (uniform(rng) - 0.5)))
    first = scale(1.0 / math.sqrt(uo), back) if uo > 1e-24 else frame(m)[0]
    r = math.sqrt(ui)
    flat = add(scale(r * math.cos(turn), first), scale(r * math.sin(turn), cross(m, first)))
    side = math.sqrt(max(1.0 - ui, 0.0))
    if micro == REFRACTIVE and uniform(rng) >= plate(0.5 * (uo + ui), ior):
        side = -side
    return unit(add(flat, scale(side, m)))
