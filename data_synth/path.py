"""Volumetric path tracing (PHYSICS 10): an unbiased Monte Carlo solution of the radiative transfer equation.

Free flights by Woodcock tracking with local majorants; in coloured media one flight serves all colours by spectral
tracking (Kutz et al. 2017): at a tentative collision the path scatters with probability P_s and flies on with
P_n = 1 - P_s, both in proportion to the path's mean throughput, and is reweighted by sigma_s / (sigma_maj P_s) or
sigma_n / (sigma_maj P_n). Absorption is never drawn, it is a weight. In a grey medium of albedo 1 all weights are 1.
At each vertex one light is sampled (next-event estimation, ratio-tracked shadow rays), combined with the direction the
phase function or surface samples by the balance heuristic. Russian roulette ends weak paths, and before their shadow ray
is walked those next events that would add little.

Alpha and distance belong to the straight ray from the camera. It ends where it is scattered, absorbed, stopped by a
surface or lamp, or bent by glass: the distance is the mean over these ends.
"""

from typing import NamedTuple

from data_synth import equiangular, materials, phase
from data_synth.cameras import pixel_ray
from data_synth.jit import jit, kernel
from data_synth.lights import POINT, column3, escaped, quad_pdf, quad_radiance, sample_light
from data_synth.lookups import Le_at, albedo_at, attribute, box_interval, extinction, phase_at
from data_synth.materials import DIELECTRIC
from data_synth.parts import BLOCK
from data_synth.path_glass import at_rough_glass, through_glass
from data_synth.rng import reseed, uniform
from data_synth.traverse import collisions, traversal
from data_synth.vec import add, along, largest, mean, mul, neg, scale, sub
from data_synth.world import RANDOM, inside_at, medium_of, next_surface, number_at, visible

ROULETTE_DEPTH = 6
LONG = 1000  # scatterings after which even a path that loses nothing is ended by chance
EVENT_ROULETTE = 0.1  # throughput times f (1/sr) below which next events are drawn by chance
SEGMENTS = 1_000_000  # only a guard: roulette ends paths long before
SKY_PDF = 0.07957747154594767  # 1 / 4 pi
UNKNOWN = -1.0


class Settings(NamedTuple):
    """spp paths per pixel of at most max_depth scatterings, of which this part has blocks first ... last - 1 (parts.py);
    jitter: anywhere in the pixel; seed of the picture."""

    spp: int
    max_depth: int
    jitter: bool
    opaque_sky: bool
    seed: int
    first: int
    last: int


class Flight(NamedTuple):
    """What a path carries through a medium. base: distance of the ray's origin from the camera; far: sum of absorbed
    weight times distance; t: where it scattered, -1 if nowhere."""

    beta: tuple[float, float, float]
    L: tuple[float, float, float]
    base: float
    far: float
    t: float


class Vertex(NamedTuple):
    """Where light is looked for. material < 0: a point in medium ``number``, reached along ``ray`` in [t0, t1] of it."""

    p: tuple[float, float, float]
    wo: tuple[float, float, float]
    n: tuple[float, float, float]
    material: int
    number: int
    ray: tuple[tuple[float, float, float], tuple[float, float, float]]
    t: float
    t0: float
    t1: float


@jit
def path_event(m, ray, t, width, state, rng):
    """Tentative collision. width = 1 / sigma_maj: every such point stands for 1 / sigma_maj of the ray, so that
    sum beta (sigma_a / sigma_maj) Le estimates the integral of T sigma_a Le, and so does the distance of absorption."""
    beta = state.beta
    p = along(ray, t)
    collide = scale(width * extinction(m, p, ray[1]), m.sigma_t)  # sigma_t / sigma_maj
    if largest(collide) <= 0.0:
        return state, False
    a = attribute(m, p)
    albedo = albedo_at(m, p, a)
    absorbed = mul(beta, mul(collide, sub((1.0, 1.0, 1.0), albedo)))
    L = add(state.L, mul(absorbed, Le_at(m, p, a)))
    base, far = state.base, state.far + mean(absorbed) * (state.base + t)
    scatter = mul(beta, mul(collide, albedo))
    fly = mul(beta, sub((1.0, 1.0, 1.0), collide))
    s, n = scatter[0] + scatter[1] + scatter[2], fly[0] + fly[1] + fly[2]
    if s + n <= 0.0:
        return Flight((0.0, 0.0, 0.0), L, base, far, t), True
    if uniform(rng) * (s + n) < s:
        return Flight(scale((s + n) / s, scatter), L, base, far, t), True
    return Flight(scale((s + n) / n, fly), L, base, far, -1.0), False


