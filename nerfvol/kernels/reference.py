"""The kernels' operators in plain torch: what they compute, readable, differentiable, and in float64 if asked.

Nothing compiled is called here. One midpoint sample per leaf that a ray crosses; the field inside a leaf is trilinear in
raw density and SH coefficients; compositing is nerfvol.quadrature's. Rays that stop early differ from the kernels by
less than ``early_stop_eps`` in colour: the reference drops the segments behind the one where T fell below it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nerfvol.kernels.state import LossOptions
from nerfvol.octree.rows import DENSITY_SLOT, sh_slots
from nerfvol.octree.topology import MAX_LEVEL, OFFSETS
from nerfvol.octree.tree import Octree
from nerfvol.quadrature import composite_packed
from nerfvol.sh import eval_basis

_PARALLEL = 1e-20  # a direction component below this counts as +1e-20: boxes are half-open, see csrc/traverse.h
_POPCOUNT = torch.tensor([bin(i).count("1") for i in range(256)])


@dataclass(frozen=True)
class Segments:
    """Packed crossings of rays and leaves, by ray and front to back: all (n_segments,); distances in scene units."""

    ray: Tensor
    leaf: Tensor
    t_near: Tensor
    t_far: Tensor


def intersect(octree: Octree, rays_o: Tensor, rays_d: Tensor) -> Segments:
    """All crossings of rays (n, 3) with leaves, level by level through the octree, in the rays' dtype.

    A ray meets a box where its interval [max(t_near, 0), t_far] has positive length. Boxes hold their lower faces only.
    """
    dtype = rays_o.dtype
    origin = torch.as_tensor(octree.origin, dtype=dtype)
    o = (rays_o - origin) / octree.size
    inverse = torch.where(rays_d.abs() < _PARALLEL, torch.full_like(rays_d, 1 / _PARALLEL), 1 / rays_d)
    node_mask, leaf_mask = torch.from_numpy(octree.node_mask).long(), torch.from_numpy(octree.leaf_mask).long()
    first_node, first_leaf = torch.from_numpy(octree.first_node).long(), torch.from_numpy(octree.first_leaf).long()
    offsets = torch.from_numpy(OFFSETS)

    ray = torch.arange(len(rays_o))
    node = torch.zeros(len(rays_o), dtype=torch.long)
    ijk = torch.zeros(len(rays_o), 3, dtype=torch.long)
    found = []
    for level in range(1, MAX_LEVEL + 1):
        child_ijk = ijk[:, None] * 2 + offsets
        lo = child_ijk.to(dtype) / 2**level
        a = (lo - o[ray][:, None]) * inverse[ray][:, None]
        b = (lo + 1 / 2**level - o[ray][:, None]) * inverse[ray][:, None]
        near = torch.minimum(a, b).amax(-1).clamp_min(0)
        far = torch.maximum(a, b).amin(-1)
        hit = far > near
        pair, octant, rank = _met(hit, leaf_mask[node])
        found.append((ray[pair], first_leaf[node[pair]] + rank, near[pair, octant], far[pair, octant]))
        pair, octant, rank = _met(hit, node_mask[node])
        ray, node, ijk = ray[pair], first_node[node[pair]] + rank, child_ijk[pair, octant]
        if not len(ray):
            break
    ray, leaf, near, far = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = torch.argsort(near, stable=True)
    order = order[torch.argsort(ray[order], stable=True)]
    return Segments(ray[order], leaf[order], near[order] * octree.size, far[order] * octree.size)


def _met(hit: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the boxes ``hit`` (n, 8) those whose bit ``present`` (n,) has: row, octant, and rank among the row's bits."""
    octants = torch.arange(8)
    row, octant = (hit & (present[:, None] >> octants & 1).bool()).nonzero(as_tuple=True)
    return row, octant, _POPCOUNT[present[row] & ((1 << octants) - 1)[octant]]


@dataclass(frozen=True)
class Samples:
    """The field at the segments' midpoints, and the quadrature's weights; all packed like the segments."""

    segments: Segments
    rgb: Tensor
    raw: Tensor
    weights: Tensor
    trans_final: Tensor

    @property
    def middle(self) -> Tensor:
        """Distance of each midpoint from its ray's origin, scene units: (n_segments,)."""
        return (self.segments.t_near + self.segments.t_far) / 2


def explin(raw: Tensor) -> Tensor:
    """Torch twin of :func:`nerfvol.octree.rows.explin`, any shape; differentiable without overflow on the unused side."""
    return torch.where(raw < 1, torch.exp(raw.clamp(max=1) - 1), raw)


