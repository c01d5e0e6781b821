"""What surfaces do to light (PHYSICS 9). A material table is a (n, 16) float array with rows made below.

Columns: kind, albedo (1-3; of boundaries the tint), second albedo of a checker (4-6), edge of its squares (7, 0 = none), gloss
(8; of boundaries the roughness), exponent (9), index of refraction (10), first and last row in the layer table (11, 12), and of
boundaries the number of the medium inside (13), the priority (14) and, in a world, the place of their counter (15, -1 = none;
see ``world.py``).
All directions point outward; n is the geometric normal, out of closed shapes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth import spongecake
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.media import rgb
from data_synth.rng import uniform
from data_synth.vec import add, cross, dot, from_frame, mul, neg, scale, sphere_direction, sub, unit

LAMBERT, BLINN_PHONG, SPONGECAKE, DIELECTRIC, NULL = range(5)
SMOOTHEST = 1e-4  # GGX's alpha, below which its peak has no digits left
CLEAR, UNSAID = -1, -2  # no medium inside; the scene decides


class Materials(NamedTuple):
    rows: np.ndarray
    layers: spongecake.Layers


def lambert(albedo: ArrayLike, second: ArrayLike | None = None, square: float = 0.0) -> np.ndarray:
    """Matt; with ``second`` a checker of squares of edge ``square`` (u) in x, y and z."""
    return _row(LAMBERT, albedo, second, square)


def blinn_phong(
    albedo: ArrayLike, gloss: float, exponent: float, second: ArrayLike | None = None, square: float = 0.0
) -> np.ndarray:
    """Matt plus an energy-normalised highlight gloss (e + 8)/(8 pi) (n.h)^e; gloss + albedo should stay below 1."""
    row = _row(BLINN_PHONG, albedo, second, square)
    if not 0 <= gloss <= 1 or not exponent >= 0:
        raise InputError(f"blinn_phong: expected gloss in [0, 1] and exponent >= 0, got {gloss} and {exponent}")
    row[8], row[9] = gloss, exponent
    return row


def dielectric(
    ior: float, medium: int | None = None, priority: float = 0.0, roughness: float = 0.0, tint: ArrayLike = 1.0
) -> np.ndarray:
    """A boundary that reflects and refracts. ior: the index of refraction inside; outside of all it is 1.

    roughness: GGX's alpha, 0 (smooth) to 1 (``rough.py``); marching knows smooth boundaries alone, and draws this as one.
    tint: RGB fraction in [0, 1] of the light that goes through which is left, at each crossing; what is mirrored is not tinted.

    medium: the number of the medium inside, ``CLEAR`` for none; None: as the scene says. priority: where closed
    boundaries overlap the highest counts, of equal ones the later material (Schmidt & Budge 2002). Boundaries must not
    coincide: let the inner one overlap a little.

    Radiance is not scaled by the squared index on its way in and out, which is right for light from outside. What glows
    inside shows Le itself, not Le n^2: an isothermal scene disappears.
    """
    if not ior > 0:
        raise InputError(f"dielectric: ior must be positive, got {ior}")
    if not 0 <= roughness <= 1:
        raise InputError(f"dielectric: roughness must be in [0, 1], got {roughness}")
    row = _boundary(DIELECTRIC, medium, priority)
    row[10], row[1:4], row[8] = ior, rgb(tint, "tint", 1.0), max(roughness, SMOOTHEST) if roughness > 0 else 0.0
    return row


def null(medium: int | None = None, priority: float = 0.0) -> np.ndarray:
    """A boundary that only tells where a medium is: light passes. medium, priority: as of ``dielectric``."""
    return _boundary(NULL, medium, priority)


def _boundary(kind: int, medium: int | None, priority: float) -> np.ndarray:
    row = _row(kind, 1.0, None, 0.0)
    if medium is not None and (medium != int(medium) or medium < CLEAR):
        raise InputError(f"boundary: medium must be the number of a medium or {CLEAR} for none, got {medium}")
    if not math.isfinite(priority):
        raise InputError(f"boundary: priority must be finite, got {priority}")
    row[13], row[14], row[15] = UNSAID if medium is None else medium, priority, -1
    return row


def layered(first: int, last: int) -> np.ndarray:
    """SpongeCake layers first..last - 1 of the scene's layer table, top first."""
    row = _row(SPONGECAKE, 1.0, None, 0.0)
    row[11], row[12] = first, last
    return row


def _row(kind: int, albedo: ArrayLike, second: ArrayLike | None, square: float) -> np.ndarray:
    row = np.zeros(16)
    row[0], row[1:4], row[7] = kind, rgb(albedo, "albedo", 1.0), square
    row[4:7] = row[1:4] if second is None else rgb(second, "second albedo", 1.0)
    return row


@jit
def albedo_at(row, p):
    if row[7] > 0.0:
        e = 1.0 / row[7]
        odd = math.floor(p[0] * e + 1e-6) + math.floor(p[1] * e + 1e-6) + math.floor(p[2] * e + 1e-6)
        if odd % 2.0 != 0.0:
            return (row[4], row[5], row[6])
    return (row[1], row[2], row[3])