fly_through = traversal(collisions(path_event))


@jit
def next_event(w, v, inside, beta, rng):
    """beta times the radiance towards wo from one light drawn at random, weighted against the other ways to find it."""
    count = w.lights.shape[0]
    k = min(int(uniform(rng) * count), count - 1)
    wi, distance, radiance, pdf = sample_light(w.lights, k, v.p, rng)
    mis = float(count)
    if v.material < 0:
        m = medium_of(w, v.number)
        value = phase.evaluate(phase_at(m, v.p), attribute(m, v.p), v.wo, wi, rng)
        f = (value, value, value)
        pdf_other = value if phase.has_density(m.phase) else 0.0
        if w.lights[k, 0] == POINT:
            sigma = extinction(m, v.p, v.ray[1]) * largest(m.sigma_t)
            placed = equiangular.density(v.ray, v.t0, v.t1, column3(w.lights, k, 7), v.t)
            mis *= equiangular.share(sigma, placed, count, equiangular.point_lights(w.lights))
    else:
        f = materials.evaluate(w.materials, v.material, v.p, v.n, v.wo, wi)
        pdf_other = materials.pdf(w.materials, v.material, v.n, v.wo, wi)
    weight = mul(beta, f)
    contribution = mul(weight, radiance)
    if largest(contribution) <= 0.0:
        return (0.0, 0.0, 0.0)
    q = largest(weight) / EVENT_ROULETTE
    if q < 1.0:
        if uniform(rng) >= q:
            return (0.0, 0.0, 0.0)
        mis /= q
    if pdf > 0.0:
        mis *= pdf / (pdf + count * pdf_other)
    return scale(mis, mul(contribution, visible(w, (v.p, wi), distance * (1.0 - 1e-9), inside, RANDOM, rng)))


@jit
def found_light(w, ray, t, quad, pdf_last):
    """Radiance of the sky or quad light that the sampled direction ran into, with the balance heuristic's weight.

    t: distance of a quad from where the direction was sampled.
    pdf_last: density of that direction; 0 if next-event estimation could not have found the light (camera, mirrors);
    UNKNOWN if nobody knows the density, so that next-event estimation has the light to itself.
    """
    count = w.lights.shape[0]
    if pdf_last == UNKNOWN:
        return (0.0, 0.0, 0.0)
    if quad >= 0:
        light, pdf = quad_radiance(w.quads, quad, ray[1]), quad_pdf(w.quads, quad, ray, t)
    else:
        light, pdf = escaped(w.sky, ray[1]), SKY_PDF
    return scale(count * pdf_last / (count * pdf_last + pdf) if pdf_last > 0.0 else 1.0, light)


@jit
def survival(beta, depth):
    """Chance with which a path goes on after its depth-th scattering."""
    if depth <= ROULETTE_DEPTH:
        return 1.0
    return min(largest(beta), 1.0 if depth < LONG else 0.99)


@jit
def scatter_direction(w, v, rng):
    """(wi, weight, pdf, straight): a direction sampled by the phase function or surface at a vertex."""
    if v.material >= 0:
        return materials.sample(w.materials, v.material, v.p, v.n, v.wo, rng)
    m = medium_of(w, v.number)
    ph, a = phase_at(m, v.p), attribute(m, v.p)
    wi = phase.sample(ph, a, v.wo, rng)
    known = phase.has_density(ph)
    return wi, (1.0, 1.0, 1.0), phase.evaluate(ph, a, v.wo, wi, rng) if known else UNKNOWN, False