def sample(octree: Octree, values: Tensor, rays_o: Tensor, rays_d: Tensor, early_stop_eps: float = 0.0) -> Samples:
    """The field along rays (n, 3) and its weights, one midpoint a segment [Max 95].

    values: (n_vertices, row) in the rays' dtype, may require a gradient; early_stop_eps as in ops.render_rays.
    """
    with torch.no_grad():
        seg = intersect(octree, rays_o, rays_d)
        level, ijk = torch.from_numpy(octree.leaf_level), torch.from_numpy(octree.leaf_ijk)
        corners = torch.from_numpy(octree.corners).long()
        side = (octree.size / 2.0 ** level.to(rays_o.dtype))[seg.leaf, None]
        lower = torch.as_tensor(octree.origin, dtype=rays_o.dtype) + ijk[seg.leaf] * side
        middle = (seg.t_near + seg.t_far) / 2
        place = ((rays_o[seg.ray] + middle[:, None] * rays_d[seg.ray] - lower) / side).clamp(0, 1)
        offsets = torch.from_numpy(OFFSETS).to(rays_o.dtype)
        weights = torch.where(offsets == 1, place[:, None], 1 - place[:, None]).prod(-1)
    rows = (weights[:, :, None] * values[corners[seg.leaf]]).sum(1)
    raw = rows[:, DENSITY_SLOT]
    basis = eval_basis(octree.sh_degree, rays_d)[seg.ray]
    rgb = 0.5 + (rows[:, torch.from_numpy(sh_slots(octree.sh_degree))] * basis[:, None]).sum(-1)
    sigma = octree.density_scale * explin(raw)
    if early_stop_eps > 0:
        with torch.no_grad():
            trans = composite_packed(sigma, seg.t_far - seg.t_near, seg.ray, len(rays_o)).trans
            kept = trans >= early_stop_eps
        seg = Segments(seg.ray[kept], seg.leaf[kept], seg.t_near[kept], seg.t_far[kept])
        sigma, raw, rgb = sigma[kept], raw[kept], rgb[kept]
    out = composite_packed(sigma, seg.t_far - seg.t_near, seg.ray, len(rays_o))
    return Samples(seg, rgb, raw, out.weights, out.trans_final)


def _per_ray(n: int, ray: Tensor, rows: Tensor) -> Tensor:
    return rows.new_zeros((n, *rows.shape[1:])).index_add(0, ray, rows)