@jit
def tint_of(row):
    """What is left of light that goes through a boundary, besides what it mirrors."""
    return (row[1], row[2], row[3])


@jit
def to_local(n, w):
    s, t = spongecake_frame(n)
    return (dot(w, s), dot(w, t), dot(w, n))


@jit
def spongecake_frame(n):
    """A tangent frame whose first axis is as near to x as can be, so that fibres lie the same way all over a sheet."""
    reference = (1.0, 0.0, 0.0) if abs(n[0]) < 0.9 else (0.0, 1.0, 0.0)
    t = unit(cross(n, reference))
    return cross(t, n), t


@jit
def evaluate(m, k, p, n, wo, wi):
    """RGB f(wo, wi) |cos wi|; 0 for the deltas (dielectric, null, straight on)."""
    row = m.rows[k]
    if row[0] == SPONGECAKE:
        f = spongecake.evaluate(m.layers, int(row[11]), int(row[12]), to_local(n, wo), to_local(n, wi))
        return scale(abs(dot(n, wi)), f)
    out, cosine = dot(n, wo), dot(n, wi)
    if row[0] >= DIELECTRIC or out * cosine <= 0.0:
        return (0.0, 0.0, 0.0)
    f = scale(abs(cosine) / math.pi, albedo_at(row, p))
    if row[0] == BLINN_PHONG:
        h = unit(add(wo, wi))
        lobe = row[8] * (row[9] + 8.0) / (8.0 * math.pi) * abs(dot(n, h)) ** row[9] * abs(cosine)
        f = (f[0] + lobe, f[1] + lobe, f[2] + lobe)
    return f


@jit
def pdf(m, k, n, wo, wi):
    """Density of ``sample`` (1/sr) for its scattered, not straight, directions."""
    row = m.rows[k]
    if row[0] == SPONGECAKE:
        return spongecake.pdf(m.layers, int(row[11]), int(row[12]), to_local(n, wo), to_local(n, wi))
    out, cosine = dot(n, wo), dot(n, wi)
    if row[0] >= DIELECTRIC or out * cosine <= 0.0:
        return 0.0
    density = abs(cosine) / math.pi
    if row[0] == BLINN_PHONG:
        h = unit(add(wo, wi))
        lobe = (row[9] + 1.0) / (2.0 * math.pi) * abs(dot(n, h)) ** row[9] / (4.0 * max(abs(dot(wo, h)), 1e-9))
        density += 0.5 * (lobe - density)
    return density


@jit
def mirrored(n, wo):
    return sub(scale(2.0 * dot(n, wo), n), wo)


@jit
def refracted(n, wo, eta):
    """(direction behind a smooth boundary, reflectance of unpolarised light). eta: index on the side of wo over the other.

    Where nothing gets through the reflectance is 1.
    """
    cosine = dot(n, wo)
    s2 = eta * eta * (1.0 - cosine * cosine)
    if s2 >= 1.0:
        return mirrored(n, wo), 1.0
    ci, ct = abs(cosine), math.sqrt(1.0 - s2)
    parallel = (ci - eta * ct) / (ci + eta * ct)
    across = (eta * ci - ct) / (eta * ci + ct)
    side = 1.0 if cosine > 0.0 else -1.0
    d = unit(sub(scale(eta * ci - ct, scale(side, n)), scale(eta, wo)))
    return d, 0.5 * (parallel * parallel + across * across)


@jit
def sample(m, k, p, n, wo, rng):
    """(wi, weight, pdf, straight): weight = f |cos| / pdf. straight: no flake of a layered sheet was met.

    For surfaces that are no boundaries; those are crossed in ``world.py``.
    """
    row = m.rows[k]
    if row[0] == SPONGECAKE:
        local, straight = spongecake.sample(m.layers, int(row[11]), int(row[12]), to_local(n, wo), rng)
        if straight:
            return neg(wo), (1.0, 1.0, 1.0), 0.0, True
        s, t = spongecake_frame(n)
        wi = add(add(scale(local[0], s), scale(local[1], t)), scale(local[2], n))
    else:
        up = n if dot(n, wo) > 0.0 else neg(n)
        if row[0] == BLINN_PHONG and uniform(rng) < 0.5:
            h = sphere_direction(up, uniform(rng) ** (1.0 / (row[9] + 1.0)), 2.0 * math.pi * uniform(rng))
            wi = unit(mirrored(h, wo))
        else:
            r, a = math.sqrt(uniform(rng)), 2.0 * math.pi * uniform(rng)
            wi = from_frame(up, r * math.cos(a), r * math.sin(a), math.sqrt(max(1.0 - r * r, 0.0)))
    density = pdf(m, k, n, wo, wi)
    if density <= 0.0:
        return wi, (0.0, 0.0, 0.0), 1.0, False
    return wi, mul(evaluate(m, k, p, n, wo, wi), (1.0 / density, 1.0 / density, 1.0 / density)), density, False
