"""Splats in turned axes, of another scale: means, the Gaussians' own axes, the bands of their colours' spherical harmonics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nerfvol.rotations import product, quaternion
from nerfvol.sh import basis_dim, eval_basis
from nerfvol.splats.splats import Splats

Float = NDArray[np.float64]


def turned(splats: Splats, rotation: Float) -> Splats:
    """The splats with every point x moved to ``rotation`` (3, 3) x: seen from turned cameras they look the same."""
    if np.array_equal(rotation, np.eye(3)):
        return splats
    return replace(
        splats,
        means=splats.means.astype(np.float64) @ rotation.T,
        quats=product(quaternion(rotation), splats.quats),
        sh=splats.sh.astype(np.float64) @ sh_rotation(splats.sh_degree, rotation).T,
        origin=rotation @ splats.origin,
    )


def similar(splats: Splats, scale: float, rotation: Float, shift: Float) -> Splats:
    """The splats with every point x moved to ``scale`` R x + ``shift`` (3,), R = ``rotation`` (3, 3)."""
    out = turned(splats, rotation)
    return replace(
        out,
        means=out.means * np.float32(scale),
        log_scales=out.log_scales + np.float32(np.log(scale)),
        origin=scale * out.origin + shift,
    )


def sh_rotation(degree: int, rotation: Float) -> Float:
    """(K, K), K = (degree + 1)**2: the coefficients of a function in turned axes from those before.

    Each band turns into itself: f'(R d) = f(d) for the function's values along directions that are many and spread enough
    to tell its coefficients (a Fibonacci lattice), by least squares, exact to rounding.
    """
    n = 16 * basis_dim(degree)
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    d = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    before, after = (eval_basis(degree, v) for v in (d, d @ rotation.T))
    return np.linalg.lstsq(after, before, rcond=None)[0]
