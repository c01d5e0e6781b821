"""Volumetric path tracing (PHYSICS 10): an unbiased Monte Carlo solution of the radiative transfer equation.

Free flights by Woodcock tracking with local majorants; in coloured media one flight serves all colours by spectral
tracking (Kutz et al. 2017): at a tentative collision the path scatters with probability P_s and flies on with
P_n = 1 - P_s, both in proportion to the path's mean throughput, and is reweighted by sigma_s / (sigma_maj P_s) or
sigma_n / (sigma_maj P_n). Absorption is never drawn, it is a weight. In a grey medium of albedo 1 all weights are 1.
At each vertex one light is sampled (next-event estimation, ratio-tracked shadow rays), combined with the direction the
phase function or surface samples by the balance heuristic. Russian roulette ends weak paths.
"""

from typing import NamedTuple

from data_synth import materials, phase
from data_synth.cameras import pixel_ray
from data_synth.jit import jit, kernel
from data_synth.lights import column3, escaped, quad_pdf, sample_light
from data_synth.materials import DIELECTRIC, NULL
from data_synth.media import attribute, box_interval, extinction, lookup
from data_synth.rng import reseed, uniform
from data_synth.traverse import collisions, traversal
from data_synth.vec import add, along, dot, largest, mul, neg, scale, sub
from data_synth.world import inside_medium, next_surface, visible

ROULETTE_DEPTH = 6
SEGMENTS = 100_000  # only a guard: roulette and max_depth end paths long before


class Settings(NamedTuple):
    """spp paths per pixel of at most max_depth scatterings; jitter: anywhere in the pixel; seed of the picture."""

    spp: int
    max_depth: int
    jitter: bool
    opaque_sky: bool
    seed: int


@jit
def path_event(m, ray, t, width, state, rng):
    """Tentative collision; state = (beta rgb, L rgb, t of the scattering). width = 1 / sigma_maj."""
    beta, L = (state[0], state[1], state[2]), (state[3], state[4], state[5])
    p = along(ray, t)
    collide = scale(width * extinction(m, p, ray[1]), m.sigma_t)  # sigma_t / sigma_maj
    if largest(collide) <= 0.0:
        return state, False
    a = attribute(m, p)
    albedo, Le = lookup(m.albedo, a), lookup(m.Le, a)
    L = add(L, mul(beta, mul(mul(collide, sub((1.0, 1.0, 1.0), albedo)), Le)))
    scatter = mul(beta, mul(collide, albedo))
    fly = mul(beta, sub((1.0, 1.0, 1.0), collide))
    s, n = scatter[0] + scatter[1] + scatter[2], fly[0] + fly[1] + fly[2]
    if s + n <= 0.0:
        return (0.0, 0.0, 0.0, L[0], L[1], L[2], t), True
    if uniform(rng) * (s + n) < s:
        beta = scale((s + n) / s, scatter)
        return (beta[0], beta[1], beta[2], L[0], L[1], L[2], t), True
    beta = scale((s + n) / n, fly)
    return (beta[0], beta[1], beta[2], L[0], L[1], L[2], -1.0), False


fly_through = traversal(collisions(path_event))


@jit
def next_event(w, p, n, material, wo, inside, rng):
    """Radiance towards wo at p from one light drawn at random, weighted against the other way to find it.

    material < 0: p is in the medium, scattered by the phase function; else on a surface with normal n.
    """
    count = w.lights.shape[0]
    k = min(int(uniform(rng) * count), count - 1)
    wi, distance, radiance, pdf = sample_light(w.lights, k, p, rng)
    if material < 0:
        a = attribute(w.medium, p)
        value = phase.evaluate(w.medium.phase, a, wo, wi, rng)
        f = (value, value, value)
        pdf_other = value if w.medium.phase.kind != phase.SGGX_DIFFUSE else 0.0
    else:
        f = materials.evaluate(w.materials, material, p, n, wo, wi)
        pdf_other = materials.pdf(w.materials, material, n, wo, wi)
    contribution = mul(f, radiance)
    if largest(contribution) <= 0.0:
        return (0.0, 0.0, 0.0)
    contribution = mul(contribution, visible(w, (p, wi), distance * (1.0 - 1e-9), inside, True, rng))
    mis = pdf / (pdf + count * pdf_other) if pdf > 0.0 else 1.0
    return scale(count * mis, contribution)


