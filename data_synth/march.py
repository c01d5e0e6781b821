"""The simple volume integrator: ray-marched single scattering (PHYSICS 7, 9), and the cloud preview (PHYSICS 13).

Along a ray through a medium, per step with optical thickness dtau at its midpoint x,
    L += T (1 - e^-dtau) J(x),   T *= e^-dtau,
    J  = (1 - albedo) Le + albedo sum_lights f_p(wo, wi) L_i(x) T_light(x),
up to the next surface, which adds T times its directly lit radiance. Lights are beams (points, spots and directions).
T_light comes from marching to the light, from a deep shadow map, or from the preview's guess; or all of J has been
gathered at the samples of the density (``gather.py``).

Glass refracts the ray. Where light enters it, the part F that is mirrored shows the sky and 1 - F goes on; where it leaves
it all of it goes on unless none can. Alpha and distance belong to the straight ray, which ends there.
"""

import math
from typing import NamedTuple

import numpy as np

from data_synth import materials, phase
from data_synth.cameras import pixel_ray
from data_synth.gather import OPAQUE, Clear, march_gathered
from data_synth.jit import jit, kernel
from data_synth.lights import escaped, quad_radiance, sample_light
from data_synth.lookups import Le_at, albedo_at, attribute, box_interval, extinction, phase_at
from data_synth.materials import DIELECTRIC, NULL, SPONGECAKE
from data_synth.rng import reseed
from data_synth.shadowmap import ShadowMaps, look_up
from data_synth.spongecake import attenuation
from data_synth.traverse import steps, traversal
from data_synth.vec import add, along, dot, largest, mean, mul, neg, scale, sub
from data_synth.world import (
    MARCHED,
    SURFACES,
    crossing,
    index_at,
    inside_at,
    medium_of,
    next_surface,
    number_at,
    visible,
)  # fmt: skip

BY_RAYS, MAPPED, PREVIEW, UNLIT, GATHERED = range(5)
NEAR = 1.0 - 1e-9  # of the distance to a light, so that a lamp is not in the way of its own light


class Lighting(NamedTuple):
    """Where light in the medium comes from: a mode above, and what it reads. rho_J: of ``gather.towards``. rain, soft: of the
    preview."""

    mode: int
    maps: ShadowMaps
    rho_J: np.ndarray
    rain: float = 1.0
    soft: bool = False


class Seen(NamedTuple):
    """What a ray has met so far: radiance, transmittance, and the sum of weight times distance."""

    L: tuple[float, float, float]
    T: tuple[float, float, float]
    far: float


class Step(NamedTuple):
    """What a marching step reads. number: of the medium; inside: as in ``world.py``; base: distance of the ray's origin."""

    lighting: Lighting
    number: int
    inside: int
    base: float


@jit
def preview_energy(d, r, soft):
    """[Horizon] 2 e^-(d r) powder, powder = 1 - e^-2d: what the look of a cloud makes of the optical depth d towards the sun.

    soft: e^-(d r) is at least 0.7 e^-(d r / 4), and powder is 1 - e^-(2d + 1/2), so that rim and depth do not go black.
    """
    if soft:
        return 2.0 * max(math.exp(-d * r), 0.7 * math.exp(-0.25 * d * r)) * (1.0 - math.exp(-2.0 * d - 0.5))
    return 2.0 * math.exp(-d * r) * (1.0 - math.exp(-2.0 * d))


@jit
def preview_source(m, p, wi, wo, a, lighting, rng):
    """An approximation, not a solution: ``preview_energy`` times f_HG; r grows with the attribute, a cloud's precipitation.

    d is the optical depth of six samples towards the sun, spread over a third of the medium's height.
    """
    reach = (m.hi[2] - m.lo[2]) / 3.0
    d, t = 0.0, 0.0
    for k in range(6):
        width = reach * (k + 1.0) / 21.0
        q = along((p, wi), t + 0.5 * width)
        t += width
        inside = m.lo[0] <= q[0] <= m.hi[0] and m.lo[1] <= q[1] <= m.hi[1] and m.lo[2] <= q[2] <= m.hi[2]
        if inside:
            d += width * extinction(m, q, wi) * m.sigma_t[1]
    r = 1.0 + (lighting.rain - 1.0) * a
    return preview_energy(d, r, lighting.soft) * phase.evaluate(phase_at(m, p), a, wo, wi, rng)


