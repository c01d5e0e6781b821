"""Emission-absorption quadrature: optical depths along rays to weights. The one implementation of compositing in torch.

A ray is cut into segments of constant coefficient ``sigmas`` (1/u) and length ``deltas`` (u), front to back. With
tau_i = sigma_i * delta_i (docs/mathematics.md, section 1; Max 1995, Mildenhall et al. 2020):

    alpha_i = 1 - exp(-tau_i)         opacity of the segment
    trans_i = exp(-sum_{j<i} tau_j)   transmittance in front of it (exclusive sum)
    weight_i = trans_i * alpha_i      its share of the pixel;  sum_i weight_i + trans_final = 1

Two layouts: dense (n_rays, n_samples), and packed (n_samples,) with sorted ``ray_indices``. All is differentiable
and works in float32 and float64.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

# exp(-800) is exactly zero in float64 (and in float32 long before), so limiting one segment to this changes no result.
_OPAQUE = 800.0


class Composite(NamedTuple):
    """``alphas``, ``trans`` and ``weights`` have the shape of the samples; ``trans_final`` is one number a ray."""

    alphas: Tensor
    trans: Tensor
    weights: Tensor
    trans_final: Tensor


def composite(sigmas: Tensor, deltas: Tensor) -> Composite:
    """Composite dense samples.

    Args:
        sigmas: extinction coefficients (..., n_samples) >= 0, in 1/u.
        deltas: segment lengths, broadcastable to ``sigmas``, in u.

    Returns:
        ``alphas``, ``trans`` and ``weights`` (..., n_samples), ``trans_final`` (...).
    """
    tau = sigmas * deltas
    inclusive = torch.cumsum(tau, dim=-1)
    # Shifted, not "inclusive - tau": the difference would cancel digits behind an opaque segment.
    exclusive = torch.cat([torch.zeros_like(tau[..., :1]), inclusive[..., :-1]], dim=-1)
    alphas = -torch.expm1(-tau)
    trans = torch.exp(-exclusive)
    final = inclusive[..., -1] if tau.shape[-1] else tau.sum(-1)
    return Composite(alphas, trans, trans * alphas, torch.exp(-final))


def composite_packed(sigmas: Tensor, deltas: Tensor, ray_indices: Tensor, n_rays: int) -> Composite:
    """Composite packed samples.

    Args:
        sigmas: (n_samples,) in 1/u; the samples of one ray stand together, front to back.
        deltas: (n_samples,) in u.
        ray_indices: (n_samples,) int64, not decreasing, each in [0, n_rays).
        n_rays: number of rays; a ray without samples has ``trans_final`` 1.

    Returns:
        ``alphas``, ``trans`` and ``weights`` (n_samples,), ``trans_final`` (n_rays,).

    Raises:
        ValueError: sigmas and ray_indices are not both (n_samples,), or ray_indices decrease.
    """
    if sigmas.shape != ray_indices.shape or sigmas.dim() != 1:
        shapes = f"{tuple(sigmas.shape)} and {tuple(ray_indices.shape)}"
        raise ValueError(f"sigmas and ray_indices must both be (n_samples,), got {shapes}")
    if ray_indices.numel() and bool((ray_indices[1:] < ray_indices[:-1]).any()):
        raise ValueError("ray_indices must not decrease: sort the samples by ray, front to back")
    tau = sigmas * deltas
    # One running sum over all rays, in float64 and with each segment limited, so that neither the rays before nor an
    # opaque segment among them can wash out the digits of this ray.
    limited = tau.double().clamp(max=_OPAQUE)
    inclusive = torch.cumsum(limited, dim=0)
    counts = torch.bincount(ray_indices, minlength=n_rays)
    padded = torch.cat([inclusive.new_zeros(1), inclusive])
    ends = torch.cumsum(counts, dim=0)
    before = padded[ends - counts]
    exclusive = padded[:-1] - before[ray_indices]
    alphas = -torch.expm1(-tau)
    trans = torch.exp(-exclusive).to(tau.dtype)
    trans_final = torch.exp(before - padded[ends]).to(tau.dtype)
    return Composite(alphas, trans, trans * alphas, trans_final)


def accumulate(weights: Tensor, values: Tensor, ray_indices: Tensor | None = None, n_rays: int | None = None) -> Tensor:
    """Weighted sum of sample values along each ray.

    Args:
        weights: (..., n_samples) dense, or (n_samples,) packed.
        values: (..., n_samples, c).
        ray_indices, n_rays: given for packed samples.

    Returns:
        (..., c) dense, (n_rays, c) packed.

    Raises:
        ValueError: ray_indices without n_rays.
    """
    weighted = weights.unsqueeze(-1) * values
    if ray_indices is None:
        return weighted.sum(-2)
    if n_rays is None:
        raise ValueError("packed samples need n_rays")
    return weighted.new_zeros(n_rays, values.shape[-1]).index_add(0, ray_indices, weighted)


def median_depth(sigmas: Tensor, t_starts: Tensor, t_ends: Tensor) -> Tensor:
    """Distance (...) at which the transmittance of a dense ray first falls to 1/2; infinity where it never does.

    All arguments (..., n_samples), one sample or more, in order along the ray: sigmas in 1/u, t_starts and t_ends in u. The
    coefficient is constant inside a segment, so the crossing is exact: the optical depth that is still missing to log 2,
    divided by sigma.
    """
    tau = sigmas * (t_ends - t_starts)
    inclusive = torch.cumsum(tau, dim=-1)
    crossed = inclusive >= math.log(2)
    first = crossed.to(torch.uint8).argmax(-1, keepdim=True)
    missing = math.log(2) - (inclusive - tau).gather(-1, first)
    t = t_starts.gather(-1, first) + missing / sigmas.gather(-1, first)
    t = torch.minimum(torch.maximum(t, t_starts.gather(-1, first)), t_ends.gather(-1, first))
    return torch.where(crossed.any(-1), t.squeeze(-1), torch.inf)