@jit
def trace_path(w, ray, inside, settings, rng):
    """One path: (L rgb, alpha, distance at which its straight part ends, premultiplied by alpha)."""
    beta, L = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    pdf_last, since, depth, base, far, alpha, straight = 0.0, 0.0, 0, 0.0, 0.0, 1.0, True
    lit, points = w.lights.shape[0] > 0, equiangular.point_lights(w.lights) > 0
    for _ in range(SEGMENTS):
        t, n, material, quad = next_surface(w, ray)
        scattered, t0, t1, number = False, 0.0, 0.0, number_at(w, inside)
        if number >= 0:
            m = medium_of(w, number)
            t0, t1 = box_interval(ray, m.lo, m.hi)
            t1 = min(t, t1)
            if t1 > t0:
                if points and depth < settings.max_depth:
                    L = add(L, mul(beta, equiangular.in_segment(w, m, ray, t0, t1, inside, beta, rng)))
                flight, scattered = fly_through(m, ray, t0, t1, True, Flight(beta, L, base, 0.0, -1.0), rng)
                beta, L = flight.beta, flight.L
                if straight:
                    far += flight.far
                if scattered:
                    t, material, quad = flight.t, -1, -1
        if not scattered and (quad >= 0 or material < 0):
            if straight and quad < 0 and not settings.opaque_sky:  # straight through: transparent
                alpha = 1.0 - mean(beta)
            else:
                L = add(L, mul(beta, found_light(w, ray, since + t, quad, pdf_last)))
            if straight and quad >= 0:
                far += mean(beta) * (base + t)
            break
        p, wo = along(ray, t), neg(ray[1])
        base, since = base + t, since + t
        if material >= 0 and w.materials.rows[material, 0] >= DIELECTRIC:
            if lit and w.materials.rows[material, 8] > 0.0 and largest(beta) > 0.0:
                L = add(L, at_rough_glass(w, Vertex(p, wo, n, material, number, ray, t, t0, t1), inside, beta, rng))
            wi, inside, weight, bent, pdf = through_glass(w, material, n, wo, inside, rng)
            if bent:
                if straight:
                    far += mean(beta) * base
                straight, pdf_last = False, pdf
                since = 0.0 if pdf > 0.0 else since
            beta = mul(beta, weight)
            if largest(beta) <= 0.0 and not straight:
                break
            ray = (p, wi)
            continue
        v = Vertex(p, wo, n, material, number, ray, t, t0, t1)
        on = depth < settings.max_depth and largest(beta) > 0.0
        if lit and on:
            L = add(L, next_event(w, v, inside, beta, rng))
        wi, weight, pdf, passed = scatter_direction(w, v, rng)
        if passed:  # a sheet whose flakes were missed: as if it were not there
            ray = (p, wi)
            continue
        if straight:
            far += mean(beta) * base
        straight, pdf_last, since = False, pdf, 0.0
        if not on:
            break
        beta = mul(beta, weight)
        depth += 1
        q = survival(beta, depth)
        if q < 1.0:
            if uniform(rng) >= q:
                break
            beta = scale(1.0 / q, beta)
        ray = (p, wi)
    return L, alpha, far


@jit
def add_top_two(stack, waiting):
    """Row waiting - 2 of ``stack`` becomes its sum with the row after it, which goes."""
    for c in range(stack.shape[1]):
        stack[waiting - 2, c] += stack[waiting - 1, c]
    return waiting - 1


@kernel
def render_rows(w, camera, settings, rng, stack, out, first, last):
    """Rows first..last - 1 of out (H, W, 8) = sums over this part's samples of rgb, alpha, distance and squares of rgb.

    stack (64, 8): where nodes of the tree of blocks (parts.py) wait for their right halves.
    """
    o = (camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3])
    inside, width, pixels = inside_at(w, o), out.shape[1], out.shape[0] * out.shape[1]
    for j in range(first, last):
        for i in range(width):
            waiting = 0
            for block in range(settings.first, settings.last):
                reseed(rng, settings.seed, block * pixels + j * width + i)
                r, g, b, rr, gg, bb, alpha, far = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for _ in range(min(BLOCK, settings.spp - block * BLOCK)):
                    x, y = (uniform(rng), uniform(rng)) if settings.jitter else (0.5, 0.5)
                    L, a, t = trace_path(w, (o, pixel_ray(camera, i + x, j + y)), inside, settings, rng)
                    r, g, b, alpha, far = r + L[0], g + L[1], b + L[2], alpha + a, far + t
                    rr, gg, bb = rr + L[0] * L[0], gg + L[1] * L[1], bb + L[2] * L[2]
                stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3] = r, g, b, alpha
                stack[waiting, 4], stack[waiting, 5], stack[waiting, 6], stack[waiting, 7] = far, rr, gg, bb
                waiting += 1
                done = block + 1 - settings.first
                while done % 2 == 0:
                    waiting, done = add_top_two(stack, waiting), done // 2
            while waiting > 1:
                waiting = add_top_two(stack, waiting)
            for c in range(8):
                out[j, i, c] = stack[0, c]
