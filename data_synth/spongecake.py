"""SpongeCake: flat layers of microflakes as one position-free surface reflectance [Wang et al. 2022], PHYSICS 12.

Directions are local: z is the surface normal, wo and wi point outward. A layer has thickness times density tau, flakes of
any distribution (``microflakes.py``) that are mirrors, and what they mirror, F. With Lambda(w) = sigma(w) / |cos w| and h
the unit half vector, single scattering in a layer gives
    reflection     f = F(wo.h) D(h) / (4 |cos wi cos wo|) (1 - e^(-tau (Li + Lo))) / (Li + Lo)
    transmission   f = F(wo.h) D(h) / (4 |cos wi cos wo|) (e^(-tau Lo) - e^(-tau Li)) / (Li - Lo)
times the attenuation e^(-tau Lambda) of the layers that either leg crosses besides; light that meets no flake goes
straight on with weight e^(-sum tau Lambda(wo)). What a flake does not mirror it absorbs.

F is the RGB albedo; or that times Fresnel's reflectance of an index eta + i k; or Schlick's, albedo at normal incidence.

A row of the layer table is tau, S (6), albedo (3), kind of F, eta (3), k (3), 1 + row of the table of D or 0; rows from the
top (+z) down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth import fresnel, microflakes
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.media import rgb
from data_synth.rng import uniform
from data_synth.vec import add, dot

WIDTH = 18
CONSTANT, SCHLICK, EXACT = range(3)
FLAKES = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


class Layers(NamedTuple):
    """All layers of a scene: their rows, and the tables of those whose flakes are no SGGX."""

    rows: np.ndarray
    table: microflakes.Table


class Tabulated(NamedTuple):
    """A layer whose flakes are one table."""

    row: np.ndarray
    table: microflakes.Table


def layer(
    tau: float, S: Sequence[float] | np.ndarray | microflakes.Table, albedo: ArrayLike, schlick: bool = False,
    eta: ArrayLike | None = None, k: ArrayLike = 0.0,
) -> np.ndarray | Tabulated:  # fmt: skip
    """One layer: tau >= 0, S from ``sggx.fibre``, ``sggx.surface`` or a table of ``microflakes``, albedo grey or RGB in [0, 1].

    schlick: albedo is what flakes mirror at normal incidence. eta, k: they mirror albedo times the reflectance of that
    index of refraction, grey or RGB; k = 0 is a dielectric (1.5: wax), more a metal (eta 0.2, k 3.4: gold's red).
    """
    if not (math.isfinite(tau) and tau >= 0):
        raise InputError(f"SpongeCake layer: tau must be finite and not negative, got {tau}")
    if schlick and eta is not None:
        raise InputError("SpongeCake layer: expected either schlick or eta, got both")
    of = (CONSTANT, (1.0,) * 3, (0.0,) * 3) if eta is None else (EXACT, rgb(eta, "eta"), rgb(k, "k"))
    if min(of[1]) <= 0:
        raise InputError(f"SpongeCake layer: eta must be positive, got {eta}")
    kind = SCHLICK if schlick else of[0]
    own = FLAKES if isinstance(S, microflakes.Table) else S
    row = np.array([float(tau), *own, *rgb(albedo, "albedo", 1.0), kind, *of[1], *of[2], 0.0])
    if not isinstance(S, microflakes.Table):
        return row
    if S.kinds != 1:
        raise InputError(f"SpongeCake layer: expected one distribution of flakes, got {S.kinds}")
    return Tabulated(row, S)


def stack(layers: Sequence[np.ndarray | Tabulated]) -> Layers:
    """The layers as kernels take them."""
    rows, tables = np.zeros((len(layers), WIDTH)), []
    for k, given in enumerate(layers):
        row = given.row if isinstance(given, Tabulated) else np.asarray(given, float)
        rows[k, : len(row)] = row
        if isinstance(given, Tabulated):
            tables.append(given.table)
            rows[k, 17] = len(tables)
    return Layers(rows, microflakes.together(tables))


@jit
def flakes(layers, k):
    r = layers.rows
    S = (r[k, 1], r[k, 2], r[k, 3], r[k, 4], r[k, 5], r[k, 6])
    return microflakes.Normals(S, layers.table, int(r[k, 17]) - 1)


@jit
def mirrored(layers, k, wo, wi):
    """RGB F of a flake of layer k that mirrors wo to wi."""
    r = layers.rows
    albedo = (r[k, 7], r[k, 8], r[k, 9])
    if r[k, 10] == CONSTANT:
        return albedo
    h = add(wo, wi)
    cosine = min(math.sqrt(dot(h, h)) * 0.5, 1.0)  # wo.h, |h| = 2 cos
    if r[k, 10] == SCHLICK:
        return (
            fresnel.schlick(cosine, albedo[0]),
            fresnel.schlick(cosine, albedo[1]),
            fresnel.schlick(cosine, albedo[2]),
        )
    return (
        albedo[0] * fresnel.reflectance(cosine, r[k, 11], r[k, 14]),
        albedo[1] * fresnel.reflectance(cosine, r[k, 12], r[k, 15]),
        albedo[2] * fresnel.reflectance(cosine, r[k, 13], r[k, 16]),
    )


@jit
def slant(s, w):
    """Lambda(w), bounded where the ray grazes the layer."""
    return microflakes.projected_area(s, w) / max(abs(w[2]), 1e-9)


@jit
def attenuation(layers, first, last, w):
    """Transmittance of layers first..last - 1 along w."""
    total = 0.0
    for k in range(first, last):
        total += layers.rows[k, 0] * slant(flakes(layers, k), w)
    return math.exp(-total)


@jit
def depth_integral(tau, lo, li, reflected):
    """integral over the layer's depth of the attenuation on both legs: the paper's G, safe in its limits."""
    if reflected:
        x = lo + li
        return -math.expm1(-tau * x) / x
    gap = li - lo
    if abs(tau * gap) < 1e-6:
        return tau * math.exp(-0.5 * tau * (lo + li))
    return (math.exp(-tau * lo) - math.exp(-tau * li)) / gap


@jit
def other_legs(layers, first, last, k, wo, wi):
    """Attenuation by the layers other than k that the two legs of a path scattered in layer k cross."""
    to = attenuation(layers, first, k, wo) if wo[2] > 0.0 else attenuation(layers, k + 1, last, wo)
    return to * (attenuation(layers, first, k, wi) if wi[2] > 0.0 else attenuation(layers, k + 1, last, wi))


@jit
def evaluate(layers, first, last, wo, wi):
    """RGB reflectance or transmittance distribution f (1/sr), without the cosine and without the straight part."""
    r, g, b = 0.0, 0.0, 0.0
    cosines = abs(wo[2] * wi[2])
    if cosines < 1e-12:
        return (0.0, 0.0, 0.0)
    for k in range(first, last):
        s = flakes(layers, k)
        depth = depth_integral(layers.rows[k, 0], slant(s, wo), slant(s, wi), wo[2] * wi[2] > 0.0)
        f = (
            microflakes.half_vector_density(s, wo, wi)
            / (4.0 * cosines)
            * depth
            * other_legs(layers, first, last, k, wo, wi)
        )
        F = mirrored(layers, k, wo, wi)
        r, g, b = r + f * F[0], g + f * F[1], b + f * F[2]
    return (r, g, b)


@jit
def pdf(layers, first, last, wo, wi):
    """Density of ``sample``'s scattered directions (1/sr); it integrates to 1 - the chance of going straight on."""
    total, reach = 0.0, 1.0
    for n in range(last - first):
        k = first + n if wo[2] > 0.0 else last - 1 - n
        s = flakes(layers, k)
        through = math.exp(-layers.rows[k, 0] * slant(s, wo))
        f = microflakes.specular_density(s, wo, wi)
        total += reach * (1.0 - through) * f
        reach *= through
    return total


@jit
def sample(layers, first, last, wo, rng):
    """(wi, straight): scattered by the layer where the ray first meets a flake, or straight on."""
    u, reach = uniform(rng), 1.0
    for n in range(last - first):
        k = first + n if wo[2] > 0.0 else last - 1 - n
        s = flakes(layers, k)
        reach *= math.exp(-layers.rows[k, 0] * slant(s, wo))
        if u >= reach:
            return microflakes.sample_specular(s, wo, rng), False
    return (-wo[0], -wo[1], -wo[2]), True
