"""What other programs write of Gaussians, made what ours are or refused with the number of the one that is wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.splats.splats import Splats

Fault = Callable[[str], InputError]
"""The error that names the file and says what is wrong with it."""
LARGEST = 1e15
"""Of positions, as for cameras; coefficients and logarithms are held to much less."""
LARGEST_COEFFICIENT = 1e6
LARGEST_LOG_SCALE = 40.0
LARGEST_LOGIT = 80.0
_SHORTEST = 1e-12  # of a quaternion that still is a direction


def checked(
    fault: Fault, *, means: NDArray[np.float32], log_scales: NDArray[np.float32], quats: NDArray[np.float32],
    logits: NDArray[np.float32], sh: NDArray[np.float32], origin: NDArray[np.float64], mode: Literal["mip", "plain"],
) -> Splats:  # fmt: skip
    """Gaussians of these values (n, ...), shapes as in :class:`Splats`; scales of nothing and opacities of exactly 0 and 1,
    whose logarithms and logits are infinite, become the nearest that there are.

    Raises:
        InputError: what ``fault`` makes of the first that is not finite, too large or no rotation.
    """
    splats = Splats(
        means=means, log_scales=_log_scales(fault, log_scales), quats=quats, logits=_logits(fault, logits), sh=sh,
        origin=origin, mode=mode,
    )  # fmt: skip
    bounds = (
        ("position", splats.means, LARGEST),
        ("rotation", splats.quats, LARGEST_COEFFICIENT),
        ("colour", splats.sh.reshape(splats.n, 3 * splats.sh.shape[2]), LARGEST_COEFFICIENT),
    )
    for what, values, bound in bounds:
        good = (np.abs(values) < bound).all(axis=1)  # fails for what is no number as well
        if not good.all():
            raise fault(f"the {what} of vertex {int((~good).argmax())} is not finite or beyond {bound:g}")
    length = np.linalg.norm(splats.quats.astype(np.float64), axis=1)
    if splats.n and length.min() < _SHORTEST:
        raise fault(f"the rotation of vertex {int(length.argmin())} is a quaternion of length 0")
    return splats


def logits_of(alpha: NDArray[np.float64]) -> NDArray[np.float32]:
    """Logits (n,) of opacities in [0, 1], infinite at its ends."""
    with np.errstate(divide="ignore"):
        return (np.log(alpha) - np.log1p(-alpha)).astype(np.float32)


def _log_scales(fault: Fault, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Trainers write -inf for a scale of nothing (discs of 2D splatting): that is the smallest there is."""
    if np.isnan(values).any() or (values > LARGEST_LOG_SCALE).any():
        bad = int((~(values <= LARGEST_LOG_SCALE)).any(axis=1).argmax())
        raise fault(f"a scale of vertex {bad} is not a logarithm of at most {LARGEST_LOG_SCALE:g}")
    return np.maximum(values, np.float32(-LARGEST_LOG_SCALE)) if (values < -LARGEST_LOG_SCALE).any() else values


def _logits(fault: Fault, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Opacities of exactly 0 and 1 have infinite logits; ±80 is the same in float32."""
    if np.isnan(values).any():
        raise fault(f"the opacity of vertex {int(np.isnan(values).argmax())} is not a number")
    limit = np.float32(LARGEST_LOGIT)
    return np.clip(values, -limit, limit) if (np.abs(values) > limit).any() else values