def render(
    octree: Octree, values: Tensor, rays_o: Tensor, rays_d: Tensor, background: Tensor, early_stop_eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb (n, 3) over ``background`` (3,), transmittance (n,) and expected distance sum_i w_i t_i (n,)."""
    s = sample(octree, values, rays_o, rays_d, early_stop_eps)
    n, ray = len(rays_o), s.segments.ray
    rgb = _per_ray(n, ray, s.weights[:, None] * s.rgb) + s.trans_final[:, None] * background
    return rgb, s.trans_final, _per_ray(n, ray, s.weights * s.middle)


def median_depth(octree: Octree, samples: Samples, n_rays: int) -> Tensor:
    """Distance where T first falls to 1/2, exact inside its segment; 0 where it never does: (n_rays,)."""
    seg = samples.segments
    tau = octree.density_scale * explin(samples.raw) * (seg.t_far - seg.t_near)
    before = composite_packed(tau, torch.ones_like(tau), seg.ray, n_rays).trans
    after = before * torch.exp(-tau)
    crossing = ((before > 0.5) & (after <= 0.5)).nonzero()[:, 0]
    t = seg.t_near + (seg.t_far - seg.t_near) * torch.log(2 * before) / tau
    return tau.new_zeros(n_rays).index_copy(0, seg.ray[crossing], t[crossing])


def normals(octree: Octree, values: Tensor, rays_o: Tensor, rays_d: Tensor, early_stop_eps: float) -> Tensor:
    """-sum_i w_i grad(raw) / |grad(raw)| along each ray: (n, 3), pointing out of dense matter."""
    s = sample(octree, values, rays_o, rays_d, early_stop_eps)
    seg = s.segments
    side = (octree.size / 2.0 ** torch.from_numpy(octree.leaf_level).to(rays_o.dtype))[seg.leaf, None]
    ijk = torch.from_numpy(octree.leaf_ijk)[seg.leaf]
    lower = torch.as_tensor(octree.origin, dtype=rays_o.dtype) + ijk * side
    place = ((rays_o[seg.ray] + s.middle[:, None] * rays_d[seg.ray] - lower) / side).clamp(0, 1).requires_grad_()
    offsets = torch.from_numpy(OFFSETS).to(rays_o.dtype)
    with torch.enable_grad():
        weights = torch.where(offsets == 1, place[:, None], 1 - place[:, None]).prod(-1)
        corners = torch.from_numpy(octree.corners).long()[seg.leaf]
        raw = (weights * values.detach()[corners][..., DENSITY_SLOT]).sum()
        gradient = torch.autograd.grad(raw, place)[0]
    norm = gradient.norm(dim=-1, keepdim=True)
    unit = torch.where(norm > 1e-12, gradient / norm.clamp_min(1e-12), torch.zeros_like(gradient))
    return _per_ray(len(rays_o), seg.ray, -s.weights[:, None] * unit)


def distortion(weights: Tensor, middle: Tensor, length: Tensor, ray: Tensor, n_rays: int) -> Tensor:
    """Distortion loss of Mip-NeRF 360 per ray, sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 length_i: (n_rays,).

    Written as the double sum of the definition, ray by ray: slow and plain.
    """
    out = []
    for r in range(n_rays):
        mine = ray == r
        w, m = weights[mine], middle[mine]
        pairs = (w[:, None] * w[None] * (m[:, None] - m[None]).abs()).sum()
        out.append(pairs + (w * w * length[mine]).sum() / 3)
    return torch.stack(out)


SPARSE_KNEE = 0.02
"""Weight of a segment from which on more of it costs little in the sparsity term."""
_EDGES = torch.tensor([(o ^ axis, o) for axis in (1, 2, 4) for o in range(8) if o & axis])
_KNEE_DENSITY, _KNEE_COLOUR = 1.0, 0.1


def roughness(octree: Octree, values: Tensor, leaf: Tensor) -> tuple[Tensor, Tensor]:
    """Differences between neighbouring corners of the leaves (n,), raw density and colour: both (n,).

    Sums over the 12 edges (and all SH coefficients) of |d| - e log(1 + |d| / e): a total variation [Plenoxels] that counts
    differences below e = 1 (density) and 0.1 (coefficients) by their squares, larger ones as they are.
    """
    rows = values[torch.from_numpy(octree.corners).long()[leaf]]
    d = (rows[:, _EDGES[:, 1]] - rows[:, _EDGES[:, 0]]).abs()
    density = d[..., DENSITY_SLOT]
    colour = d[..., torch.from_numpy(sh_slots(octree.sh_degree)).flatten()]
    return (
        (density - _KNEE_DENSITY * torch.log1p(density / _KNEE_DENSITY)).sum(1),
        (colour - _KNEE_COLOUR * torch.log1p(colour / _KNEE_COLOUR)).sum((1, 2)),
    )


def loss(
    octree: Octree, values: Tensor, rays_o: Tensor, rays_d: Tensor, target: Tensor, weight: Tensor, options: LossOptions
) -> tuple[Tensor, dict[str, Any]]:
    """The training loss of a batch (see ops.LossOptions), a scalar, and a report.

    sum_rays weight * ( |C - target|^2 + colour * (sum_i w_i |c_i - target|^2 + T |background - target|^2)
                        + distortion * L_distortion + sparsity * sum_i log(1 + w_i / SPARSE_KNEE)
                        + sum_i length_i / side_i (tv_density * roughness of density + tv_sh * of colour) ),
    distances of the distortion in root cubes; the last sum goes over the leaves that the ray crosses.

    values: (n_vertices, row); rays_o, rays_d, target: (n, 3); weight: (n,). The report has squared_error (n,), a sum over
    channels, and samples, the :class:`Samples`.
    """
    n = len(rays_o)
    background = torch.tensor(options.background, dtype=values.dtype)
    s = sample(octree, values, rays_o, rays_d, options.early_stop_eps)
    ray = s.segments.ray
    rgb = _per_ray(n, ray, s.weights[:, None] * s.rgb) + s.trans_final[:, None] * background
    squared = ((rgb - target) ** 2).sum(-1)
    total = squared
    if options.colour > 0:
        scatter = _per_ray(n, ray, s.weights * ((s.rgb - target[ray]) ** 2).sum(-1))
        total = total + options.colour * (scatter + s.trans_final * ((background - target) ** 2).sum(-1))
    if options.distortion > 0:
        length = (s.segments.t_far - s.segments.t_near) / octree.size
        spread = distortion(s.weights, s.middle / octree.size, length, ray, n)
        total = total + options.distortion * spread
    if options.sparsity > 0:
        total = total + options.sparsity * _per_ray(n, ray, torch.log1p(s.weights / SPARSE_KNEE))
    if options.tv_density > 0 or options.tv_sh > 0:
        density, colour = roughness(octree, values, s.segments.leaf)
        side = torch.from_numpy(octree.leaf_sizes()).to(values.dtype)[s.segments.leaf]
        sides = (s.segments.t_far - s.segments.t_near) / side
        total = total + _per_ray(n, ray, sides * (options.tv_density * density + options.tv_sh * colour))
    report = {"squared_error": squared.detach(), "samples": s}
    return (weight * total).sum(), report
