"""Detail of clouds below the voxel [Horizon], PHYSICS 13: noise erodes a coarse density at the point where it is asked for.

A grid holds the cloud's shape s(x) in [0, 1]; what a ray meets is
    rho(x) = min(c remap(s(x), e n(x) -> 1, 0 -> 1), 1) = min(c max(s - e n, 0) / (1 - e n), 1)
with the erosion e < 1, the contrast c >= 1 and the noise n(x) in [0, 1]: tiled Worley noise, looked up where curl noise has
pushed it, turned upside down from the wispy base to the billowy top. For 0 <= s <= 1
    min(c (s - e) / (1 - e), 1) <= rho <= min(c s, 1),
so that the bounds of a brick of the coarse grid give majorants of the eroded density too, with the lower one eroded.

How far noise moves the cloud's surface is e over the slope of s: a shape that rises slowly from its rim to its middle is
carved deeply, and the contrast makes of what is left a body with a crisp rim (noise first, threshold afterwards, as clouds of
real-time graphics do [Schneider 2015, 2017]). A shape that is 1 just behind its rim is hardly changed.

Octave k repeats the noise 4^k times as often with weight 0.4^k; all weights add to 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.checks import vector
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.noise import CloudTextures, remap, texture_at
from data_synth.vec import bilinear

CURL_TILES = 4.0  # of the curl noise along the box
CURL_SHIFT = 0.02  # of the box's side: how far it pushes, at most, at the base; the top stands still
FINER, WEAKER = 4.0, 0.4


class Detail(NamedTuple):
    """values: float32, (n, n, n) noise and (p, p, 2) curl noise, in one array, since every array makes every kernel that is
    handed a medium slower to compile; tiles: of the noise along each side of the medium's box."""

    values: np.ndarray
    n: int
    p: int
    tiles: tuple[float, float, float]
    erosion: float
    octaves: int
    contrast: float


NONE = Detail(np.zeros(3, np.float32), 1, 1, (1.0, 1.0, 1.0), 0.0, 0, 1.0)


def detail(textures: CloudTextures, tiles: object, erosion: float, octaves: int = 1, contrast: float = 1.0) -> Detail:
    """Detail of three Worley channels, weights 5 : 2 : 1. tiles: along x, y and z of the box; erosion in [0, 1)."""
    if not 1 <= contrast < math.inf:
        raise InputError(f"cloud: contrast must be from 1 on, got {contrast}")
    if not 0 <= erosion < 1:
        raise InputError(f"cloud: erosion must be in [0, 1), got {erosion}")
    if not 1 <= octaves <= 8 or octaves != int(octaves):
        raise InputError(f"cloud: octaves of detail must be a whole number from 1 to 8, got {octaves}")
    x, y, z = (float(n) for n in vector(tiles, "tiles"))  # pyright: ignore[reportArgumentType]
    noise = textures.detail @ np.array([0.625, 0.25, 0.125], np.float32)
    values = np.concatenate([noise.ravel(), textures.curl.ravel()])
    return Detail(values, len(noise), len(textures.curl), (x, y, z), float(erosion), int(octaves), float(contrast))


def finest(d: Detail) -> tuple[float, float, float]:
    """Samples of the finest octave along each side of the box."""
    x, y, z = (n * d.n * FINER ** (d.octaves - 1) for n in d.tiles)
    return x, y, z


@jit
def pushed(curl, x, y, c):
    """Component c of the curl noise, bilinear on the unit torus."""
    n = curl.shape[0]
    x, y = (x - math.floor(x)) * n, (y - math.floor(y)) * n
    i, j = int(x), int(y)
    u, v = x - i, y - j
    i, j = i % n, j % n
    a, b = (i + 1) % n, (j + 1) % n
    return bilinear(curl[i, j, c], curl[i, b, c], curl[a, j, c], curl[a, b, c], u, v)


@jit
def noise_at(d, x, y, z):
    """n(x) in [0, 1] at a point of the unit cube, z up."""
    size, push = d.n * d.n * d.n, CURL_SHIFT * (1.0 - z)
    noise, curl = d.values[:size].reshape((d.n, d.n, d.n, 1)), d.values[size:].reshape((d.p, d.p, 2))
    sx = x + push * pushed(curl, CURL_TILES * x, CURL_TILES * y, 0)
    sy = y + push * pushed(curl, CURL_TILES * x, CURL_TILES * y, 1)
    total, weights, finer, weight = 0.0, 0.0, 1.0, 1.0
    for _ in range(d.octaves):
        total += weight * texture_at(noise, finer * d.tiles[0] * sx, finer * d.tiles[1] * sy, finer * d.tiles[2] * z, 0)
        weights += weight
        finer, weight = FINER * finer, WEAKER * weight
    n, upward = total / weights, min(8.0 * z, 1.0)
    return n * (1.0 - upward) + (1.0 - n) * upward


@jit
def eroded(d, shape, x, y, z):
    """rho at a point of the unit cube where the coarse shape is ``shape``."""
    if shape <= 0.0 or (d.erosion <= 0.0 and d.contrast == 1.0):
        return shape
    return min(d.contrast * remap(shape, d.erosion * noise_at(d, x, y, z), 1.0, 0.0, 1.0), 1.0)


def most(d: Detail, shape: np.ndarray) -> np.ndarray:
    """An upper bound of the eroded density where the shape is at most ``shape``."""
    return np.minimum(d.contrast * shape, 1.0)


def least(d: Detail, shape: np.ndarray) -> np.ndarray:
    """A lower bound of the eroded density where the shape is at least ``shape``."""
    return most(d, np.maximum(shape - d.erosion, 0.0) / (1.0 - d.erosion))
