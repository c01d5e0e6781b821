"""Light of point lights inside a medium, sampled along whole segments of a path (Kulla & Fajardo 2012).

A vertex of a path sees a point light at distance r with I / r^2, whose square has no finite mean around the light. The
remedy is to place a vertex on the segment itself with a density that is proportional to 1 / r^2, the equiangular one,
    p(t) = D / ((theta_b - theta_a) (D^2 + (t - t_l)^2)),   D: distance of the light from the ray, t_l: where it is nearest,
and to share the light between both kinds of vertices by the balance heuristic. Any share does that adds up to 1 at every
point; here the density of the path's own vertices is replaced by the local extinction sigma, which is known without chance.
"""

import math

from data_synth import phase
from data_synth.jit import jit
from data_synth.lights import POINT, column3
from data_synth.lookups import albedo_at, attribute, extinction, phase_at
from data_synth.rng import uniform
from data_synth.trackers import shadow_transmittance
from data_synth.vec import along, dot, extent, largest, mul, neg, scale, sub
from data_synth.world import RANDOM, visible


@jit
def point_lights(lights):
    """How many there are."""
    n = 0
    for k in range(lights.shape[0]):
        if lights[k, 0] == POINT:
            n += 1
    return n


@jit
def angles(ray, t0, t1, light):
    """(t of the point nearest to the light, D, theta at t0, theta at t1)."""
    to = sub(light, ray[0])
    near = dot(to, ray[1])
    off = sub(to, scale(near, ray[1]))
    D = max(math.sqrt(dot(off, off)), 1e-12 * (extent(to) + t1 - t0))
    return near, D, math.atan((t0 - near) / D), math.atan((t1 - near) / D)


@jit
def density(ray, t0, t1, light, t):
    """The equiangular density at t in 1/u."""
    near, D, a, b = angles(ray, t0, t1, light)
    return D / ((b - a) * (D * D + (t - near) * (t - near)))


@jit
def share(sigma, pdf, lights, points):
    """The part of a light that the path's own vertices see: they choose among all lights, the others among points."""
    own = sigma / lights
    return own / (own + pdf / points)


@jit
def in_segment(w, m, ray, t0, t1, inside, beta, rng):
    """Radiance at the ray's origin from one point light drawn at random, scattered once in [t0, t1] of medium m."""
    points, count = point_lights(w.lights), w.lights.shape[0]
    chosen, k = min(int(uniform(rng) * points), points - 1), -1
    for row in range(count):
        if w.lights[row, 0] == POINT:
            if chosen == 0:
                k = row
                break
            chosen -= 1
    light = column3(w.lights, k, 7)
    near, D, a, b = angles(ray, t0, t1, light)
    if not b > a:
        return (0.0, 0.0, 0.0)
    t = min(max(near + D * math.tan(a + uniform(rng) * (b - a)), t0), t1)
    pdf = density(ray, t0, t1, light, t)
    p, wo = along(ray, t), neg(ray[1])
    rho = extinction(m, p, ray[1])
    if rho <= 0.0:
        return (0.0, 0.0, 0.0)
    sigma = rho * largest(m.sigma_t)
    to = sub(light, p)
    r2 = dot(to, to)
    r = math.sqrt(r2)
    wi, at = scale(1.0 / r, to), attribute(m, p)
    f = phase.evaluate(phase_at(m, p), at, wo, wi, rng)
    value = (1.0 - share(sigma, pdf, count, points)) * points * rho * f / (pdf * r2)
    L = scale(value, mul(mul(m.sigma_t, albedo_at(m, p, at)), column3(w.lights, k, 4)))
    if largest(mul(beta, L)) <= 0.0:
        return (0.0, 0.0, 0.0)
    L = mul(L, shadow_transmittance(m, ray, t, True, rng))
    if largest(L) <= 0.0:
        return (0.0, 0.0, 0.0)
    return mul(L, visible(w, (p, wi), r, inside, RANDOM, rng))
