"""All light gathered at the samples of a density grid: a deep shadow map per beam, summed once per view (PHYSICS 7, 8).

What a point x radiates towards wo is
    J(x, wo) = (1 - albedo) Le + albedo sum_k f_p(wo, w_k) L_k T_k(x).
T_k(x), the transmittance to the distant light k, does not depend on the camera: it is swept once per scene and light
(``sweep.py``) to the density's own samples. Seen from an eye outside the medium wo hardly changes from one sample to
the next, so that once per view all of J is put down there next to rho, and a marching step costs one trilinear look-up,
however many beams there are.

An approximation: J is linear between samples. Its error falls with the square of the cell, at a shadow's edge with the
cell. Not gathered are coloured extinction, microflakes, a grid of g, detail below the grid, media that fill boundary
surfaces, and lights at a finite distance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth import media, sweep
from data_synth import phase as phases
from data_synth.cameras import picture_rows
from data_synth.fields import at_sample, cell_of
from data_synth.jit import in_bands, in_parallel, jit, kernel
from data_synth.lights import DIRECTIONAL, column3
from data_synth.lookups import box_interval, lookup
from data_synth.media import BRICK, GRID, SIDE, Medium, triple
from data_synth.rng import new_rng
from data_synth.traverse import steps, traversal
from data_synth.vec import add, along, mul, sub, unit
from data_synth.volumes import is_large
from data_synth.world import SURFACES, World, has_boundaries, has_surfaces, visible

OPAQUE = 1e-4  # a ray whose transmittance falls below this stops: at most this fraction of the radiance is lost
SAMPLES = SIDE**3  # of a brick
NEAR = 4.0  # cells: an eye nearer to the medium sees wo turn from sample to sample


class Gathered(NamedTuple):
    """What all views share. corner: (bricks, 3) first sample of every stored brick; T: (beams, samples) float32."""

    corner: np.ndarray
    T: np.ndarray


def possible(w: World) -> bool:
    """Whether the light in this world may be gathered."""
    m = w.medium
    grey = m.sigma_t[0] == m.sigma_t[1] == m.sigma_t[2]
    distant = bool(np.all(w.lights[:, 0] == DIRECTIONAL))
    one_phase = m.phase.kind < phases.SGGX_SPECULAR and m.columns.g < 0
    samples = m.kind == GRID and m.detail.octaves == 0 and not is_large(m)
    return samples and grey and distant and one_phase and not has_boundaries(w)


def outside(m: Medium, eye: np.ndarray) -> bool:
    """Whether an eye is far enough from the medium."""
    near = NEAR * np.array(m.cell)
    return bool(np.any(eye < np.array(m.lo) - near) or np.any(eye > np.array(m.hi) + near))


def gather(w: World) -> Gathered:
    """The transmittance from the stored samples of the medium to all beams."""
    m = w.medium
    rho, kept = media.dense(m), np.flatnonzero(m.offsets >= 0)
    brick = np.unravel_index(kept, m.bricks)
    corner = np.array(m.lo) + BRICK * np.stack(brick, axis=1) * np.array(m.cell)
    padding = [(0, BRICK * n + 1 - size) for n, size in zip(m.bricks, rho.shape, strict=True)]
    T = np.empty((len(w.lights), len(kept) * SAMPLES), np.float32)

    def light(k: int) -> None:
        swept = np.pad(sweep.thickness(rho, m.cell, tuple(w.lights[k, 7:10])), padding, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(swept, (SIDE,) * 3)[::BRICK, ::BRICK, ::BRICK]
        np.exp(np.float32(-m.sigma_t[0]) * windows[brick].ravel(), out=T[k])
        if has_surfaces(w):
            _block(w, corner, k, new_rng(0, 0), T)

    in_parallel(light, [(k,) for k in range(len(w.lights))])
    return Gathered(corner, T)


def towards(w: World, gathered: Gathered, eye: np.ndarray) -> np.ndarray:
    """(4 samples,) float32: rho and the three colours of J towards the eye, sample by sample."""
    rho_J = np.empty(4 * len(gathered.corner) * SAMPLES, np.float32)
    position = triple(eye)

    def bricks(first: int, last: int) -> None:
        _sum_beams(w, gathered, position, np.empty((7, SAMPLES), np.float32), rho_J, first, last)

    in_bands(bricks, len(gathered.corner), 32)
    return rho_J


@jit
def sample_point(m, corner, b, s):
    """Where sample s of stored brick b is."""
    i, j, k = s // (SIDE * SIDE), s // SIDE % SIDE, s % SIDE
    return (corner[b, 0] + i * m.cell[0], corner[b, 1] + j * m.cell[1], corner[b, 2] + k * m.cell[2])


@kernel
def _block(w, corner, k, rng, T):
    """Surfaces and lamps keep light k from the samples behind them. rng: nothing is drawn from it."""
    towards_light = column3(w.lights, k, 7)
    for b in range(corner.shape[0]):
        for s in range(SAMPLES):
            p = sample_point(w.medium, corner, b, s)
            T[k, b * SAMPLES + s] *= visible(w, (p, towards_light), math.inf, 0, SURFACES, rng)[0]


@jit
def add_beam(phase, wi, L, T, x, y, z, f, red, green, blue):
    """Add f_p L T of one beam to the colours of a brick's samples, seen towards (x, y, z); f: room for f_p T.

    Short plain loops over rows of numbers, which the compiler turns into vector instructions.
    """
    for s in range(SAMPLES):
        f[s] = -(x[s] * wi[0] + y[s] * wi[1] + z[s] * wi[2])
    for s in range(SAMPLES):
        f[s] = phases.of_cosine(phase, f[s]) * T[s]
    for s in range(SAMPLES):
        red[s] += L[0] * f[s]
        green[s] += L[1] * f[s]
        blue[s] += L[2] * f[s]


@kernel
def _sum_beams(w, gathered, eye, row, rho_J, first, last):
    """Bricks first..last - 1 of rho_J. row: room for wo, f_p and three colours of a brick's samples."""
    m, corner, T = w.medium, gathered.corner, gathered.T
    for b in range(first, last):
        at = b * SAMPLES
        for s in range(SAMPLES):
            row[0, s], row[1, s], row[2, s] = unit(sub(eye, sample_point(m, corner, b, s)))
            row[4, s], row[5, s], row[6, s] = 0.0, 0.0, 0.0
        for k in range(T.shape[0]):
            wi, L = column3(w.lights, k, 7), column3(w.lights, k, 4)
            part = T[k, at : at + SAMPLES]
            add_beam(m.phase, wi, L, part, row[0], row[1], row[2], row[3], row[4], row[5], row[6])
        for s in range(SAMPLES):
            a = m.attributes[at + s] if m.attributes.size > 1 else 0.0
            c = m.columns
            albedo = at_sample(m, c.albedo, c.albedo_step, at + s) if c.albedo >= 0 else lookup(m.albedo, a)
            Le = at_sample(m, c.Le, c.Le_step, at + s) if c.Le >= 0 else lookup(m.Le, a)
            emitted = mul(sub((1.0, 1.0, 1.0), albedo), Le)
            J = add(emitted, mul(albedo, (row[4, s], row[5, s], row[6, s])))
            rho_J[4 * (at + s)] = m.samples[at + s]
            for c in range(3):
                rho_J[4 * (at + s) + 1 + c] = J[c]


