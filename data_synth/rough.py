"""Rough boundaries: microfacets that mirror and refract [Walter et al. 2007], with the GGX distribution of normals.

All directions are in the boundary's frame (z along the normal) and point outward; eta is the index on the side of wo over that
of the other side, alpha the roughness of GGX. With h the facet's normal on the side of wo,

    mirrored:   f |cos wi| = F D G2 / (4 |wo_z|)
    refracted:  f |cos wi| = (1 - F) D G2 |wo.h| |wi.h| / (|wo_z| (eta wo.h + wi.h)^2),

without the square of the relative index by which radiance shrinks, as in ``materials.dielectric``; so
f(wo, wi) = f(wi, wo) where light is mirrored and eta^2 f(wo, wi) = f(wi, wo) where it is refracted. G2 is Smith's, of heights
that are correlated. Facets are sampled as they are seen from wo [Heitz 2018], so that a sample weighs G2 / G1(wo) <= 1: light
that meets a second facet is lost, as in all such models (a furnace shows it).
"""

import math

from data_synth import materials
from data_synth.jit import jit
from data_synth.rng import uniform
from data_synth.vec import add, cross, dot, scale, unit


@jit
def normal_density(alpha, h):
    """D(h), 1/sr: its projection integrates to 1."""
    a2 = alpha * alpha
    q = h[2] * h[2] * (a2 - 1.0) + 1.0
    return a2 / (math.pi * q * q)


@jit
def hidden(alpha, w):
    """Smith's Lambda: G1 = 1 / (1 + Lambda)."""
    z2 = w[2] * w[2]
    return 0.5 * (math.sqrt(1.0 + alpha * alpha * max(1.0 - z2, 0.0) / max(z2, 1e-30)) - 1.0)


@jit
def parts(alpha, eta, wo, wi):
    """(f |cos wi| without tint, pdf, whether wi is on the other side) of a pair of directions."""
    if wo[2] < 0.0:
        wo, wi = scale(-1.0, wo), scale(-1.0, wi)
    through = wi[2] < 0.0
    if wo[2] <= 0.0 or wi[2] == 0.0:
        return 0.0, 0.0, through
    h = add(scale(eta, wo), wi) if through else add(wo, wi)
    if dot(h, h) < 1e-24:
        return 0.0, 0.0, through
    h = unit(h)
    h = scale(-1.0, h) if h[2] < 0.0 else h
    co, ci = dot(wo, h), dot(wi, h)
    if co <= 0.0 or (ci >= 0.0) == through:
        return 0.0, 0.0, through
    _, reflectance = materials.refracted(h, wo, eta)
    seen = normal_density(alpha, h) * co / wo[2]  # times G1(wo): the density of visible normals
    if through:
        q = eta * co + ci
        value = (1.0 - reflectance) * seen * -ci / (q * q)
    else:
        value = reflectance * seen / (4.0 * co)
    lo, li = hidden(alpha, wo), hidden(alpha, wi)
    return value / (1.0 + lo + li), value / (1.0 + lo), through


@jit
def visible_normal(alpha, w, u, v):
    """A facet's normal as seen from w, w_z > 0 [Heitz 2018]."""
    s = unit((alpha * w[0], alpha * w[1], w[2]))
    flat = s[0] * s[0] + s[1] * s[1]
    x = scale(1.0 / math.sqrt(flat), (-s[1], s[0], 0.0)) if flat > 1e-24 else (1.0, 0.0, 0.0)
    y = cross(s, x)
    r, azimuth = math.sqrt(u), 2.0 * math.pi * v
    a, b = r * math.cos(azimuth), r * math.sin(azimuth)
    k = 0.5 * (1.0 + s[2])
    b = (1.0 - k) * math.sqrt(max(1.0 - a * a, 0.0)) + k * b
    c = math.sqrt(max(1.0 - a * a - b * b, 0.0))
    h = add(add(scale(a, x), scale(b, y)), scale(c, s))
    return unit((alpha * h[0], alpha * h[1], max(h[2], 1e-9)))


@jit
def sample(alpha, eta, wo, rng):
    """(wi, weight without tint, pdf, whether wi is on the other side); weight 0 where a second facet is in the way."""
    side = 1.0 if wo[2] > 0.0 else -1.0
    up = scale(side, wo)
    h = visible_normal(alpha, up, uniform(rng), uniform(rng))
    wi, reflectance = materials.refracted(h, up, eta)
    if uniform(rng) < reflectance:
        wi = materials.mirrored(h, up)
    value, pdf, through = parts(alpha, eta, up, wi)
    if pdf <= 0.0 or through != (dot(wi, h) < 0.0):
        return scale(side, wi), 0.0, 1.0, through
    return scale(side, wi), value / pdf, pdf, through
