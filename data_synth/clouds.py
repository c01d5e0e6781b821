"""Cloud densities after [Horizon] (Schneider & Vos 2015), PHYSICS 13.

base   = remap(Perlin-Worley, low-frequency Worley - 1 -> 1, 0 -> 1), its contrast stretched, x height gradient
shaped = remap(base, 1 - coverage(x, y) -> 1, 0 -> 1) x coverage
final  = remap(shaped, detail x edge -> 1, 0 -> 1): the detail erodes the edges, wispy below and billowy above,
and the detail is looked up at a place that curl noise has distorted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from data_synth.errors import InputError
from data_synth.jit import in_bands, jit, kernel
from data_synth.noise import CloudTextures, cloud_textures, remap, texture_at

STRATUS, CUMULUS, CUMULONIMBUS = range(3)
TYPES = {"stratus": STRATUS, "cumulus": CUMULUS, "cumulonimbus": CUMULONIMBUS}


@jit
def height_gradient(kind, h):
    """How much cloud of a type there can be at relative height h in [0, 1]: 0 at both ends, 1 in its body."""
    if kind == STRATUS:
        return remap(h, 0.02, 0.20, 0.0, 1.0) * remap(h, 0.30, 0.75, 1.0, 0.0)
    if kind == CUMULUS:
        return remap(h, 0.0, 0.14, 0.0, 1.0) * remap(h, 0.35, 1.0, 1.0, 0.0)
    return remap(h, 0.0, 0.08, 0.0, 1.0) * remap(h, 0.80, 1.0, 1.0, 0.0)


@jit
def footprint(kind, x, y, h, coverage):
    """Coverage in [0, 1] over the unit square: a heap in the middle, for the tallest type with an anvil on top."""
    r = math.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2)
    if kind == STRATUS:
        edge = min(x, y, 1.0 - x, 1.0 - y)
        return coverage * remap(edge, 0.0, 0.12, 0.0, 1.0)
    reach = 0.52 - 0.10 * h
    if kind == CUMULONIMBUS:
        reach = 0.34 + 0.05 * math.sin(9.0 * h) + 0.26 * remap(h, 0.66, 0.86, 0.0, 1.0)
    return coverage * remap(r, 0.15 * reach, reach, 1.0, 0.0)


@jit
def cloud_density(t, kind, coverage, frequency, erosion, x, y, z):
    """Cloud fraction in [0, 1] at a point of the unit cube."""
    gradient = height_gradient(kind, z)
    cover = footprint(kind, x, y, z, coverage)
    if gradient <= 0.0 or cover <= 0.0:
        return 0.0
    f = frequency
    low = (
        0.625 * texture_at(t.base, f * x, f * y, f * z, 1)
        + 0.25 * texture_at(t.base, f * x, f * y, f * z, 2)
        + 0.125 * texture_at(t.base, f * x, f * y, f * z, 3)
    )
    base = remap(texture_at(t.base, f * x, f * y, f * z, 0), low - 1.0, 1.0, 0.0, 1.0)
    base = remap(base, 0.52, 0.92, 0.0, 1.0) * gradient
    shaped = remap(base, 1.0 - cover, 1.3 - cover, 0.0, 1.0)
    if shaped <= 0.0:
        return 0.0
    n = t.curl.shape[0]
    i, j = int(4.0 * x * n) % n, int(4.0 * y * n) % n
    sx, sy = 0.02 * (1.0 - z) * t.curl[i, j, 0], 0.02 * (1.0 - z) * t.curl[i, j, 1]
    g = 5.0 * f
    detail = (
        0.625 * texture_at(t.detail, g * (x + sx), g * (y + sy), g * z, 0)
        + 0.25 * texture_at(t.detail, g * (x + sx), g * (y + sy), g * z, 1)
        + 0.125 * texture_at(t.detail, g * (x + sx), g * (y + sy), g * z, 2)
    )
    upward = min(8.0 * z, 1.0)
    edge = detail * (1.0 - upward) + (1.0 - detail) * upward
    return remap(shaped, erosion * edge, 1.0, 0.0, 1.0)


@kernel
def _fill(t, kind, coverage, frequency, erosion, out, first, last):
    nx, ny, nz = out.shape
    for i in range(first, last):
        for j in range(ny):
            for k in range(nz):
                x, y, z = i / (nx - 1), j / (ny - 1), k / (nz - 1)
                out[i, j, k] = cloud_density(t, kind, coverage, frequency, erosion, x, y, z)


def cloud(
    kind: str, shape: Sequence[int], coverage: float = 0.8, frequency: float = 1.0, erosion: float = 0.3, seed: int = 0,
    textures: CloudTextures | None = None,
) -> np.ndarray:  # fmt: skip
    """(nx, ny, nz) float32 cloud fraction in [0, 1]. kind: stratus, cumulus or cumulonimbus; coverage in [0, 1]."""
    if kind not in TYPES:
        raise InputError(f"cloud: type must be one of {', '.join(TYPES)}, got '{kind}'")
    if not 0 <= coverage <= 1:
        raise InputError(f"cloud: coverage must be in [0, 1], got {coverage}")
    out = np.empty(tuple(shape), np.float32)
    t = textures or cloud_textures(seed)
    in_bands(lambda a, b: _fill(t, TYPES[kind], coverage, frequency, erosion, out, a, b), out.shape[0], 4)
    return out
