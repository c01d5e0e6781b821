"""A field along rays in torch: samples by importance, colours and compositing, and whole images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from nerfvol.field.fields import RadianceField
from nerfvol.field.occupancy import Samples
from nerfvol.field.sampling import edges_of, inverse_cdf, stratified
from nerfvol.quadrature import Composite, accumulate, composite, composite_packed


def importance_samples(
    field: RadianceField,
    rays_o: Tensor,
    rays_d: Tensor,
    span: tuple[Tensor, Tensor],
    counts: tuple[int, int],
    generator: torch.Generator | None = None,
) -> Samples:
    """Stratified samples, weighed by the field, then as many again where the weight is (Mildenhall et al. 2020, 5.2).

    One network serves for both passes. Returns the segments between the union of both sets of samples.

    Args:
        span: near and far distance of each ray, (n,) each.
        counts: coarse and fine samples of a ray.
    """
    near, far = span
    with torch.no_grad():
        coarse = stratified(near, far, counts[0], generator)
        edges = edges_of(coarse, near, far)
        points = rays_o[:, None] + rays_d[:, None] * coarse[..., None]
        sigmas = field.density(points.reshape(-1, 3)).view_as(coarse)
        weights = composite(sigmas, edges.diff(dim=-1)).weights
        fine = inverse_cdf(edges, weights + 1e-3 / counts[0], counts[1], generator)
        edges = edges_of(torch.cat([coarse, fine], dim=-1).sort(-1).values, near, far)
    rays = torch.arange(len(near)).repeat_interleave(edges.shape[1] - 1)
    return Samples(rays, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1))


def shade(field: RadianceField, samples: Samples, rays_o: Tensor, rays_d: Tensor) -> tuple[Tensor, Tensor, Composite]:
    """Coefficients (n,), colours (n, 3) and compositing of packed samples."""
    sigmas, rgb = field(samples.positions(rays_o, rays_d), rays_d[samples.ray_indices])
    parts = composite_packed(sigmas, samples.t_ends - samples.t_starts, samples.ray_indices, len(rays_o))
    return sigmas, rgb, parts


@torch.no_grad()
def render_field(
    field: RadianceField,
    rays_o: Tensor,
    rays_d: Tensor,
    background: Sequence[float],
    find_samples: Any,
    chunk: int = 4096,
) -> dict[str, Tensor]:
    """Images of a field, a chunk of rays at a time so that memory is bounded.

    Args:
        rays_o, rays_d: (n, 3) float32 (or (3,) for one origin); directions unit.
        background: RGB.
        find_samples: callable (rays_o, rays_d) -> Samples, such as ``FieldTrainer.find_samples``.
        chunk: rays at a time.

    Returns:
        rgb (n, 3) clipped to [0, 1], opacity (n,), depth (n,) expected distance in u, 0 where nothing is met.
    """
    rays_o = rays_o.expand_as(rays_d)
    back = torch.as_tensor(background, dtype=rays_d.dtype)
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for o, d in zip(rays_o.split(chunk), rays_d.split(chunk), strict=True):
        samples = find_samples(o, d)
        rgb, result = _shade_in_pieces(field, samples, o, d)
        middle = (samples.t_starts + samples.t_ends) / 2
        summed = accumulate(result.weights, torch.cat([rgb, middle[:, None]], -1), samples.ray_indices, len(o))
        colour = (summed[:, :3] + result.trans_final[:, None] * back).clamp(0, 1)
        parts.append((colour, 1 - result.trans_final, summed[:, 3]))
    rgb, opacity, depth = (torch.cat(column) for column in zip(*parts, strict=True))
    return {"rgb": rgb, "opacity": opacity, "depth": depth}


def _shade_in_pieces(
    field: RadianceField, samples: Samples, rays_o: Tensor, rays_d: Tensor, piece: int = 65536
) -> tuple[Tensor, Composite]:
    """Colours and compositing, the field evaluated for ``piece`` samples at a time: a ray may have hundreds of them."""
    positions, viewdirs = samples.positions(rays_o, rays_d), rays_d[samples.ray_indices]
    parts = [field(p, v) for p, v in zip(positions.split(piece), viewdirs.split(piece), strict=True)]
    sigmas, rgb = (torch.cat(column) for column in zip(*parts, strict=True))
    return rgb, composite_packed(sigmas, samples.t_ends - samples.t_starts, samples.ray_indices, len(rays_o))
