"""What the operators refuse before a kernel touches memory: shapes, types and ranges, one sentence each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from nerfvol.kernels.state import OUTPUTS, TILE_RAYS, Batch, LossOptions
from nerfvol.octree import lod
from nerfvol.octree.tree import Octree


def check_rays(rays_o: ArrayLike, rays_d: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Both as contiguous float32: directions (n, 3), origins (n, 3) or one for each 64 rays, (ceil(n / 64), 3).

    Raises ValueError where the shapes are others, or a number is not finite.
    """
    o, d = (np.ascontiguousarray(a, dtype=np.float32) for a in (rays_o, rays_d))
    if d.ndim != 2 or d.shape[1] != 3:
        raise ValueError(f"rays_d must have shape (n, 3), got {d.shape}")
    if o.ndim != 2 or o.shape[1] != 3 or len(o) not in (len(d), -(-len(d) // TILE_RAYS)):
        raise ValueError(
            f"rays_o must have one row per ray or one per {TILE_RAYS} rays of {len(d)}, got shape {o.shape}"
        )
    for name, a in (("rays_o", o), ("rays_d", d)):
        if not np.isfinite(np.dot(a.ravel(), a.ravel())):  # one pass; unit directions cannot overflow
            raise ValueError(f"{name} must be finite, {int((~np.isfinite(a)).any(1).sum())} rows are not")
    return o, d


def check_early_stop(eps: float) -> float:
    """``eps``; ValueError outside [0, 1)."""
    if not 0 <= eps < 1:  # also refuses NaN
        raise ValueError(f"early_stop_eps must lie in [0, 1), got {eps}")
    return float(eps)


def check_coarse(octree: Octree, origins: np.ndarray, coarse: float) -> float:
    """``coarse``, or 0 where no node is so small from any of the ``origins`` (..., 3).

    Raises ValueError where it is negative or not finite.
    """
    if not 0 <= coarse < np.inf:
        raise ValueError(f"coarse must be an angle in radians, 0 or more and finite, got {coarse}")
    return float(coarse) if coarse > 0 and lod.has_lod_cut(octree, origins, coarse) else 0.0


def check_background(background: Iterable[float]) -> list[float]:
    """Three floats; ValueError where they are not three or not finite."""
    values = [float(x) for x in background]
    if len(values) != 3 or not np.isfinite(values).all():
        raise ValueError(f"background must be three finite numbers, got {background}")
    return values


def check_outputs(outputs: Sequence[str]) -> None:
    """ValueError unless every name is among state.OUTPUTS."""
    if unknown := set(outputs) - set(OUTPUTS):
        raise ValueError(f"outputs must be among {OUTPUTS}, got {sorted(unknown)}")


def check_batch(batch: Batch, options: LossOptions) -> tuple[np.ndarray, np.ndarray, list[float], float]:
    """Origins and directions as of :func:`check_rays`, background (three floats) and early-stop threshold.

    Raises ValueError where one of them is not what it should be, target is not (n, 3) or weight not (n,).
    """
    o, d = check_rays(batch.rays_o, batch.rays_d)
    if batch.target.shape != d.shape or batch.weight.shape != d.shape[:1]:
        raise ValueError(f"target {batch.target.shape} and weight {batch.weight.shape} do not fit rays {d.shape}")
    return o, d, check_background(options.background), check_early_stop(options.early_stop_eps)
