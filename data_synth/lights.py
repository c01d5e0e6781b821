"""Lights (PHYSICS 7). A light table is a (n, 16) float array; each row is made by a function below.

Columns: kind, back, 0, 0 | r, g, b | position or direction towards the light (3) | per kind.
    point        intensity I in W/sr:          arriving irradiance I / r^2
    spot         a piece of a quad light seen from afar: intensity I cos(theta) about the unit normal in columns 10-12
    directional  irradiance across its beam
    quad         radiance of one face of a parallelogram; columns 10-12, 13-15 are its edge vectors. Whatever runs into
                 that face ends there. The other face is black (back 1) or lets all light through (back 0)
    sky          radiance from infinity: columns 4-6 at the zenith, 7-9 at the horizon, 10-12 below; constant if equal
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from data_synth.checks import direction, vector
from data_synth.errors import InputError
from data_synth.jit import jit, plain
from data_synth.media import rgb
from data_synth.rng import uniform
from data_synth.surfaces import RELATIVE
from data_synth.vec import along, cross, dot, extent, scale, sphere_direction, sub

POINT, DIRECTIONAL, QUAD, SKY, SPOT = range(5)
WIDTH = 16


def _row(kind: int, *columns: ArrayLike) -> np.ndarray:
    row = np.zeros(WIDTH)
    row[0] = kind
    values = np.concatenate([np.ravel(c) for c in columns])
    if not np.isfinite(values).all():
        raise InputError("light: expected finite numbers")
    row[4 : 4 + len(values)] = values
    return row


def point(position: ArrayLike, intensity: ArrayLike) -> np.ndarray:
    """A point that radiates ``intensity`` (RGB, W/sr) equally in all directions."""
    return _row(POINT, rgb(intensity, "intensity"), vector(position, "position"))


def directional(towards: ArrayLike, irradiance: ArrayLike) -> np.ndarray:
    """A distant light seen in direction ``towards``; irradiance is RGB across the beam."""
    return _row(DIRECTIONAL, rgb(irradiance, "irradiance"), direction(towards, "towards"))


def quad(
    corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike, radiance: ArrayLike, back: str = "black"
) -> np.ndarray:
    """The parallelogram corner + [0,1] edge_u + [0,1] edge_v; it radiates on the side of edge_u x edge_v.

    back: "black", a panel that also throws a shadow; or "clear", a lamp that is not there when seen from behind.
    """
    if back not in ("black", "clear"):
        raise InputError(f"quad: back must be black or clear, got '{back}'")
    corner, edge_u, edge_v = vector(corner, "corner"), vector(edge_u, "edge_u"), vector(edge_v, "edge_v")
    row = _row(QUAD, rgb(radiance, "radiance"), corner, edge_u, edge_v)
    if not np.any(np.cross(row[10:13], row[13:16])):
        raise InputError(f"quad: expected edges that span a parallelogram, got {edge_u} and {edge_v}")
    row[1] = back == "black"
    return row


def environment(radiance: ArrayLike) -> np.ndarray:
    """The same radiance from every direction."""
    return sky(radiance, radiance, radiance)


def sky(zenith: ArrayLike, horizon: ArrayLike, ground: ArrayLike) -> np.ndarray:
    """A smooth sky: radiance at the zenith, at the horizon and below it."""
    return _row(SKY, rgb(zenith, "zenith"), rgb(horizon, "horizon"), rgb(ground, "ground"))


def discretise(rows: list[np.ndarray], n: int) -> list[np.ndarray]:
    """Sky and quad lights as n directional or about n spot lights, for integrators that sum over beams.

    Sky directions lie on a Fibonacci sphere, each with the irradiance of 4 pi / n steradians.
    """
    beams = []
    for row in rows:
        if row[0] == SKY:
            for k in range(n):
                z = 1.0 - (2.0 * k + 1.0) / n
                a = 2.399963229728653 * k
                d = np.array([math.sqrt(1 - z * z) * math.cos(a), math.sqrt(1 - z * z) * math.sin(a), z])
                irradiance = np.array(sky_radiance(row, tuple(d))) * 4.0 * math.pi / n
                if irradiance.max() > 0:
                    beams.append(directional(d, irradiance))
        elif row[0] == QUAD:
            side = max(int(math.sqrt(n)), 1)
            normal = np.cross(row[10:13], row[13:16])
            area = np.linalg.norm(normal)
            for k in range(side * side):
                u, v = (k % side + 0.5) / side, (k // side + 0.5) / side
                p = row[7:10] + u * row[10:13] + v * row[13:16]
                beams.append(_row(SPOT, row[4:7] * area / side**2, p, normal / area))
        else:
            beams.append(row)
    return beams


@jit
def column3(lights, k, c):
    return (lights[k, c], lights[k, c + 1], lights[k, c + 2])


@jit
def sky_blend(zenith, horizon, ground, dz):
    """Horizon to zenith with the square root of the sine of elevation; a soft edge to the ground."""
    if dz >= 0.0:
        t = math.sqrt(dz)
        a, b = horizon, zenith
    else:
        t = min(-8.0 * dz, 1.0)
        a, b = horizon, ground
    return (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2]))


def sky_radiance(row: np.ndarray, d: Sequence[float]) -> tuple[float, float, float]:
    """Radiance of a sky light's row from direction d."""
    return plain(sky_blend)(tuple(row[4:7]), tuple(row[7:10]), tuple(row[10:13]), d[2])


