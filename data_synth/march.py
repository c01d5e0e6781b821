"""The simple volume integrator: ray-marched single scattering (PHYSICS 7, 9), and the cloud preview (PHYSICS 13).

Along a ray through the medium, per step with optical thickness dtau at its midpoint x,
    L += T (1 - e^-dtau) J(x),   T *= e^-dtau,
    J  = (1 - albedo) Le + albedo sum_lights f_p(wo, wi) L_i(x) T_light(x),
up to the next surface, which adds T times its directly lit radiance. Lights are beams (points and directions). T_light
comes from marching to the light, from a deep shadow map, or from the preview's guess; or all of J has been gathered at
the samples of the density (``gather.py``).
"""

import math
from typing import NamedTuple

import numpy as np

from data_synth import materials, phase
from data_synth.cameras import pixel_ray
from data_synth.gather import OPAQUE, march_gathered
from data_synth.jit import jit, kernel
from data_synth.lights import escaped, sample_light
from data_synth.materials import DIELECTRIC, NULL, SPONGECAKE
from data_synth.media import attribute, box_interval, extinction, lookup
from data_synth.rng import reseed
from data_synth.shadowmap import ShadowMaps, look_up
from data_synth.spongecake import attenuation
from data_synth.traverse import steps, traversal
from data_synth.vec import add, along, dot, largest, mul, neg, scale, sub
from data_synth.world import blocked, inside_medium, next_surface, visible

MARCHED, MAPPED, PREVIEW, UNLIT, GATHERED = range(5)


class Lighting(NamedTuple):
    """Where light in the medium comes from: a mode above, and what it reads. rho_J: of ``gather.towards``."""

    mode: int
    maps: ShadowMaps
    rho_J: np.ndarray


@jit
def light_at(w, maps, mode, k, p, wi, distance, inside, rng):
    """T_light: RGB transmittance from p inside the medium to light k."""
    if mode == MAPPED:
        return look_up(maps, w, k, p, rng)
    return visible(w, (p, wi), distance, inside, False, rng)


@jit
def preview_source(w, p, wi, wo, a, rng):
    """[Horizon] an approximation, not a solution: energy = 2 e^-d f_HG powder, powder = 1 - e^-2d, and a soft floor.

    d is the optical depth of six samples towards the sun, spread over a third of the medium's height.
    """
    m = w.medium
    reach = (m.hi[2] - m.lo[2]) / 3.0
    d, t = 0.0, 0.0
    for k in range(6):
        width = reach * (k + 1.0) / 21.0
        q = along((p, wi), t + 0.5 * width)
        t += width
        inside = m.lo[0] <= q[0] <= m.hi[0] and m.lo[1] <= q[1] <= m.hi[1] and m.lo[2] <= q[2] <= m.hi[2]
        if inside:
            d += width * extinction(m, q, wi) * m.sigma_t[1]
    beer = max(math.exp(-d), 0.7 * math.exp(-0.25 * d))
    powder = 1.0 - math.exp(-2.0 * d - 0.5)
    return 2.0 * beer * powder * phase.evaluate(m.phase, a, wo, wi, rng)


@jit
def scatter_event(m, ray, t, width, state, context):
    """One marching step; state = (L rgb, T rgb, sum of weight times distance)."""
    w, maps, mode, inside, base, rng = context
    p, wo = along(ray, t), neg(ray[1])
    rho = extinction(m, p, ray[1])
    if rho <= 0.0:
        return state, False
    L, T = (state[0], state[1], state[2]), (state[3], state[4], state[5])
    a = attribute(m, p)
    albedo, Le = lookup(m.albedo, a), lookup(m.Le, a)
    scattered = (0.0, 0.0, 0.0)
    if mode != UNLIT and largest(albedo) > 0.0:
        for k in range(w.lights.shape[0]):
            wi, distance, radiance, _ = sample_light(w.lights, k, p, rng)
            if mode == PREVIEW:
                scattered = add(scattered, scale(preview_source(w, p, wi, wo, a, rng), radiance))
            else:
                shadow = light_at(w, maps, mode, k, p, wi, distance, inside, rng)
                if largest(shadow) > 0.0:
                    f = phase.evaluate(m.phase, a, wo, wi, rng)
                    scattered = add(scattered, mul(scale(f, radiance), shadow))
    J = add(mul(sub((1.0, 1.0, 1.0), albedo), Le), mul(albedo, scattered))
    s = scale(-rho * width, m.sigma_t)
    weight = mul(T, (-math.expm1(s[0]), -math.expm1(s[1]), -math.expm1(s[2])))
    L, T = add(L, mul(weight, J)), sub(T, weight)
    far = state[6] + (weight[0] + weight[1] + weight[2]) / 3.0 * (base + t)
    return (L[0], L[1], L[2], T[0], T[1], T[2], far), largest(T) < OPAQUE


march_medium = traversal(steps(scatter_event))