@jit
def scattered_light(w, m, p, wo, a, step, rng):
    """sum over lights of f_p L_i T_light at a point of medium m."""
    total, mode, f_p = (0.0, 0.0, 0.0), step.lighting.mode, phase_at(m, p)
    for k in range(w.lights.shape[0]):
        wi, distance, radiance, _ = sample_light(w.lights, k, p, rng)
        if largest(radiance) <= 0.0:
            continue
        if mode == PREVIEW:
            total = add(total, scale(preview_source(m, p, wi, wo, a, step.lighting, rng), radiance))
            continue
        if mode == MAPPED and step.number == 0:
            shadow = look_up(step.lighting.maps, w, k, p, rng)
        else:
            shadow = visible(w, (p, wi), distance * NEAR, step.inside, MARCHED, rng)
        if largest(shadow) > 0.0:
            total = add(total, mul(scale(phase.evaluate(f_p, a, wo, wi, rng), radiance), shadow))
    return total


@jit
def scatter_event(m, ray, t, width, state, context):
    """One marching step."""
    w, step, rng = context
    p, wo = along(ray, t), neg(ray[1])
    rho = extinction(m, p, ray[1])
    if rho <= 0.0:
        return state, False
    a = attribute(m, p)
    albedo, Le = albedo_at(m, p, a), Le_at(m, p, a)
    scattered = (0.0, 0.0, 0.0)
    if step.lighting.mode != UNLIT and largest(albedo) > 0.0:
        scattered = scattered_light(w, m, p, wo, a, step, rng)
    J = add(mul(sub((1.0, 1.0, 1.0), albedo), Le), mul(albedo, scattered))
    s = scale(-rho * width, m.sigma_t)
    weight = mul(state.T, (-math.expm1(s[0]), -math.expm1(s[1]), -math.expm1(s[2])))
    T = sub(state.T, weight)
    return Seen(add(state.L, mul(weight, J)), T, state.far + mean(weight) * (step.base + t)), largest(T) < OPAQUE


march_medium = traversal(steps(scatter_event))


@jit
def lit_surface(w, lighting, p, n, material, wo, inside, rng):
    """Radiance towards wo from a surface point that all lights reach straight, through the media."""
    m, total = w.medium, (0.0, 0.0, 0.0)
    for k in range(w.lights.shape[0]):
        wi, distance, radiance, _ = sample_light(w.lights, k, p, rng)
        f = mul(materials.evaluate(w.materials, material, p, n, wo, wi), radiance)
        if largest(f) <= 0.0:
            continue
        t0, t1 = box_interval((p, wi), m.lo, m.hi)
        mapped = lighting.mode == MAPPED or lighting.mode == GATHERED
        if mapped and t0 > 0.0 and inside == 0 and w.ambient == 0:  # outside the box: look up where the light enters
            shadow = visible(w, (p, wi), distance * NEAR, inside, SURFACES, rng)
            if t0 < min(t1, distance):
                shadow = mul(shadow, look_up(lighting.maps, w, k, along((p, wi), t0), rng))
        else:
            shadow = visible(w, (p, wi), distance * NEAR, inside, MARCHED, rng)
        total = add(total, mul(f, shadow))
    return total


@jit
def enter_glass(w, material, n, wo, inside):
    """(direction, ``inside`` behind, mirrored fraction, whether it was bent) at a dielectric boundary."""
    behind = crossing(w.materials.rows[material], inside, dot(wo, n) > 0.0)
    here, there = index_at(w, inside), index_at(w, behind)
    if here == there:
        return neg(wo), behind, 0.0, False
    d, reflectance = materials.refracted(n, wo, here / there)
    if reflectance >= 1.0:
        return d, inside, 0.0, True
    return d, behind, reflectance if there > here else 0.0, True