@jit
def escaped(lights, d):
    """Radiance that a ray leaving the scene along d meets: the sum of the sky lights."""
    total = (0.0, 0.0, 0.0)
    for k in range(lights.shape[0]):
        if lights[k, 0] == SKY:
            s = sky_blend(column3(lights, k, 4), column3(lights, k, 7), column3(lights, k, 10), d[2])
            total = (total[0] + s[0], total[1] + s[1], total[2] + s[2])
    return total


@jit
def sample_light(lights, k, p, rng):
    """(wi, distance, radiance / pdf, pdf): a direction from p towards light k. pdf (1/sr) is 0 for beams (deltas).

    The radiance does not yet know of anything that stands or floats in between.
    """
    kind = lights[k, 0]
    colour = column3(lights, k, 4)
    if kind == DIRECTIONAL:
        return column3(lights, k, 7), math.inf, colour, 0.0
    if kind == SKY:
        wi = sphere_direction((0.0, 0.0, 1.0), 1.0 - 2.0 * uniform(rng), 2.0 * math.pi * uniform(rng))
        s = sky_blend(colour, column3(lights, k, 7), column3(lights, k, 10), wi[2])
        return wi, math.inf, scale(4.0 * math.pi, s), 0.25 / math.pi
    q, normal, pdf_area = column3(lights, k, 7), column3(lights, k, 10), 1.0
    if kind == QUAD:
        u, v = uniform(rng), uniform(rng)
        eu, ev = column3(lights, k, 10), column3(lights, k, 13)
        q = (q[0] + u * eu[0] + v * ev[0], q[1] + u * eu[1] + v * ev[1], q[2] + u * eu[2] + v * ev[2])
        normal = cross(eu, ev)
        pdf_area = 1.0 / math.sqrt(dot(normal, normal))
    to = sub(q, p)
    r2 = dot(to, to)
    r = math.sqrt(r2)
    wi = scale(1.0 / r, to)
    if kind == POINT:
        return wi, r, scale(1.0 / r2, colour), 0.0
    cosine = -dot(wi, normal) * pdf_area
    if cosine <= 0.0:
        return wi, r, (0.0, 0.0, 0.0), 1.0
    if kind == SPOT:
        return wi, r, scale(cosine / r2, colour), 0.0
    pdf = pdf_area * r2 / cosine
    return wi, r, scale(1.0 / pdf, colour), pdf


@jit
def hit_quad(quads, ray, t_max):
    """(t, k) of the nearest quad light that a ray runs into before t_max, k = -1 if there is none."""
    best, which = t_max, -1
    for k in range(quads.shape[0]):
        eu, ev = column3(quads, k, 10), column3(quads, k, 13)
        n = cross(eu, ev)
        facing = dot(ray[1], n)
        if facing < 0.0 or (facing > 0.0 and quads[k, 1] > 0.0):
            corner = column3(quads, k, 7)
            t = dot(sub(corner, ray[0]), n) / facing
            if RELATIVE * (extent(ray[0]) + extent(corner) + extent(eu) + extent(ev)) < t < best:
                q = sub(along(ray, t), corner)
                n2 = dot(n, n)
                u, v = dot(cross(q, ev), n) / n2, dot(cross(eu, q), n) / n2
                if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0:
                    best, which = t, k
    return best, which


@jit
def quad_radiance(quads, k, d):
    """What a ray along d that ends on quad k sees: its radiance, or black from behind."""
    n = cross(column3(quads, k, 10), column3(quads, k, 13))
    return column3(quads, k, 4) if dot(d, n) < 0.0 else (0.0, 0.0, 0.0)


@jit
def quad_pdf(quads, k, ray, t):
    """Solid-angle density with which ``sample_light`` would have chosen the ray that meets quad k at t in front."""
    n = cross(column3(quads, k, 10), column3(quads, k, 13))
    return t * t / abs(dot(ray[1], n))
