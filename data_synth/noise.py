"""Tileable noise textures for clouds [Horizon], PHYSICS 13: gradient noise, Worley noise and curl noise.

All are functions on the unit torus: they repeat with period 1 in every coordinate. ``cloud_textures`` computes the
three textures of the method once per seed and keeps them in the user's cache folder.
"""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_synth.files import replacing
from data_synth.jit import in_bands, jit, kernel
from data_synth.rng import mix
from data_synth.vec import trilinear


@jit
def hashed(i, j, k, seed):
    """64 random bits of a lattice point."""
    h = mix(np.uint64(i) + np.uint64(0x9E3779B97F4A7C15) * np.uint64(seed + 1))
    return mix(mix(h ^ np.uint64(j)) ^ (np.uint64(k) << np.uint64(20)))


@jit
def corner_gradient(i, j, k, x, y, z, seed):
    """Dot product of (x, y, z) with one of the twelve directions to the edges of a cube [Perlin 2002]."""
    h = hashed(i, j, k, seed) % np.uint64(12)
    a = x if h < np.uint64(8) else y
    b = y if h < np.uint64(4) else z
    return (a if h & np.uint64(1) else -a) + (b if h & np.uint64(2) else -b)


@jit
def fade(t):
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


@jit
def perlin(x, y, z, cells, seed):
    """Gradient noise of ``cells`` lattice cells per unit, in about [-1, 1]."""
    x, y, z = x * cells, y * cells, z * cells
    fi, fj, fk = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - fi, y - fj, z - fk
    i, j, k = int(fi) % cells, int(fj) % cells, int(fk) % cells
    total = 0.0
    for corner in range(8):
        a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
        weight = fade(u if a else 1.0 - u) * fade(v if b else 1.0 - v) * fade(w if c else 1.0 - w)
        total += weight * corner_gradient((i + a) % cells, (j + b) % cells, (k + c) % cells, u - a, v - b, w - c, seed)
    return total


@jit
def worley(x, y, z, cells, seed):
    """1 - distance to the nearest of one random point per cell, in cells, clipped to [0, 1]: billows [Worley 1996]."""
    x, y, z = x * cells, y * cells, z * cells
    i, j, k = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
    nearest = 3.0
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                h = hashed(a % cells, b % cells, c % cells, seed)
                px = a + (h & np.uint64(0x1FFFFF)) * (1.0 / 2097152.0) - x
                py = b + (h >> np.uint64(21) & np.uint64(0x1FFFFF)) * (1.0 / 2097152.0) - y
                pz = c + (h >> np.uint64(42) & np.uint64(0x1FFFFF)) * (1.0 / 2097152.0) - z
                nearest = min(nearest, px * px + py * py + pz * pz)
    return max(1.0 - math.sqrt(nearest), 0.0)


@jit
def fbm(x, y, z, cells, octaves, seed):
    """Octaves of gradient noise, amplitudes halving, mapped to about [0, 1]."""
    total, amplitude, norm = 0.0, 1.0, 0.0
    for _ in range(octaves):
        total += amplitude * perlin(x, y, z, cells, seed)
        norm += amplitude
        amplitude *= 0.5
        cells *= 2
    return min(max(0.5 + 0.75 * total / norm, 0.0), 1.0)


@jit
def billows(x, y, z, cells, seed):
    """Three octaves of Worley noise, weights 5 : 2 : 1, in [0, 1]."""
    return (
        0.625 * worley(x, y, z, cells, seed)
        + 0.25 * worley(x, y, z, 2 * cells, seed)
        + 0.125 * worley(x, y, z, 4 * cells, seed)
    )


@jit
def remap(v, low, high, new_low, new_high):
    """The line through (low, new_low) and (high, new_high), clipped to the new range."""
    t = min(max((v - low) / (high - low), 0.0), 1.0)
    return new_low + t * (new_high - new_low)


@kernel
def _fill_base(out, seed, first, last):
    n = out.shape[0]
    for i in range(first, last):
        for j in range(n):
            for k in range(n):
                x, y, z = i / n, j / n, k / n
                w = billows(x, y, z, 4, seed)
                out[i, j, k, 0] = remap(fbm(x, y, z, 4, 4, seed + 7), 0.0, 1.0, w, 1.0)  # Perlin dilated by Worley
                out[i, j, k, 1] = w
                out[i, j, k, 2] = billows(x, y, z, 8, seed)
                out[i, j, k, 3] = billows(x, y, z, 14, seed)


@kernel
def _fill_detail(out, seed, first, last):
    n = out.shape[0]
    for i in range(first, last):
        for j in range(n):
            for k in range(n):
                for c in range(3):
                    out[i, j, k, c] = billows(i / n, j / n, k / n, 2 << c, seed + 31)


def curl_texture(n: int, seed: int) -> np.ndarray:
    """(n, n, 2) divergence-free flow in [-1, 1]: the curl of a smooth random potential, exact on its Fourier modes."""
    rng = np.random.default_rng(seed)
    x = np.arange(n) / n
    flow = np.zeros((n, n, 2))
    for _ in range(24):
        kx, ky = rng.integers(-6, 7, size=2)
        phase = 2 * math.pi * (rng.random() + kx * x[:, None] + ky * x[None, :])
        amplitude = 1.0 / (1.0 + kx * kx + ky * ky)
        flow += amplitude * np.stack([-ky * np.sin(phase), kx * np.sin(phase)], axis=-1)
    return (flow / np.abs(flow).max()).astype(np.float32)


class CloudTextures(NamedTuple):
    """base: (n, n, n, 4) Perlin-Worley and three Worley channels; detail: (m, m, m, 3); curl: (p, p, 2)."""

    base: np.ndarray
    detail: np.ndarray
    curl: np.ndarray


def make_textures(seed: int = 0, base: int = 128, detail: int = 32, curl: int = 128) -> CloudTextures:
    """Compute the textures."""
    b = np.empty((base, base, base, 4), np.float32)
    d = np.empty((detail, detail, detail, 3), np.float32)
    in_bands(lambda first, last: _fill_base(b, seed, first, last), base, 4)
    in_bands(lambda first, last: _fill_detail(d, seed, first, last), detail, 4)
    return CloudTextures(b, d, curl_texture(curl, seed))


def cloud_textures(seed: int = 0, base: int = 128) -> CloudTextures:
    """The textures of ``make_textures`` from the cache folder ($XDG_CACHE_HOME or ~/.cache), computed on first use."""
    folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "data_synth"
    path = folder / f"clouds-1-{seed}-{base}.npz"
    if path.exists():
        # A damaged cache is made again: numpy and zlib raise whatever they like over one.
        with contextlib.suppress(Exception), np.load(path) as stored:
            return CloudTextures(stored["base"], stored["detail"], stored["curl"])
    textures = make_textures(seed, base)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            np.savez(temporary, **textures._asdict())
    except OSError:
        return textures  # a home that cannot be written costs the seconds again next time, nothing else
    return textures


@jit
def texture_at(t, x, y, z, c):
    """Channel c of a (n, n, n, channels) texture, trilinear on the unit torus."""
    n = t.shape[0]
    x, y, z = (x - math.floor(x)) * n, (y - math.floor(y)) * n, (z - math.floor(z)) * n
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    i, j, k = i % n, j % n, k % n
    a, b, d = (i + 1) % n, (j + 1) % n, (k + 1) % n
    near = (t[i, j, k, c], t[i, j, d, c], t[i, b, k, c], t[i, b, d, c])
    far = (t[a, j, k, c], t[a, j, d, c], t[a, b, k, c], t[a, b, d, c])
    return trilinear(near + far, u, v, w)
