"""Cloud densities after [Horizon] (Schneider & Vos 2015), PHYSICS 13.

base   = remap(Perlin-Worley, low-frequency Worley - 1 -> 1, 0 -> 1), its contrast stretched, x height gradient
shape  = remap(base, 1 - coverage -> 1 - coverage + width, 0 -> 1)
final  = the shape eroded by finer noise (``detail.py``): once, at the samples of a grid, or wherever a ray asks for it

Coverage and type come from a single cloud's footprint, or over a landscape from a weather map (``weather.py``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from data_synth import detail as details
from data_synth.detail import Detail, eroded
from data_synth.errors import InputError
from data_synth.jit import in_bands, jit, kernel
from data_synth.noise import CloudTextures, cloud_textures, remap, texture_at

STRATUS, CUMULUS, CUMULONIMBUS = range(3)
RIM = 0.3  # width of a cloud's rim
DETAIL_TILES = 5.0  # of the detail noise for one of the base noise
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
def shape_at(t, gradient, cover, width, x, y, z):
    """The cloud's shape in [0, 1]; x, y, z in tiles of the base noise. width: of the rim, in the base noise."""
    if gradient <= 0.0 or cover <= 0.0:
        return 0.0
    low = (
        0.625 * texture_at(t.base, x, y, z, 1)
        + 0.25 * texture_at(t.base, x, y, z, 2)
        + 0.125 * texture_at(t.base, x, y, z, 3)
    )
    base = remap(texture_at(t.base, x, y, z, 0), low - 1.0, 1.0, 0.0, 1.0)
    base = remap(base, 0.52, 0.92, 0.0, 1.0) * gradient
    return remap(base, 1.0 - cover, 1.0 + width - cover, 0.0, 1.0)


@kernel
def _fill(t, detail, kind, coverage, frequency, out, first, last):
    nx, ny, nz = out.shape
    for i in range(first, last):
        for j in range(ny):
            for k in range(nz):
                x, y, z = i / (nx - 1), j / (ny - 1), k / (nz - 1)
                gradient, cover = height_gradient(kind, z), footprint(kind, x, y, z, coverage)
                shape = shape_at(t, gradient, cover, RIM, frequency * x, frequency * y, frequency * z)
                out[i, j, k] = eroded(detail, shape, x, y, z)


def cloud(
    kind: str, shape: Sequence[int], coverage: float = 0.8, frequency: float = 1.0, erosion: float = 0.3, seed: int = 0,
    textures: CloudTextures | None = None,
) -> np.ndarray:  # fmt: skip
    """(nx, ny, nz) float32 cloud fraction in [0, 1]. kind: stratus, cumulus or cumulonimbus; coverage in [0, 1].

    erosion: by detail noise, in [0, 1); 0 leaves the bare shape, for a medium that erodes it on a ray's way (``detail_of``).
    """
    if kind not in TYPES:
        raise InputError(f"cloud: type must be one of {', '.join(TYPES)}, got '{kind}'")
    if not 0 <= coverage <= 1:
        raise InputError(f"cloud: coverage must be in [0, 1], got {coverage}")
    out = np.empty(tuple(shape), np.float32)
    t = textures or cloud_textures(seed)
    d = detail_of(t, frequency, erosion)
    in_bands(lambda a, b: _fill(t, d, TYPES[kind], coverage, frequency, out, a, b), out.shape[0], 4)
    return out


def detail_of(textures: CloudTextures, frequency: float = 1.0, erosion: float = 0.3, octaves: int = 1) -> Detail:
    """The detail of :func:`cloud`, to be evaluated on the way: ``media.grid(cloud(..., erosion=0), ..., detail=...)``."""
    return details.detail(textures, (DETAIL_TILES * frequency,) * 3, erosion, octaves)
