"""Transmittance T(t0, t1) = exp(-integral of sigma_t) and the sampling of free flights (PHYSICS 10).

Each estimator is an event (and a stepper) for ``traverse``. States are (T_r, T_g, T_b, extra).

| name     | how                                              | error              |
|----------|--------------------------------------------------|--------------------|
| closed   | exp(-sigma_t length); exponential in closed form | none               |
| regular  | every grid cell, exactly                         | none               |
| march    | midpoint steps                                   | bias O(step^2)     |
| delta    | 1 if Woodcock tracking has no real collision     | unbiased, noisiest |
| ratio    | product of 1 - sigma_t/majorant                  | unbiased           |
| residual | exp(-minimum length) times ratio of the rest     | unbiased           |
"""

from __future__ import annotations

import math

from data_synth.jit import jit
from data_synth.lookups import box_interval, extinction
from data_synth.media import EXPONENTIAL, HOMOGENEOUS
from data_synth.phase import SGGX_SPECULAR
from data_synth.rng import uniform
from data_synth.traverse import cells, chord_thickness, collisions, steps, traversal
from data_synth.vec import along, exp_neg, largest, mul, scale, sub

CLOSED, REGULAR, MARCH, DELTA, RATIO, RESIDUAL = range(6)
SHADOW_ROULETTE = 0.2


@jit
def regular_event(m, ray, t, width, thickness, rng):
    return thickness + chord_thickness(m, ray, t, width), False


@jit
def march_event(m, ray, t, width, thickness, rng):
    return thickness + width * extinction(m, along(ray, t), ray[1]), False


@jit
def shadow_march_event(m, ray, t, width, thickness, rng):
    """As ``march_event`` until less than 1e-6 of the light is left in any colour."""
    thickness += width * extinction(m, along(ray, t), ray[1])
    return thickness, thickness * min(m.sigma_t[0], m.sigma_t[1], m.sigma_t[2]) > 14.0


@jit
def delta_event(m, ray, t, width, state, rng):
    """A real collision ends the colour's flight; one random number serves all three."""
    u = uniform(rng)
    s = scale(width * extinction(m, along(ray, t), ray[1]), m.sigma_t)
    r = 0.0 if u < s[0] else state[0]
    g = 0.0 if u < s[1] else state[1]
    b = 0.0 if u < s[2] else state[2]
    return (r, g, b, 0.0), r + g + b == 0.0


@jit
def ratio_event(m, ray, t, width, state, rng):
    """T *= chance of a null collision; state[3] is the control density that is accounted for elsewhere."""
    s = scale(width * (extinction(m, along(ray, t), ray[1]) - state[3]), m.sigma_t)
    T = mul((state[0], state[1], state[2]), sub((1.0, 1.0, 1.0), s))
    return (T[0], T[1], T[2], state[3]), largest(T) <= 0.0


@jit
def shadow_event(m, ray, t, width, state, rng):
    """Ratio tracking of a shadow ray, which Russian roulette ends below T = 0.2: such a ray is hardly worth its way."""
    state, stop = ratio_event(m, ray, t, width, state, rng)
    T = max(state[0], state[1], state[2])
    if stop or T >= SHADOW_ROULETTE:
        return state, stop
    if uniform(rng) * SHADOW_ROULETTE >= T:
        return (0.0, 0.0, 0.0, 0.0), True
    q = SHADOW_ROULETTE / T
    return (q * state[0], q * state[1], q * state[2], state[3]), False


@jit
def residual_collisions(m, ray, a, b, brick, carry, state, rng):
    """The smallest extinction of the brick is attenuation in closed form, only the rest is left to collisions."""
    if brick < 0:
        low, high = 0.0, m.max_density
    else:
        low, high = m.brick_min[brick], m.brick_max[brick]
    if m.phase.kind >= SGGX_SPECULAR:  # directional extinction: no lower bound is kept
        low = 0.0
    control = exp_neg(scale(low * (b - a), m.sigma_t))
    state = (state[0] * control[0], state[1] * control[1], state[2] * control[2], low)
    sigma_maj = (high * m.flake_area - low) * largest(m.sigma_t)
    if sigma_maj <= 0.0:
        return carry, state, False
    if carry < 0.0:
        carry = -math.log(1.0 - uniform(rng))
    t = a
    while True:
        room = (b - t) * sigma_maj
        if carry >= room:
            return carry - room, state, False
        t += carry / sigma_maj
        state, stop = ratio_event(m, ray, t, 1.0 / sigma_maj, state, rng)
        if stop:
            return -1.0, state, True
        carry = -math.log(1.0 - uniform(rng))


regular_thickness = traversal(cells(regular_event))
march_thickness = traversal(steps(march_event))
shadow_thickness = traversal(steps(shadow_march_event))
delta_tracking = traversal(collisions(delta_event))
ratio_tracking = traversal(collisions(ratio_event))
shadow_tracking = traversal(collisions(shadow_event))
residual_tracking = traversal(residual_collisions)


