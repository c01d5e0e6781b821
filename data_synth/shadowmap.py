"""Deep shadow maps [DSM, Tessendorf], PHYSICS 8: grids of RGB transmittance to each light, read trilinearly.

A map covers the medium's box at a resolution of its own and stays valid for every camera. Surfaces count: behind one
the transmittance is 0, which is what makes shafts of light. Three ways to fill it:
    sweep   directional lights: the grid is turned so that one axis points at the light; each sample takes the
            transmittance of its neighbour nearer to the light times that of the one cell in between
    eager   every sample marches to the light
    lazy    samples are NaN until a lookup first needs them
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth import lights as lamps
from data_synth.errors import InputError
from data_synth.jit import in_bands, jit, kernel, plain
from data_synth.lights import DIRECTIONAL, sample_light
from data_synth.rng import new_rng
from data_synth.vec import frame, trilinear
from data_synth.world import MARCHED, World, has_boundaries, inside_at, visible


class ShadowMaps(NamedTuple):
    """Maps of all lights. to_grid: (lights, 3, 4) world to sample numbers; to_world: its inverse; shape: (lights, 3)
    samples; first: (lights,) where a map starts in ``values`` float32 (3 numbers per sample, or 1 if grey)."""

    to_grid: np.ndarray
    to_world: np.ndarray
    shape: np.ndarray
    first: np.ndarray
    values: np.ndarray
    channels: int


def none() -> ShadowMaps:
    """No maps, for integrators that march to the lights."""
    empty = np.zeros((0, 3, 4))
    return ShadowMaps(empty, empty, np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32), 1)


def build(w: World, resolution: int, fill: str = "sweep") -> ShadowMaps:
    """Maps for every beam of ``w`` with ``resolution`` samples along the longest side; fill as in the module's text.

    Point lights, and media inside boundary surfaces, are filled eagerly when asked to be swept.
    """
    if fill not in ("sweep", "eager", "lazy"):
        raise InputError(f"shadow map: fill must be sweep, eager or lazy, got '{fill}'")
    if resolution < 2:
        raise InputError(f"shadow map: resolution must be at least 2, got {resolution}")
    frames = [_frame(w, k, resolution, turned=fill == "sweep") for k in range(len(w.lights))]
    shape = np.array([f[1] for f in frames], np.int64).reshape(-1, 3)
    m = w.medium
    grey = m.sigma_t[0] == m.sigma_t[1] == m.sigma_t[2]
    channels = 1 if grey else 3
    sizes = shape.prod(axis=1) * channels
    to_world = np.array([f[0] for f in frames]).reshape(-1, 3, 4)
    to_grid = np.zeros_like(to_world)
    for k, a in enumerate(to_world):
        inverse = np.linalg.inv(a[:, :3])
        to_grid[k] = np.concatenate([inverse, -inverse @ a[:, 3:]], axis=1)
    values = np.full(int(sizes.sum()), np.nan, np.float32)
    maps = ShadowMaps(to_grid, to_world, shape, np.concatenate([[0], np.cumsum(sizes)[:-1]]), values, channels)
    if fill != "lazy":
        for k in range(len(w.lights)):
            swept = fill == "sweep" and w.lights[k, 0] == DIRECTIONAL and not has_boundaries(w)
            in_bands(lambda a, b, k=k, swept=swept: _fill(maps, w, k, swept, new_rng(0, 0), a, b), int(shape[k, 0]), 2)
    return maps


def _frame(w: World, k: int, resolution: int, turned: bool) -> tuple[np.ndarray, list[int]]:
    """(3, 4) sample number to world, and the number of samples, of a grid that covers the medium's box."""
    lo, hi = np.array(w.medium.lo), np.array(w.medium.hi)
    axes = np.eye(3)
    if turned and w.lights[k, 0] == DIRECTIONAL:
        d = tuple(w.lights[k, 7:10])
        axes = np.array([*plain(frame)(d), d])
    corners = np.array([[(lo, hi)[b >> a & 1][a] for a in range(3)] for b in range(8)]) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    spacing = (high - low).max() / (resolution - 1)
    shape = [max(int(math.ceil((b - a) / spacing - 1e-9)) + 1, 2) for a, b in zip(low, high, strict=True)]
    edge = (high - low) / (np.array(shape) - 1)
    return np.concatenate([axes.T * edge, (axes.T @ low)[:, None]], axis=1), shape


