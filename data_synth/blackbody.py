"""The colour of what glows by heat: Planck's law through the CIE 1931 observer into linear sRGB.

The observer is the sum of Gaussians of Wyman, Sloan & Shirley 2013 (multi-lobe fit, below 1 % of the peak off).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from data_synth.errors import InputError

H, C, K = 6.62607015e-34, 299792458.0, 1.380649e-23
NANOMETRES = np.arange(360.0, 831.0, 1.0)
# (weight, mean, width below the mean, width above) of each lobe of x, y, z; nanometres
LOBES = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)
XYZ_TO_SRGB = np.array([
    [3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252],
])  # fmt: skip


def observer() -> np.ndarray:
    """(3, n) colour-matching functions at NANOMETRES."""
    out = np.zeros((3, len(NANOMETRES)))
    for k, lobes in enumerate(LOBES):
        for weight, mean, below, above in lobes:
            width = np.where(NANOMETRES < mean, below, above)
            out[k] += weight * np.exp(-0.5 * ((NANOMETRES - mean) / width) ** 2)
    return out


def xyz(kelvin: ArrayLike) -> np.ndarray:
    """(..., 3) CIE XYZ of a black body, up to one constant factor for all temperatures."""
    T = np.asarray(kelvin, float)[..., None]
    if not (np.isfinite(T) & (T > 0)).all():
        raise InputError(f"blackbody: expected positive temperatures in kelvin, got {kelvin}")
    wave = NANOMETRES * 1e-9
    spectrum = 2 * H * C**2 / wave**5 / np.expm1(np.minimum(H * C / (wave * K * T), 700.0))
    return spectrum @ observer().T


def glow(kelvin: ArrayLike, white: float) -> np.ndarray:
    """(..., 3) linear sRGB radiance of a black body, with luminance 1 at ``white`` kelvin; what no display shows is 0."""
    return np.maximum(xyz(kelvin) @ XYZ_TO_SRGB.T, 0.0) / xyz(white)[..., 1:2]