@jit
def transmittance(m, ray, t0, t1, method, local, rng):
    """RGB transmittance of [t0, t1] of a ray through medium m (one sample of it for the random estimators)."""
    start, end = box_interval(ray, m.lo, m.hi)
    t0, t1 = max(t0, start), min(t1, end)
    full = (1.0, 1.0, 1.0, 0.0)
    if t1 <= t0:
        return (1.0, 1.0, 1.0)
    if method == DELTA:
        s, _ = delta_tracking(m, ray, t0, t1, local, full, rng)
    elif method == RATIO:
        s, _ = ratio_tracking(m, ray, t0, t1, local, full, rng)
    elif method == RESIDUAL:
        s, _ = residual_tracking(m, ray, t0, t1, local, full, rng)
    else:
        return exp_neg(scale(thickness(m, ray, t0, t1, method, rng), m.sigma_t))
    return (s[0], s[1], s[2])


@jit
def shadow_transmittance(m, ray, t_max, random, rng):
    """What shadow rays use: the closed form where there is one, of flakes too, which are alike everywhere there; else ratio
    tracking with roulette, or marching."""
    t0, t1 = box_interval(ray, m.lo, m.hi)
    t1 = min(t1, t_max)
    if t1 <= t0:
        return (1.0, 1.0, 1.0)
    if m.kind == HOMOGENEOUS or m.kind == EXPONENTIAL:
        return exp_neg(scale(chord_thickness(m, ray, 0.5 * (t0 + t1), t1 - t0), m.sigma_t))
    if random:
        s, _ = shadow_tracking(m, ray, t0, t1, True, (1.0, 1.0, 1.0, 0.0), rng)
        return (s[0], s[1], s[2])
    return exp_neg(scale(shadow_thickness(m, ray, t0, t1, True, 0.0, rng)[0], m.sigma_t))


@jit
def thickness(m, ray, t0, t1, method, rng):
    """integral of rho over [t0, t1], which must lie inside the box, without chance: closed, regular or marched."""
    if method == CLOSED or m.kind == HOMOGENEOUS:
        return chord_thickness(m, ray, 0.5 * (t0 + t1), t1 - t0)
    if method == MARCH:
        return march_thickness(m, ray, t0, t1, True, 0.0, rng)[0]
    return regular_thickness(m, ray, t0, t1, True, 0.0, rng)[0]


@jit
def woodcock_event(m, ray, t, width, state, rng):
    """Stop at a real collision: chance sigma_t / majorant (delta tracking)."""
    real = uniform(rng) < width * extinction(m, along(ray, t), ray[1]) * largest(m.sigma_t)
    return (t, 0.0), real


@jit
def march_distance_event(m, ray, t, width, state, rng):
    """Biased: spend the optical depth state[1] step by step, as if the density were constant within a step."""
    tau = width * extinction(m, along(ray, t), ray[1]) * largest(m.sigma_t)
    if tau >= state[1]:
        return (t - 0.5 * width + width * state[1] / tau, 0.0), True
    return (state[0], state[1] - tau), False


@jit
def regular_distance_event(m, ray, t, width, state, rng):
    """Spend the optical depth state[1] cell by cell; inside the last cell bisect the exact integral."""
    sigma, left = largest(m.sigma_t), state[1]
    tau = sigma * chord_thickness(m, ray, t, width)
    if tau < left:
        return (state[0], left - tau), False
    start, low, high = t - 0.5 * width, 0.0, width
    for _ in range(50):
        mid = 0.5 * (low + high)
        if sigma * chord_thickness(m, ray, start + 0.5 * mid, mid) < left:
            low = mid
        else:
            high = mid
    return (start + 0.5 * (low + high), 0.0), True


woodcock_flight = traversal(collisions(woodcock_event))
march_flight = traversal(steps(march_distance_event))
regular_flight = traversal(cells(regular_distance_event))


@jit
def free_flight(m, ray, t0, t1, method, local, rng):
    """Distance of the first real collision in [t0, t1], inf if there is none. Coloured media: the densest colour."""
    start, end = box_interval(ray, m.lo, m.hi)
    t0, t1 = max(t0, start), min(t1, end)
    if t1 <= t0:
        return math.inf
    if method == DELTA:
        s, hit = woodcock_flight(m, ray, t0, t1, local, (0.0, 0.0), rng)
    else:
        budget = (0.0, -math.log(1.0 - uniform(rng)))
        if method == CLOSED:
            s, hit = (t0 + budget[1] / (extinction(m, along(ray, t0), ray[1]) * largest(m.sigma_t)), 0.0), True
            hit = s[0] < t1
        elif method == MARCH:
            s, hit = march_flight(m, ray, t0, t1, True, budget, rng)
        else:
            s, hit = regular_flight(m, ray, t0, t1, True, budget, rng)
    return s[0] if hit else math.inf
