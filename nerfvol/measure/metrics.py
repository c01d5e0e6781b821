"""Image quality as the field reports it: PSNR and SSIM of RGB images in [0, 1], composited on a stated background.

A score of several images is the mean of the per-image scores (not the PSNR of the mean squared error). LPIPS needs
a network's weights: perceptual.py. Images are numpy arrays or torch tensors of any float type.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.errors import InputError
from nerfvol.native import native

if TYPE_CHECKING:
    from torch import Tensor

Floats = NDArray[np.floating]

WINDOW = 11
"""Pixels along a side of SSIM's window: smaller images have no SSIM."""
_SIGMA = 1.5
_K1, _K2 = 0.01, 0.03
_BAND = 32  # rows at a time: five maps of a band stay in the processor's cache


def psnr(image: Tensor | ArrayLike, reference: Tensor | ArrayLike) -> float:
    """-10 log10 of the mean squared error over all pixels and channels, in dB; infinity for equal images.

    Images of one shape, any, with floating-point values in [0, 1]. Raises InputError where shapes differ or are empty, or
    values are not floating point.
    """
    a, b = _pair(image, reference)
    error = (a - b).ravel()
    mse = float(np.mean(error * error, dtype=np.float64))
    return -10 * math.log10(mse) if mse > 0 else math.inf if mse == 0 else math.nan


def ssim(image: Tensor | ArrayLike, reference: Tensor | ArrayLike, seen: NDArray[np.bool_] | None = None) -> float:
    """Mean structural similarity [Wang 2004] of images (h, w, channels) in [0, 1], h and w at least 11.

    11 x 11 Gaussian window with sigma 1.5, K = (0.01, 0.03), population covariance, the mean over the positions where
    the window lies inside the image and over the channels: scikit-image's structural_similarity(gaussian_weights=True,
    sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=2). Equal images score 1.

    ``seen`` (h, w): the pixels that count. Elsewhere the image is taken to equal the reference, and the mean is over the
    windows whose middle counts (over all where there is none).

    Raises:
        InputError: images of two shapes, smaller ones, or values that are not floating point.
    """
    a, b = _pair(image, reference)
    if a.ndim != 3 or min(a.shape[:2]) < WINDOW:
        raise InputError(f"SSIM needs images (height, width, channels) of at least 11x11 pixels, got shape {a.shape}")
    if seen is None:
        return float(np.mean(_similarities(a, b), dtype=np.float64))
    half = WINDOW // 2
    middle = seen[half : seen.shape[0] - half, half : seen.shape[1] - half]
    maps = _similarities(np.where(seen[..., None], a, b), b)
    return float(np.mean(maps[middle] if middle.any() else maps, dtype=np.float64))


def _similarities(a: Floats, b: Floats) -> Floats:
    """The similarity at every position of the window inside images (h, w, channels): (h - 10, w - 10, channels)."""
    height, width, channels = a.shape
    out = np.empty((height - WINDOW + 1, width - WINDOW + 1, channels), a.dtype)
    compiled = native()
    if compiled is not None and a.dtype == np.float32:
        first, second = np.ascontiguousarray(a), np.ascontiguousarray(b)
        compiled.similarity(first, second, _window().astype(np.float32), _K1**2, _K2**2, out)
        return out
    for channel in range(channels):
        for top in range(0, len(out), _BAND):
            rows = slice(top, min(top + _BAND, len(out)) + WINDOW - 1)
            out[top : top + _BAND, :, channel] = _similarity(a[rows, :, channel], b[rows, :, channel])
    return out


def _window() -> NDArray[np.float64]:
    """(WINDOW,) weights along one axis; they sum to 1."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (offsets / _SIGMA) ** 2)
    return weights / weights.sum()


def _similarity(a: Floats, b: Floats) -> Floats:
    """The similarity at every position of the window inside two planes (h, w): (h - 10, w - 10)."""
    maps = np.empty((5, *a.shape), dtype=a.dtype)
    # Moments about 1/2, a constant that cancels in the covariances, lose less to rounding than moments about 0.
    np.subtract(a, a.dtype.type(0.5), out=maps[0])
    np.subtract(b, b.dtype.type(0.5), out=maps[1])
    np.multiply(maps[0], maps[0], out=maps[2])
    np.multiply(maps[1], maps[1], out=maps[3])
    np.multiply(maps[0], maps[1], out=maps[4])
    mu_a, mu_b, aa, bb, ab = _window_means(maps)
    var_a, var_b, cov = aa - mu_a * mu_a, bb - mu_b * mu_b, ab - mu_a * mu_b
    mu_a, mu_b = mu_a + a.dtype.type(0.5), mu_b + a.dtype.type(0.5)
    c1, c2 = a.dtype.type(_K1**2), a.dtype.type(_K2**2)
    numerator = (2 * mu_a * mu_b + c1) * (2 * cov + c2)
    denominator = (mu_a * mu_a + mu_b * mu_b + c1) * (var_a + var_b + c2)
    return numerator / denominator


def _window_means(maps: Floats) -> Floats:
    """Gaussian-weighted means (n, h - 10, w - 10) of maps (n, h, w): down the columns, then along the rows."""
    weights = _window().astype(maps.dtype)
    for axis in (1, 2):
        size = maps.shape[axis] - WINDOW + 1
        part = [maps[:, j : j + size] if axis == 1 else maps[:, :, j : j + size] for j in range(WINDOW)]
        total = part[WINDOW // 2] * weights[WINDOW // 2]
        both = np.empty_like(total)
        for j in range(WINDOW // 2):  # the window is symmetric
            np.add(part[j], part[WINDOW - 1 - j], out=both)
            both *= weights[j]
            total += both
        maps = total
    return maps


def _pair(image: Tensor | ArrayLike, reference: Tensor | ArrayLike) -> tuple[Floats, Floats]:
    """Both as float32 or float64 arrays of one shape; 8-bit images are not taken for values in [0, 1]."""
    # A tensor that requires a gradient does not turn into an array by itself.
    detach = (getattr(x, "detach", None) for x in (image, reference))
    a, b = (np.asarray(x if of is None else of().cpu()) for x, of in zip((image, reference), detach, strict=True))
    if a.shape != b.shape or a.size == 0:
        raise InputError(f"images to compare must have one shape and some pixels, got {a.shape} and {b.shape}")
    if not (np.issubdtype(a.dtype, np.floating) and np.issubdtype(b.dtype, np.floating)):
        raise InputError(f"images to compare must be floating-point values in [0, 1], got {a.dtype} and {b.dtype}")
    dtype = np.promote_types(np.promote_types(a.dtype, b.dtype), np.float32)
    return a.astype(dtype, copy=False), b.astype(dtype, copy=False)