@jit
def apply(a, p):
    """Affine map: (3, 4) array a times (p, 1)."""
    return (
        a[0, 0] * p[0] + a[0, 1] * p[1] + a[0, 2] * p[2] + a[0, 3],
        a[1, 0] * p[0] + a[1, 1] * p[1] + a[1, 2] * p[2] + a[1, 3],
        a[2, 0] * p[0] + a[2, 1] * p[1] + a[2, 2] * p[2] + a[2, 3],
    )


@jit
def store(maps, at, value):
    for c in range(maps.channels):
        maps.values[at + c] = value[c]


@jit
def towards_light(maps, w, k, i, j, h, rng):
    """Transmittance from sample (i, j, h) of map k all the way to its light."""
    p = apply(maps.to_world[k], (float(i), float(j), float(h)))
    wi, r, _, _ = sample_light(w.lights, k, p, rng)
    return visible(w, (p, wi), r * (1.0 - 1e-9), inside_at(w, p), MARCHED, rng)


@kernel
def _fill(maps, w, k, swept, rng, first, last):
    """Samples with first number first..last - 1 of map k. rng: marching draws nothing from it."""
    n, a = maps.shape[k], maps.to_world[k]
    cell = math.sqrt(a[0, 2] ** 2 + a[1, 2] ** 2 + a[2, 2] ** 2)
    for i in range(first, last):
        for j in range(n[1]):
            through = (1.0, 1.0, 1.0)
            for back in range(n[2]):
                h = n[2] - 1 - back
                if swept and back > 0:
                    p = apply(a, (float(i), float(j), float(h)))
                    step = visible(w, (p, lamps.column3(w.lights, k, 7)), cell, 0, MARCHED, rng)
                    through = (through[0] * step[0], through[1] * step[1], through[2] * step[2])
                else:
                    through = towards_light(maps, w, k, i, j, h, rng)
                store(maps, maps.first[k] + ((i * n[1] + j) * n[2] + h) * maps.channels, through)


@jit
def blend(v, at, stride_i, stride_j, stride_h, fu, fv, fw):
    """Trilinear mixture of eight stored numbers; NaN as long as any of them is missing."""
    e, f = at + stride_i, at + stride_j
    g = e + stride_j
    near = (v[at], v[at + stride_h], v[f], v[f + stride_h])
    return trilinear(near + (v[e], v[e + stride_h], v[g], v[g + stride_h]), fu, fv, fw)  # noqa: RUF005


@jit
def fill_corners(maps, w, k, i, j, h, rng):
    """Compute the samples that a lazy map still lacks around a lookup."""
    n = maps.shape
    for corner in range(8):
        a, b, c = i + (corner >> 2), j + (corner >> 1 & 1), h + (corner & 1)
        at = maps.first[k] + ((a * n[k, 1] + b) * n[k, 2] + c) * maps.channels
        if maps.values[at] != maps.values[at]:
            store(maps, at, towards_light(maps, w, k, a, b, c, rng))


@jit
def look_up(maps, w, k, p, rng):
    """RGB transmittance from p to light k: trilinear, clamped to the map's box."""
    n, a = maps.shape, maps.to_grid
    x = a[k, 0, 0] * p[0] + a[k, 0, 1] * p[1] + a[k, 0, 2] * p[2] + a[k, 0, 3]
    y = a[k, 1, 0] * p[0] + a[k, 1, 1] * p[1] + a[k, 1, 2] * p[2] + a[k, 1, 3]
    z = a[k, 2, 0] * p[0] + a[k, 2, 1] * p[1] + a[k, 2, 2] * p[2] + a[k, 2, 3]
    i = min(max(int(x), 0), n[k, 0] - 2)
    j = min(max(int(y), 0), n[k, 1] - 2)
    h = min(max(int(z), 0), n[k, 2] - 2)
    fu, fv, fw = min(max(x - i, 0.0), 1.0), min(max(y - j, 0.0), 1.0), min(max(z - h, 0.0), 1.0)
    stride = maps.channels
    sj = n[k, 2] * stride
    si = n[k, 1] * sj
    at = maps.first[k] + i * si + j * sj + h * stride
    red = blend(maps.values, at, si, sj, stride, fu, fv, fw)
    if red != red:
        fill_corners(maps, w, k, i, j, h, rng)
        red = blend(maps.values, at, si, sj, stride, fu, fv, fw)
    if stride == 1:
        return (red, red, red)
    green = blend(maps.values, at + 1, si, sj, stride, fu, fv, fw)
    return (red, green, blend(maps.values, at + 2, si, sj, stride, fu, fv, fw))
