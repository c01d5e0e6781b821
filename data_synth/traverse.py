"""One traversal of a medium, many estimators [MC-PM].

``traversal(stepper)`` makes a function that cuts a ray into the bricks it crosses, front to back, and skips the empty
ones. A *stepper* walks one such piece with known density bounds and calls an *event* at points on it:
    steps(event)       midpoints of equal steps                             width = the step
    lattice(event)     midpoints of steps counted from the ray's origin     width = the step
    cells(event)       each grid cell once                                  width = the chord of the cell
    collisions(event)  tentative collisions of a majorant (Woodcock 1965)   width = 1 / majorant
An event is ``event(m, ray, t, width, state, context) -> (state, stop)``, with the state a number or tuple that it
folds over and the context anything it reads: the random stream for ``collisions``. In all of them sigma_t width is the
optical thickness (or chance of a real collision) that the point stands for. ``carry`` is what a stepper keeps from one
piece to the next, -1 at first: for ``collisions`` the optical thickness that is left to the next tentative collision.
Composing functions at import, as in ``traversal(cells(event))``, lets the compiler inline everything.
"""

import math
from collections.abc import Callable

from data_synth.jit import jit
from data_synth.lookups import extinction
from data_synth.media import EXPONENTIAL, GRID
from data_synth.rng import uniform
from data_synth.vec import along, largest


def traversal(stepper: Callable) -> Callable:
    """A function that folds over [t0, t1]; with local = False the box is one brick with the global bounds."""

    @jit
    def walk(m, ray, t0, t1, local, state, context):
        if t1 <= t0:
            return state, False
        o, d = ray
        p = along(ray, t0)
        nx, ny, nz = m.bricks
        sx, sy, sz = (m.hi[0] - m.lo[0]) / nx, (m.hi[1] - m.lo[1]) / ny, (m.hi[2] - m.lo[2]) / nz
        if m.kind == GRID:
            sx, sy, sz = 8.0 * m.cell[0], 8.0 * m.cell[1], 8.0 * m.cell[2]
        i = min(max(int((p[0] - m.lo[0]) / sx), 0), nx - 1)
        j = min(max(int((p[1] - m.lo[1]) / sy), 0), ny - 1)
        k = min(max(int((p[2] - m.lo[2]) / sz), 0), nz - 1)
        tx, di = first_crossing(o[0] - m.lo[0], d[0], i, sx)
        ty, dj = first_crossing(o[1] - m.lo[1], d[1], j, sy)
        tz, dk = first_crossing(o[2] - m.lo[2], d[2], k, sz)
        a, carry = t0, -1.0
        while True:
            b = min(tx, ty, tz, t1) if local else t1
            index = (i * ny + j) * nz + k if local else -1
            if b > a and (not local or m.brick_max[index] > 0.0):
                carry, state, stop = stepper(m, ray, a, b, index, carry, state, context)
                if stop:
                    return state, True
            if b >= t1:
                return state, False
            a = max(a, b)
            if tx <= ty and tx <= tz:
                i += di
                tx += sx / abs(d[0])
            elif ty <= tz:
                j += dj
                ty += sy / abs(d[1])
            else:
                k += dk
                tz += sz / abs(d[2])
            if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
                return state, False

    return walk


@jit
def first_crossing(o, d, i, size):
    """(t, step) of the first plane a ray crosses when it leaves slab i of thickness ``size``."""
    if d > 0.0:
        return ((i + 1) * size - o) / d, 1
    if d < 0.0:
        return (i * size - o) / d, -1
    return math.inf, 0


def steps(event: Callable) -> Callable:
    """Midpoints of the fewest equal steps that are not longer than m.step."""

    @jit
    def stepper(m, ray, a, b, brick, carry, state, context):
        n = max(int(math.ceil((b - a) / m.step - 1e-9)), 1)
        width = (b - a) / n
        for k in range(n):
            state, stop = event(m, ray, a + (k + 0.5) * width, width, state, context)
            if stop:
                return carry, state, True
        return carry, state, False

    return stepper


def lattice(event: Callable) -> Callable:
    """Midpoints of steps m.step long, counted from t = 0 whatever the bricks are: those that reach into a piece, each once.

    The first and the last of them may stick out of [t0, t1].
    """

    @jit
    def stepper(m, ray, a, b, brick, carry, state, context):
        k = max(carry, math.floor(a / m.step))
        while k * m.step < b:
            state, stop = event(m, ray, (k + 0.5) * m.step, m.step, state, context)
            k += 1.0
            if stop:
                return k, state, True
        return k, state, False

    return stepper


def cells(event: Callable) -> Callable:
    """Each cell's chord; the event gets the chord's midpoint. Media without a grid are one cell per brick."""

    @jit
    def stepper(m, ray, a, b, brick, carry, state, context):
        o, d = ray
        while a < b:
            end = b
            if m.kind == GRID:
                for axis in range(3):
                    if d[axis] != 0.0:
                        u = (o[axis] + a * d[axis] - m.lo[axis]) / m.cell[axis]
                        edge = math.floor(u + 1e-9) + 1.0 if d[axis] > 0.0 else math.ceil(u - 1e-9) - 1.0
                        end = min(end, (m.lo[axis] + edge * m.cell[axis] - o[axis]) / d[axis])
            if end <= a:
                end = b
            state, stop = event(m, ray, 0.5 * (a + end), end - a, state, context)
            if stop:
                return carry, state, True
            a = end
        return carry, state, False

    return stepper


def collisions(event: Callable) -> Callable:
    """Tentative collisions at the rate of the majorant: the largest extinction of the brick in any colour.

    One exponential serves all the bricks up to a collision: what a brick leaves of it is carried into the next.
    """

    @jit
    def stepper(m, ray, a, b, brick, carry, state, rng):
        rho = m.max_density if brick < 0 else m.brick_max[brick]
        sigma_maj = rho * m.flake_area * largest(m.sigma_t)
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
            state, stop = event(m, ray, t, 1.0 / sigma_maj, state, rng)
            if stop:
                return -1.0, state, True
            carry = -math.log(1.0 - uniform(rng))

    return stepper


@jit
def chord_thickness(m, ray, t, width):
    """integral of rho over [t - width/2, t + width/2] inside one cell, exactly.

    Along a ray a trilinear function is a cubic polynomial, and two Gauss-Legendre points integrate cubics exactly.
    """
    h = 0.28867513459481287 * width if m.kind == GRID else 0.0
    shape = 1.0
    if m.kind == EXPONENTIAL:  # mean of exp over the chord, relative to its midpoint
        x = 0.5 * ray[1][2] * m.falloff * width
        shape = math.sinh(x) / x if abs(x) > 1e-5 else 1.0 + x * x / 6.0
    total = 0.0
    for _ in range(2):
        total += extinction(m, along(ray, t + h), ray[1])
        h = -h
    return 0.5 * width * shape * total