@jit
def found_light(w, ray, t, quad, pdf_last):
    """Radiance of the sky or quad light that the sampled direction ran into, with the balance heuristic's weight.

    pdf_last: density of that direction; 0 if next-event estimation could not have found the light (camera, mirrors);
    negative if the density is not known, so that next-event estimation has the light to itself.
    """
    count = w.lights.shape[0]
    if pdf_last < 0.0:
        return (0.0, 0.0, 0.0)
    if quad >= 0:
        light, pdf = column3(w.lights, quad, 4), quad_pdf(w.lights, quad, ray, t)
    else:
        light, pdf = escaped(w.lights, ray[1]), 0.07957747154594767
    return scale(count * pdf_last / (count * pdf_last + pdf) if pdf_last > 0.0 else 1.0, light)


@jit
def trace_path(w, ray, settings, rng):
    """One path: (L rgb, alpha, distance of its first event)."""
    beta, L = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    inside, pdf_last, depth, base, far, alpha = inside_medium(w, ray), 0.0, 0, 0.0, -1.0, 1.0
    lit = w.lights.shape[0] > 0
    for _ in range(SEGMENTS):
        t, n, material, quad = next_surface(w, ray)
        scattered = False
        if inside:
            t0, t1 = box_interval(ray, w.medium.lo, w.medium.hi)
            state = (beta[0], beta[1], beta[2], L[0], L[1], L[2], -1.0)
            state, scattered = fly_through(w.medium, ray, t0, min(t, t1), True, state, rng)
            beta, L = (state[0], state[1], state[2]), (state[3], state[4], state[5])
            if scattered:
                t, material, quad = state[6], -1, -1
        if not scattered and (quad >= 0 or material < 0):
            first = depth == 0 and quad < 0 and not settings.opaque_sky
            if first:  # straight through: transparent
                alpha = 1.0 - (beta[0] + beta[1] + beta[2]) / 3.0
            elif lit:
                L = add(L, mul(beta, found_light(w, ray, t, quad, pdf_last)))
            break
        p, wo = along(ray, t), neg(ray[1])
        kind = w.materials.rows[material, 0] if material >= 0 else -1.0
        if far < 0.0 and kind < DIELECTRIC:
            far = base + t
        base += t
        if kind >= DIELECTRIC:
            wi, _, _, crossed = materials.sample(w.materials, material, p, n, wo, rng)
            if crossed and w.bounded:
                inside = dot(wi, n) < 0.0
            pdf_last = pdf_last if kind == NULL else 0.0
            ray = (p, wi)
            continue
        if depth >= settings.max_depth or largest(beta) <= 0.0:
            break
        if lit:
            L = add(L, mul(beta, next_event(w, p, n, material, wo, inside, rng)))
        if scattered:
            a = attribute(w.medium, p)
            wi = phase.sample(w.medium.phase, a, wo, rng)
            known = w.medium.phase.kind != phase.SGGX_DIFFUSE
            pdf_last = phase.evaluate(w.medium.phase, a, wo, wi, rng) if known else -1.0
        else:
            wi, weight, pdf_last, _ = materials.sample(w.materials, material, p, n, wo, rng)
            beta = mul(beta, weight)
        depth += 1
        if depth > ROULETTE_DEPTH:
            q = min(largest(beta), 0.98)
            if uniform(rng) >= q:
                break
            beta = scale(1.0 / q, beta)
        ray = (p, wi)
    return L, alpha, max(far, 0.0)


@kernel
def render_rows(w, camera, settings, rng, out, first, last):
    """Rows first..last - 1 of out (H, W, 8) = rgb, alpha, distance, variance of the mean rgb."""
    o = (camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3])
    n = settings.spp
    for j in range(first, last):
        for i in range(out.shape[1]):
            reseed(rng, settings.seed, j * out.shape[1] + i)
            r, g, b, rr, gg, bb, alpha, far = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for _ in range(n):
                x, y = (uniform(rng), uniform(rng)) if settings.jitter else (0.5, 0.5)
                L, a, t = trace_path(w, (o, pixel_ray(camera, i + x, j + y)), settings, rng)
                r, g, b, alpha, far = r + L[0], g + L[1], b + L[2], alpha + a, far + t
                rr, gg, bb = rr + L[0] * L[0], gg + L[1] * L[1], bb + L[2] * L[2]
            r, g, b = r / n, g / n, b / n
            out[j, i, 0], out[j, i, 1], out[j, i, 2], out[j, i, 3], out[j, i, 4] = r, g, b, alpha / n, far / n
            d = float(n) * max(n - 1, 1)
            out[j, i, 5] = max(rr - n * r * r, 0.0) / d
            out[j, i, 6] = max(gg - n * g * g, 0.0) / d
            out[j, i, 7] = max(bb - n * b * b, 0.0) / d
