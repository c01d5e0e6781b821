"""Weather maps [Horizon], PHYSICS 13: what clouds stand over each point of the ground, and a landscape of clouds from one.

A map is (nx, ny, 3) float32 in [0, 1], x and y over the box, bilinear in between:
    coverage        0 clear, 1 overcast
    type            0 stratus, 1/2 cumulus, 1 cumulonimbus, their height gradients mixed in between
    precipitation   0 dry, 1 pouring: strongest at a cloud's base, gone at 3/4 of its layer
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from PIL import Image

from data_synth.clouds import CUMULONIMBUS, CUMULUS, RIM, STRATUS, height_gradient, shape_at
from data_synth.detail import NONE, Detail, eroded
from data_synth.errors import InputError
from data_synth.jit import in_bands, jit, kernel
from data_synth.noise import CloudTextures, cloud_textures, remap
from data_synth.vec import bilinear

LARGEST = 4096  # pixels along a side of a map


def generated(
    coverage: float = 0.5, rain: float = 1.0, seed: int = 0, textures: CloudTextures | None = None
) -> np.ndarray:
    """A map out of the noise of clouds, of which ``coverage`` is covered; it tiles. It rains, ``rain`` at most, where
    coverage is greatest; types change slowly from place to place."""
    t = textures or cloud_textures(seed)
    n = t.base.shape[0]
    fields = np.sort(t.base[:, :, n // 2, 0], axis=None)
    clear = fields[min(int((1 - coverage) * fields.size), fields.size - 1)]
    ramp = 0.5 * (fields[-1] - clear) or 1.0
    covered = np.clip((t.base[:, :, n // 2, 0] - clear) / ramp, 0, 1) if coverage > 0 else np.zeros((n, n))
    kind = t.base[:, :, 0, 1]
    kind = np.clip((kind - kind.min()) / max(np.ptp(kind), 1e-9), 0, 1)
    return np.stack([covered, kind, rain * np.clip((covered - 0.5) / 0.5, 0, 1)], axis=-1).astype(np.float32)


def read(path: str | os.PathLike) -> np.ndarray:
    """The map of a picture: red is coverage, green type, blue precipitation, as stored (no gamma); north, +y, is up."""
    try:
        with Image.open(path) as image:
            if max(image.size) > LARGEST or min(image.size) < 2:
                raise InputError(f"{path}: expected a weather map of 2 to {LARGEST} pixels a side, got {image.size}")
            pixels = np.asarray(image.convert("RGB"), np.float32) / 255
    except InputError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected a picture of coverage, type and precipitation: {error}") from error
    return np.ascontiguousarray(pixels[::-1].transpose(1, 0, 2))


@jit
def weather_at(weather, x, y, c):
    """Channel c of a map at a point of the unit square, bilinear."""
    u, v = x * (weather.shape[0] - 1), y * (weather.shape[1] - 1)
    i, j = min(int(u), weather.shape[0] - 2), min(int(v), weather.shape[1] - 2)
    corners = (weather[i, j, c], weather[i, j + 1, c], weather[i + 1, j, c], weather[i + 1, j + 1, c])
    return bilinear(*corners, u - i, v - j)


@jit
def mixed_gradient(kind, h):
    """The height gradient of a type in [0, 1]."""
    if kind <= 0.5:
        return (1.0 - 2.0 * kind) * height_gradient(STRATUS, h) + 2.0 * kind * height_gradient(CUMULUS, h)
    return (2.0 - 2.0 * kind) * height_gradient(CUMULUS, h) + (2.0 * kind - 1.0) * height_gradient(CUMULONIMBUS, h)


@kernel
def _fill(t, detail, weather, rim, tiles, cloud, rain, first, last):
    nx, ny, nz = cloud.shape
    for i in range(first, last):
        for j in range(ny):
            x, y = i / (nx - 1), j / (ny - 1)
            cover, kind, wet = weather_at(weather, x, y, 0), weather_at(weather, x, y, 1), weather_at(weather, x, y, 2)
            for k in range(nz):
                z = k / (nz - 1)
                shape = shape_at(t, mixed_gradient(kind, z), cover, rim, tiles[0] * x, tiles[1] * y, tiles[2] * z)
                cloud[i, j, k] = eroded(detail, shape, x, y, z)
                rain[i, j, k] = wet * remap(z, 0.15, 0.75, 1.0, 0.0)


def landscape(
    weather: np.ndarray, shape: Sequence[int], tiles: Sequence[float] = (1.0, 1.0, 1.0), seed: int = 0,
    detail: Detail = NONE, textures: CloudTextures | None = None, rim: float = RIM,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """((nx, ny, nz) float32 clouds, the same of rain), both in [0, 1], for ``media.grid(clouds, ..., attribute=rain)``.

    tiles: of the base noise along x, y and z. detail: erodes them at the samples; without it, as here, hand it to the medium.
    rim: how far from a cloud's edge, in the base noise, its shape is 1; what detail is to carve wants a wide one.
    """
    weather = np.ascontiguousarray(weather, np.float32)
    if weather.ndim != 3 or weather.shape[2] != 3 or min(weather.shape[:2]) < 2:
        raise InputError(
            f"weather map: expected (nx, ny, 3) numbers of coverage, type, rain, got shape {weather.shape}"
        )
    if not np.isfinite(weather).all() or weather.min() < 0 or weather.max() > 1:
        raise InputError("weather map: expected numbers in [0, 1]")
    cloud, rain = np.empty(tuple(shape), np.float32), np.empty(tuple(shape), np.float32)
    x, y, z = (float(n) for n in tiles)
    t = textures or cloud_textures(seed)
    in_bands(lambda a, b: _fill(t, detail, weather, float(rim), (x, y, z), cloud, rain, a, b), cloud.shape[0], 4)
    return cloud, rain
