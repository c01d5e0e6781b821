"""Positions for formats of float32: relative to a point near them where map coordinates would lose their digits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nerfvol.splats.splats import Splats


def offset_for(positions: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """(3,) what is to be taken off positions (n, 3) so that float32 tells apart what is ``width`` wide: 0 where it does
    anyway; else a round number near their middle."""
    if not len(positions):
        return np.zeros(3)
    far = float(np.abs(positions).max())
    if not far < 3e38 or float(np.spacing(np.float32(far))) <= width:
        return np.zeros(3)
    middle = np.median(positions, axis=0)
    extent = float(np.abs(positions - middle).max())
    step = 10.0 ** math.floor(math.log10(extent)) if extent > 0 else 1.0
    return np.round(middle / step) * step


def relative(splats: Splats) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Positions (n, 3) and the offset (3,) that they lack: 0 where float32 tells the splats apart as they are."""
    means = splats.means.astype(np.float64) + splats.origin
    width = float(np.exp(np.median(splats.log_scales))) if splats.n else 1.0
    offset = offset_for(means, width)
    with np.errstate(over="ignore"):
        return (means - offset).astype(np.float32), offset