@jit
def march_ray(w, lighting, ray, inside, opaque_sky, rng):
    """(L rgb, alpha, distance sum) of a ray up to its end, single scattering only."""
    seen, base, straight, alpha = Seen((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0), 0.0, True, 1.0
    for _ in range(64):
        t, n, material, quad = next_surface(w, ray)
        number = number_at(w, inside)
        if number >= 0:
            m, far = medium_of(w, number), seen.far
            t0, t1 = box_interval(ray, m.lo, m.hi)
            if lighting.mode == GATHERED:  # a grey medium, behind grey surfaces at most
                s = march_gathered(m, lighting.rho_J, ray, t0, min(t, t1), base, Clear(seen.L, seen.T[0], seen.far))
                seen = Seen(s.L, (s.T, s.T, s.T), s.far)
            else:
                context = (w, Step(lighting, number, inside, base), rng)
                seen, _ = march_medium(m, ray, t0, min(t, t1), True, seen, context)
            if not straight:
                seen = Seen(seen.L, seen.T, far)
            if largest(seen.T) < OPAQUE:
                break
        if quad >= 0:
            far = mean(seen.T) * (base + t) if straight else 0.0
            L = add(seen.L, mul(seen.T, quad_radiance(w.quads, quad, ray[1])))
            seen = Seen(L, (0.0, 0.0, 0.0), seen.far + far)
        if material < 0:
            break
        p, wo, d = along(ray, t), neg(ray[1]), ray[1]
        L, T, far = seen.L, seen.T, seen.far
        row = w.materials.rows[material]
        if row[0] == NULL:
            inside = crossing(row, inside, dot(d, n) < 0.0)
        elif row[0] == DIELECTRIC:
            d, behind, reflectance, bent = enter_glass(w, material, n, wo, inside)
            mirrored, inside = dot(d, n) * dot(wo, n) > 0.0, behind  # all of it, inside
            if bent:
                far += mean(T) * (base + t) if straight else 0.0
                L = add(L, mul(scale(reflectance, T), escaped(w.sky, materials.mirrored(n, wo))))
                T, straight = scale(1.0 - reflectance, T), False
            if not mirrored:
                T = mul(T, materials.tint_of(row))
        else:
            if lighting.mode != UNLIT:
                L = add(L, mul(T, lit_surface(w, lighting, p, n, material, wo, inside, rng)))
            kept = 0.0
            if row[0] == SPONGECAKE:
                kept = attenuation(w.materials.layers, int(row[11]), int(row[12]), materials.to_local(n, wo))
            far += (1.0 - kept) * mean(T) * (base + t) if straight else 0.0
            T = scale(kept, T)
        seen = Seen(L, T, far)
        if largest(T) < OPAQUE:
            break
        ray, base = (p, d), base + t
    if straight and not opaque_sky:
        return seen.L, 1.0 - mean(seen.T), seen.far
    return add(seen.L, mul(seen.T, escaped(w.sky, ray[1]))), alpha, seen.far


@kernel
def render_rows(w, lighting, camera, side, opaque_sky, rng, out, first, last):
    """Rows first..last - 1 of out (H, W, 5) = rgb, alpha, distance; side x side rays per pixel on a regular grid."""
    o = (camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3])
    inside, share = inside_at(w, o), 1.0 / (side * side)
    for j in range(first, last):
        for i in range(out.shape[1]):
            reseed(rng, 1, j * out.shape[1] + i)
            r, g, b, alpha, far = 0.0, 0.0, 0.0, 0.0, 0.0
            for s in range(side * side):
                ray = (o, pixel_ray(camera, i + (s % side + 0.5) / side, j + (s // side + 0.5) / side))
                L, a, t = march_ray(w, lighting, ray, inside, opaque_sky, rng)
                r, g, b, alpha, far = r + L[0], g + L[1], b + L[2], alpha + a, far + t
            out[j, i, 0], out[j, i, 1], out[j, i, 2] = r * share, g * share, b * share
            out[j, i, 3], out[j, i, 4] = alpha * share, far * share
