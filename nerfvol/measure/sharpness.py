"""How sharp a picture is, whatever its contrast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Mean squared Laplacian over mean squared gradient of a grey picture (h, w); 0 where it is uniform, or less than 3 pixels
    wide or high: none has neighbours on all sides.

    That is the mean squared frequency of its edges (radians a pixel, squared): blur lowers it, contrast does not change it.
    """
    if min(grey.shape) < 3:
        return 0.0
    g = grey.astype(np.float32)
    middle = g[1:-1, 1:-1]
    laplacian = g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:] - 4 * middle
    across, down = (g[1:-1, 2:] - g[1:-1, :-2]) / 2, (g[2:, 1:-1] - g[:-2, 1:-1]) / 2
    slope = float((across * across + down * down).mean())
    return float((laplacian * laplacian).mean()) / slope if slope > 1e-6 else 0.0