@jit
def four(v, a):
    """Numbers a..a + 3. Unsigned, because indices that may be negative are checked each time."""
    return (v[a], v[a + np.uintp(1)], v[a + np.uintp(2)], v[a + np.uintp(3)])


@jit
def mix(f, a, b):
    return (a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2]), a[3] + f * (b[3] - a[3]))


@jit
def four_mixed(v, a, fu, fv, fw):
    """The numbers of the eight samples around a cell, mixed."""
    z, y, x = np.uintp(4), np.uintp(4 * SIDE), np.uintp(4 * SIDE * SIDE)
    b = a + x
    low = mix(fv, mix(fw, four(v, a), four(v, a + z)), mix(fw, four(v, a + y), four(v, a + y + z)))
    high = mix(fv, mix(fw, four(v, b), four(v, b + z)), mix(fw, four(v, b + y), four(v, b + y + z)))
    return mix(fu, low, high)


@jit
def look_up(m, numbers, p):
    """(rho, J rgb) at a point of a stored brick, given in cells: ``lookups.interpolated`` of four numbers at a time."""
    a, u, v, w = cell_of(m, p)
    return four_mixed(numbers, np.uintp(4 * a), np.float32(u), np.float32(v), np.float32(w))


class Clear(NamedTuple):
    """What a ray has met so far in a grey medium: radiance, transmittance, and the sum of weight times distance."""

    L: tuple[float, float, float]
    T: float
    far: float


@jit
def gathered_event(m, ray, t, width, state, context):
    """One marching step."""
    rho_J, ray_in_cells, base = context
    x = look_up(m, rho_J, along(ray_in_cells, t))
    if x[0] <= 0.0:
        return state, False
    T = state.T * math.exp(-x[0] * width * m.sigma_t[0])
    weight = state.T - T
    L = (state.L[0] + weight * x[1], state.L[1] + weight * x[2], state.L[2] + weight * x[3])
    return Clear(L, T, state.far + weight * (base + t)), T < OPAQUE


_march = traversal(steps(gathered_event))


@jit
def in_cells(m, ray):
    """A ray as it is seen from the lowest corner of the medium, with its cells for units; t stays what it was."""
    o, d, cell = sub(ray[0], m.lo), ray[1], m.cell
    return (o[0] / cell[0], o[1] / cell[1], o[2] / cell[2]), (d[0] / cell[0], d[1] / cell[1], d[2] / cell[2])


@jit
def march_gathered(m, rho_J, ray, t0, t1, base, state):
    """Fold [t0, t1] of a ray through the medium into a state (``Clear``)."""
    return _march(m, ray, t0, t1, True, state, (rho_J, in_cells(m, ray), base))[0]


@jit
def _seen(ray, context):
    m, rho_J = context
    t0, t1 = box_interval(ray, m.lo, m.hi)
    x = march_gathered(m, rho_J, ray, t0, t1, 0.0, Clear((0.0, 0.0, 0.0), 1.0, 0.0))
    return x.L, 1.0 - x.T, x.far


_rows = picture_rows(_seen)


@kernel
def render_rows(m, rho_J, camera, side, out, first, last):
    """Rows first..last - 1 of out (H, W, 5) = rgb, alpha, distance of a medium that stands alone."""
    _rows((m, rho_J), camera, side, out, first, last)
