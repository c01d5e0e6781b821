"""Pictures resampled: bicubically at given positions and by averaging blocks; compiled, or the same in numpy.

Pixel (i, j) covers [i, i + 1) x [j, j + 1); positions are (x, y) in pixels, so that centres end in 1/2. Bicubic is Keys'
cubic with a = -1/2 (R. Keys, "Cubic convolution interpolation", 1981): exact for parabolas, and it goes beyond the values
it lies between.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.native import native

UInt8 = NDArray[np.uint8]
Float = NDArray[np.float32]

MULTIPLE = 16
"""Sides of training images are multiples of it: the rasteriser's tiles."""


def padded(size: int) -> int:
    """The next multiple of 16."""
    return -(-size // MULTIPLE) * MULTIPLE


def remap(source: UInt8, grid: Float, step: int, used: tuple[int, int], size: tuple[int, int]) -> UInt8:
    """``source`` (h, w, 3 or 4) seen at other positions: (height, width, 4) uint8.

    Args:
        grid: (rows, columns, 2) positions in the source of the centres of every ``step``-th pixel of the result, linear
            between them; it reaches beyond the last pixel in use.
        used: (height, width) of the part that is a picture; the rest is 0.
        size: (height, width) of the result.

    The fourth channel is the source's (255 where it has none) and 0 outside the source, where colours repeat its edge.
    """
    positions = np.ascontiguousarray(grid, np.float32)
    compiled = native()
    if compiled is not None:
        out = np.empty((*size, 4), np.uint8)
        compiled.remap(np.ascontiguousarray(source), positions, step, *used, out)
        return out
    return _remap(source, positions, step, used, size)


def reduce(source: UInt8, factor: int, size: tuple[int, int]) -> UInt8:
    """Means of factor x factor blocks of ``source`` (h, w, 3 or 4): (height, width, 4) uint8, rounded once.

    Colours are weighted by the fourth channel (by 1 without one). What blocks at the right and lower edge lack counts as
    weight 0; whole blocks beyond the source are 0.
    """
    compiled = native()
    if compiled is not None:
        out = np.empty((*size, 4), np.uint8)
        compiled.reduce(np.ascontiguousarray(source), factor, out)
        return out
    return _reduce(source, factor, size)


def sample(picture: Float, positions: Float, cubic: bool) -> Float:
    """``picture`` (h, w, k) float32 at positions (n, 2): (n, k), bicubic or bilinear; beyond the edges their pixels."""
    picture, positions = np.ascontiguousarray(picture, np.float32), np.ascontiguousarray(positions, np.float32)
    compiled = native()
    if compiled is not None:
        out = np.empty((len(positions), picture.shape[2]), np.float32)
        compiled.sample(picture, positions, cubic, out)
        return out
    return _sample(picture, positions, cubic)


# ------------------------------------------------------------------ the same in numpy
def _cubic_weights(t: Float) -> Float:
    """(..., 4) weights of the pixels at -1, 0, 1, 2 for positions t in [0, 1]."""
    powers = np.stack([np.ones_like(t), t, t * t, t * t * t], axis=-1)
    rows = [[0, 1, 0, 0], [-0.5, 0, 0.5, 0], [1, -2.5, 2, -0.5], [-0.5, 1.5, -1.5, 0.5]]
    return powers @ np.array(rows, np.float32)


def _taps(picture: Float, x: NDArray[Any], y: NDArray[Any], cubic: bool) -> Float:
    """The picture (h, w, k) at x, y (n,), counted from the first pixel's centre."""
    height, width = picture.shape[:2]
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    u, v = (x - i).astype(np.float32), (y - j).astype(np.float32)
    if cubic:
        across, down, first = _cubic_weights(u), _cubic_weights(v), -1
    else:
        across, down, first = np.stack([1 - u, u], -1), np.stack([1 - v, v], -1), 0
    out = np.zeros((len(x), picture.shape[2]), np.float32)
    for b in range(down.shape[1]):
        rows = np.clip(j + first + b, 0, height - 1)
        for a in range(across.shape[1]):
            columns = np.clip(i + first + a, 0, width - 1)
            out += (down[:, b] * across[:, a])[:, None] * picture[rows, columns]
    return out


def _sample(picture: Float, positions: Float, cubic: bool) -> Float:
    height, width = picture.shape[:2]
    places = np.nan_to_num(positions, nan=0.0, posinf=1e9, neginf=-1e9) - np.float32(0.5)
    return _taps(picture, np.clip(places[:, 0], 0, width - 1), np.clip(places[:, 1], 0, height - 1), cubic)


def _remap(source: UInt8, grid: Float, step: int, used: tuple[int, int], size: tuple[int, int]) -> UInt8:
    height, width = source.shape[:2]
    rows, columns = np.arange(used[0]) / step, np.arange(used[1]) / step
    y, x = np.meshgrid(rows, columns, indexing="ij")
    place = _taps(grid, x.ravel(), y.ravel(), cubic=False)
    u, v = place[:, 0], place[:, 1]
    inside = (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
    pixels = source.astype(np.float32)
    if source.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full((height, width, 1), 255, np.float32)], axis=2)
    value = _taps(pixels, np.clip(u, 0, width) - 0.5, np.clip(v, 0, height) - 0.5, cubic=True)
    value = np.clip(value + 0.5, 0, 255).astype(np.uint8)
    value[~inside, 3] = 0
    out = np.zeros((*size, 4), np.uint8)
    out[: used[0], : used[1]] = value.reshape(*used, 4)
    return out


def _reduce(source: UInt8, factor: int, size: tuple[int, int]) -> UInt8:
    rows, columns = (min(-(-have // factor), want) for have, want in zip(source.shape[:2], size, strict=True))
    whole = np.zeros((rows * factor, columns * factor, 5), np.uint64)
    part = source[: rows * factor, : columns * factor]
    h, w = part.shape[:2]
    whole[:h, :w, :3], whole[:h, :w, 4] = part[..., :3], 1
    whole[:h, :w, 3] = part[..., 3] if source.shape[2] == 4 else 255
    blocks = whole.reshape(rows, factor, columns, factor, 5)
    weighted = (blocks[..., :3] * blocks[..., 3:4]).sum((1, 3))
    plain, weight, n = blocks[..., :3].sum((1, 3)), blocks[..., 3].sum((1, 3)), blocks[..., 4].sum((1, 3))
    one, full = np.uint64(1), np.uint64(factor * factor)
    by, count = np.maximum(weight, one)[..., None], np.maximum(n, one)[..., None]
    colour = np.where(weight[..., None] > 0, (weighted + by // 2) // by, (plain + count // 2) // count)
    out = np.zeros((*size, 4), np.uint8)
    out[:rows, :columns, :3], out[:rows, :columns, 3] = colour, (weight + full // 2) // full
    return out
