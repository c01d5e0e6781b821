"""LPIPS, a distance between pictures learnt from people's judgements [Zhang et al. 2018], by the package of its authors.

The package (``nerfvol[lpips]``) has the small weights; those of its VGG network come from torchvision, which fetches them at
the first use. Papers on radiance fields report the VGG variant.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError

NETWORK = "vgg"
SMALLEST = 32
"""Pixels along a side: five halvings of a picture must leave one."""


def load_lpips() -> Callable[[NDArray[np.floating], NDArray[np.floating]], float]:
    """A function of two images (height, width, 3) in [0, 1] that returns their distance: 0 for equal ones, smaller is better.

    Raises:
        InputError: the package is not installed, or the network's weights cannot be had. The function itself: images of two
            shapes, or too small ones.
    """
    try:
        import lpips  # type: ignore[import-not-found]
    except ImportError as error:
        raise InputError("--lpips needs the package lpips: pip install 'nerfvol[lpips]'") from error
    import torch

    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints what it loads
            network: Any = lpips.LPIPS(net=NETWORK, verbose=False).eval()
    except Exception as error:  # whatever stands between torchvision and its weights
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"--lpips: the weights of its {NETWORK} network cannot be loaded: {reason}") from error

    def distance(image: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
        shape = np.shape(image)
        if shape != np.shape(reference) or len(shape) != 3 or shape[2] != 3 or min(shape[:2]) < SMALLEST:
            raise InputError(
                f"LPIPS compares RGB images of one size, at least {SMALLEST}x{SMALLEST}, got shapes {shape} and "
                f"{np.shape(reference)}"
            )
        a, b = (
            torch.from_numpy(np.ascontiguousarray(x, np.float32)).permute(2, 0, 1)[None] for x in (image, reference)
        )
        with torch.no_grad():
            return float(network(a, b, normalize=True))

    return distance
