"""Where to look along a ray: stratified samples, importance samples by inverse CDF, and the box a ray crosses.

Distances t are in scene units along unit directions. Random numbers come in as tensors or as a generator made by
``step_generator``: counter based, so that step k of a run draws the same numbers however often the run was interrupted.
"""

import torch
from torch import Tensor

from nerfvol.field.counters import mixed


def step_generator(seed: int, step: int, stream: int = 0) -> torch.Generator:
    """Generator that depends on (seed, step, stream) alone."""
    return torch.Generator().manual_seed(mixed(seed, step, stream) >> 1)


def intersect_aabb(rays_o: Tensor, rays_d: Tensor, aabb: Tensor) -> tuple[Tensor, Tensor]:
    """Distances at which rays enter and leave a box (slab method).

    Args:
        rays_o, rays_d: (n, 3); directions unit.
        aabb: (2, 3), lower and upper corner.

    Returns:
        near, far, each (n,), with 0 <= near; a ray that misses has far = near.
    """
    # A zero component becomes a tiny one: its slab distances are then huge with the right signs, never 0 * inf.
    tiny = torch.finfo(rays_d.dtype).tiny * 1e6
    safe = torch.where(rays_d.abs() < tiny, torch.full_like(rays_d, tiny), rays_d)
    to_lower, to_upper = (aabb[0] - rays_o) / safe, (aabb[1] - rays_o) / safe
    near = torch.minimum(to_lower, to_upper).amax(-1).clamp(min=0)
    far = torch.maximum(to_lower, to_upper).amin(-1)
    return near, torch.maximum(far, near)


def stratified(near: Tensor, far: Tensor, n_samples: int, generator: torch.Generator | None = None) -> Tensor:
    """One sample in each of ``n_samples`` equal bins of [near, far]: uniform, or its middle without a generator.

    Args:
        near, far: (n,).

    Returns:
        (n, n_samples), increasing along each ray.
    """
    if generator is None:
        offset = near.new_full((near.shape[0], n_samples), 0.5)
    else:
        offset = torch.rand(near.shape[0], n_samples, generator=generator, dtype=near.dtype)
    bins = (torch.arange(n_samples, dtype=near.dtype) + offset) / n_samples
    return near[:, None] + (far - near)[:, None] * bins


def edges_of(samples: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Bin edges between sorted samples: the middles, closed by near and far. (n, s) -> (n, s + 1)."""
    middles = (samples[:, 1:] + samples[:, :-1]) / 2
    return torch.cat([near[:, None], middles, far[:, None]], dim=-1)


def inverse_cdf(edges: Tensor, weights: Tensor, n_samples: int, generator: torch.Generator | None = None) -> Tensor:
    """Importance samples from a piecewise-constant density (Mildenhall et al. 2020, section 5.2).

    Args:
        edges: (n, b + 1), increasing: bin edges.
        weights: (n, b) >= 0: mass of each bin, any scale; a ray whose mass is zero is sampled evenly over its length.
        n_samples: samples per ray.
        generator: stratified in the CDF when given, else the middles of ``n_samples`` equal slices of the CDF.

    Returns:
        (n, n_samples) increasing distances, without a gradient.

    Raises:
        ValueError: edges do not have one more column than weights.
    """
    if edges.shape[-1] != weights.shape[-1] + 1:
        raise ValueError(f"edges must have one more column than weights, got {edges.shape[-1]} and {weights.shape[-1]}")
    edges, weights = edges.detach(), weights.detach()
    total = weights.sum(-1, keepdim=True)
    mass = torch.where(total > 0, weights, edges.diff(dim=-1))
    cdf = torch.cumsum(mass, dim=-1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf / cdf[:, -1:]], dim=-1)
    zeros = torch.zeros_like(edges[:, 0])
    u = stratified(zeros, zeros + 1, n_samples, generator)
    # The bin whose CDF interval holds u; right=True steps over empty bins.
    bins = (torch.searchsorted(cdf, u, right=True) - 1).clamp(0, weights.shape[-1] - 1)
    lower, width = cdf.gather(-1, bins), cdf.diff(dim=-1).gather(-1, bins)
    fraction = ((u - lower) / width.clamp(min=torch.finfo(u.dtype).tiny)).clamp(0, 1)
    start = edges.gather(-1, bins)
    return start + (edges.gather(-1, bins + 1) - start) * fraction
