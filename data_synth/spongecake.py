"""SpongeCake: flat layers of SGGX microflakes as one position-free surface reflectance [Wang et al. 2022], PHYSICS 12.

Directions are local: z is the surface normal, wo and wi point outward. A layer has thickness times density tau, a
6-number S and an RGB albedo F. With Lambda(w) = sigma(w) / |cos w| and h the unit half vector, single scattering in a
layer gives
    reflection     f = F D(h) / (4 |cos wi cos wo|) (1 - e^(-tau (Li + Lo))) / (Li + Lo)
    transmission   f = F D(h) / (4 |cos wi cos wo|) (e^(-tau Lo) - e^(-tau Li)) / (Li - Lo)
times the attenuation e^(-tau Lambda) of the layers that either leg crosses besides; light that meets no flake goes
straight on with weight e^(-sum tau Lambda(wo)).

A layer table is (n, 10) float: tau, S (6), F (3); rows from the top (+z) down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from data_synth import sggx
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.media import rgb
from data_synth.rng import uniform


def layer(tau: float, S: Sequence[float] | np.ndarray, albedo: ArrayLike) -> np.ndarray:
    """One layer: tau >= 0, S from ``sggx.fibre`` or ``sggx.surface``, albedo grey or RGB in [0, 1]."""
    if not (math.isfinite(tau) and tau >= 0):
        raise InputError(f"SpongeCake layer: tau must be finite and not negative, got {tau}")
    return np.array([float(tau), *S, *rgb(albedo, "albedo", 1.0)])


@jit
def flakes(layers, k):
    return (layers[k, 1], layers[k, 2], layers[k, 3], layers[k, 4], layers[k, 5], layers[k, 6])


@jit
def slant(s, w):
    """Lambda(w), bounded where the ray grazes the layer."""
    return sggx.projected_area(s, w) / max(abs(w[2]), 1e-9)


@jit
def attenuation(layers, first, last, w):
    """Transmittance of layers first..last - 1 along w."""
    total = 0.0
    for k in range(first, last):
        total += layers[k, 0] * slant(flakes(layers, k), w)
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
        depth = depth_integral(layers[k, 0], slant(s, wo), slant(s, wi), wo[2] * wi[2] > 0.0)
        f = sggx.half_vector_density(s, wo, wi) / (4.0 * cosines) * depth * other_legs(layers, first, last, k, wo, wi)
        r, g, b = r + f * layers[k, 7], g + f * layers[k, 8], b + f * layers[k, 9]
    return (r, g, b)


@jit
def pdf(layers, first, last, wo, wi):
    """Density of ``sample``'s scattered directions (1/sr); it integrates to 1 - the chance of going straight on."""
    total, reach = 0.0, 1.0
    for n in range(last - first):
        k = first + n if wo[2] > 0.0 else last - 1 - n
        s = flakes(layers, k)
        through = math.exp(-layers[k, 0] * slant(s, wo))
        f = sggx.half_vector_density(s, wo, wi) / (4.0 * sggx.projected_area(s, wo))
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
        reach *= math.exp(-layers[k, 0] * slant(s, wo))
        if u >= reach:
            return sggx.sample_specular(s, wo, rng), False
    return (-wo[0], -wo[1], -wo[2]), True