@jit
def lit_surface(w, maps, mode, p, n, material, wo, inside, rng):
    """Radiance towards wo from a surface point that all lights reach straight, through the medium."""
    m, total = w.medium, (0.0, 0.0, 0.0)
    for k in range(w.lights.shape[0]):
        wi, distance, radiance, _ = sample_light(w.lights, k, p, rng)
        f = materials.evaluate(w.materials, material, p, n, wo, wi)
        if largest(f) <= 0.0:
            continue
        t0, t1 = box_interval((p, wi), m.lo, m.hi)
        mapped = mode == MAPPED or mode == GATHERED
        if mapped and 0.0 < t0 and not w.bounded:  # the point lies outside the medium: look up where it enters
            shadow = (1.0, 1.0, 1.0)
            if blocked(w, (p, wi), distance):
                shadow = (0.0, 0.0, 0.0)
            elif t0 < min(t1, distance):
                shadow = look_up(maps, w, k, along((p, wi), t0), rng)
        else:
            # leaving through the other side of a boundary surface changes the medium
            shadow = visible(w, (p, wi), distance, inside, False, rng)
        total = add(total, mul(mul(f, radiance), shadow))
    return total


@jit
def march_ray(w, lighting, ray, inside, rng):
    """(L rgb, T rgb, distance sum) of a ray up to its end, single scattering only."""
    state, base = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0), 0.0
    mode, maps = lighting.mode, lighting.maps
    for _ in range(64):
        t, n, material, quad = next_surface(w, ray)
        if inside:
            t0, t1 = box_interval(ray, w.medium.lo, w.medium.hi)
            if mode == GATHERED:  # a grey medium, behind grey surfaces at most
                s = (state[0], state[1], state[2], state[3], state[6])
                s = march_gathered(w.medium, lighting.rho_J, ray, t0, min(t, t1), base, s)
                state = (s[0], s[1], s[2], s[3], s[3], s[3], s[4])
            else:
                context = (w, maps, mode, inside, base, rng)
                state, _ = march_medium(w.medium, ray, t0, min(t, t1), True, state, context)
            if max(state[3], state[4], state[5]) < OPAQUE:
                break
        if material < 0:
            break
        L, T, far = (state[0], state[1], state[2]), (state[3], state[4], state[5]), state[6]
        p, wo = along(ray, t), neg(ray[1])
        kind = w.materials.rows[material, 0]
        d = ray[1]
        if kind == NULL:
            inside = dot(d, n) < 0.0 if w.bounded else inside
        elif kind == DIELECTRIC:
            d, inside = bend(n, wo, w.materials.rows[material, 10], inside)
            mode = MAPPED if mode == GATHERED else mode  # the eye is no longer where the ray comes from
        else:
            if mode != UNLIT:
                L = add(L, mul(T, lit_surface(w, maps, mode, p, n, material, wo, inside, rng)))
            row = w.materials.rows[material]
            kept = 0.0
            if kind == SPONGECAKE:
                kept = attenuation(w.materials.layers, int(row[11]), int(row[12]), materials.to_local(n, wo))
            far += (T[0] + T[1] + T[2]) / 3.0 * (1.0 - kept) * (base + t)
            T = scale(kept, T)
        state = (L[0], L[1], L[2], T[0], T[1], T[2], far)
        if largest(T) < OPAQUE:
            break
        ray, base = (p, d), base + t
    return state, ray[1]


@jit
def bend(n, wo, ior, inside):
    """(direction, inside) behind a clear boundary: refracted, or mirrored where nothing refracts."""
    cosine = dot(n, wo)
    eta = 1.0 / ior if cosine > 0.0 else ior
    s2 = eta * eta * (1.0 - cosine * cosine)
    if s2 >= 1.0:
        return sub(scale(2.0 * cosine, n), wo), inside
    side = 1.0 if cosine > 0.0 else -1.0
    d = sub(scale(eta * abs(cosine) - math.sqrt(1.0 - s2), scale(side, n)), scale(eta, wo))
    return scale(1.0 / math.sqrt(dot(d, d)), d), cosine > 0.0


@kernel
def render_rows(w, backdrop, lighting, camera, side, opaque_sky, rng, out, first, last):
    """Rows first..last - 1 of out (H, W, 5) = rgb, alpha, distance; side x side rays per pixel on a regular grid.

    backdrop: the light table whose sky is seen behind everything if opaque_sky.
    """
    o = (camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3])
    for j in range(first, last):
        for i in range(out.shape[1]):
            reseed(rng, 1, j * out.shape[1] + i)
            r, g, b, alpha, far = 0.0, 0.0, 0.0, 0.0, 0.0
            for s in range(side * side):
                ray = (o, pixel_ray(camera, i + (s % side + 0.5) / side, j + (s // side + 0.5) / side))
                state, d = march_ray(w, lighting, ray, inside_medium(w, ray), rng)
                T = (state[3], state[4], state[5])
                seen = mul(T, escaped(backdrop, d)) if opaque_sky else (0.0, 0.0, 0.0)
                r, g, b = r + state[0] + seen[0], g + state[1] + seen[1], b + state[2] + seen[2]
                alpha += 1.0 if opaque_sky else 1.0 - (T[0] + T[1] + T[2]) / 3.0
                far += state[6]
            scale_by = 1.0 / (side * side)
            out[j, i, 0], out[j, i, 1], out[j, i, 2] = r * scale_by, g * scale_by, b * scale_by
            out[j, i, 3], out[j, i, 4] = alpha * scale_by, far * scale_by
