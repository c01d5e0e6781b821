"""The colour map between two pictures of one thing: exposure and white balance, solved in closed form.

A map is (3, 4): colour -> map[:, :3] @ colour + map[:, 3]. Scores after such a fit are what the field calls colour-corrected
(RawNeRF, Mildenhall et al. 2022, section 6): they tell what of an error is the camera's exposure, not the scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float64]
RIDGE = 1e-2
"""Weight of a map's distance to a mere gain, per pixel: what the pixels say little of stays a gain."""
SATURATED = 252 / 255
"""A channel from here on may have been more."""
IDENTITY: Map = np.eye(3, 4)


def fit_colour_map(
    source: NDArray[np.floating], target: NDArray[np.floating], weight: NDArray[np.floating] | None = None
) -> Map:
    """The map of ``source`` colours (n, 3) to ``target`` (n, 3), both in [0, 1], that minimises

        sum_p w_p |A (s_p, 1) - t_p|^2 + RIDGE sum_p w_p |A - G|^2,   G = diag(gain), gain_c = sum w t_c / sum w s_c.

    ``weight``: (n,), default 1. Pixels whose target is saturated in a channel are left out. The identity where nothing is left.
    """
    s, t = (np.asarray(x, np.float64).reshape(-1, 3) for x in (source, target))
    w = np.ones(len(s)) if weight is None else np.asarray(weight, np.float64).ravel().copy()
    w *= (t < SATURATED).all(1)
    total = w.sum()
    if total <= 0:
        return IDENTITY.copy()
    # einsum without BLAS: sums in one order, however many threads there are.
    bright = np.einsum("p,pc->c", w, s)
    gain = np.divide(np.einsum("p,pc->c", w, t), bright, out=np.ones(3), where=bright > 1e-6 * total)
    prior = np.concatenate([np.diag(gain), np.zeros((3, 1))], axis=1)
    x = np.concatenate([s, np.ones((len(s), 1))], axis=1)
    normal = np.einsum("p,pi,pj->ij", w, x, x) + RIDGE * total * np.eye(4)
    right = np.einsum("p,pi,pj->ij", w, x, t) + RIDGE * total * prior.T
    return np.linalg.solve(normal, right).T.astype(np.float64)


def apply_map(colour_map: Map, image: NDArray[np.floating]) -> NDArray[np.float32]:
    """The map of an image (..., 3), not clipped."""
    m = colour_map.astype(np.float32)
    return (image.astype(np.float32) @ m[:, :3].T + m[:, 3]).astype(np.float32)


def inverse(colour_map: Map) -> Map:
    """The map that undoes ``colour_map``; LinAlgError where there is none."""
    linear = np.linalg.inv(colour_map[:, :3])
    return np.asarray(np.concatenate([linear, -(linear @ colour_map[:, 3:])], axis=1), dtype=np.float64)


def compose(outer: Map, inner: Map) -> Map:
    """``outer`` after ``inner``."""
    linear = outer[:, :3] @ inner[:, :3]
    return np.concatenate([linear, outer[:, :3] @ inner[:, 3:] + outer[:, 3:]], axis=1)


def exposure(colour_map: Map) -> float:
    """The gain of a map: what it makes of middle grey, as a factor."""
    return float((colour_map[:, :3].sum() / 2 + colour_map[:, 3].sum()) / 1.5)
