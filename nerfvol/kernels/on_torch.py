"""The operators in torch: differentiable in the octree's values, and what runs where no compiled kernels are.

Only this module and ``reference`` import torch, so that training an octree and rendering it start without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from nerfvol.defaults import WHITE
from nerfvol.kernels import reference
from nerfvol.kernels.checks import check_background, check_batch, check_early_stop, check_rays
from nerfvol.kernels.state import (
    OUTPUTS,
    TILE_RAYS,
    Batch,
    LeafStatistics,
    LossOptions,
    Rates,
    StepReport,
    TrainState,
)
from nerfvol.kernels.tree import kernel_batch, kernel_options, kernel_tree
from nerfvol.native import native
from nerfvol.octree import lod
from nerfvol.octree.tree import Octree


def _per_ray(rays_o: ArrayLike, n: int) -> Tensor:
    o = torch.as_tensor(np.asarray(rays_o))
    return o if len(o) == n else o.repeat_interleave(TILE_RAYS, 0)[:n]


def render_rays(
    octree: Octree,
    o: np.ndarray,
    d: np.ndarray,
    bg: Sequence[float],
    eps: float,
    outputs: Sequence[str],
    coarse: float = 0.0,
) -> dict[str, np.ndarray]:
    """ops.render_rays on the reference, with arguments that were checked there.

    o (n, 3) or (ceil(n / 64), 3), d (n, 3): float32; the outputs are (n, 3) or (n,). Where prefiltered nodes are drawn, rays
    are rendered origin by origin, each on the octree cut as seen from there.
    """
    if coarse == 0 or not len(d):
        return _render_leaves(octree, o, d, bg, eps, outputs)
    out = {name: np.empty((len(d), 3) if name in ("rgb", "normal") else len(d), np.float32) for name in outputs}
    origins, of_ray = np.unique(_per_ray(o, len(d)).numpy(), axis=0, return_inverse=True)
    for index, origin in enumerate(origins):
        tree = lod.cut(octree, lod.lod_cut(octree, origin, coarse))
        rays = np.flatnonzero(of_ray.reshape(-1) == index)
        part = _render_leaves(tree, np.repeat(origin[None], len(rays), axis=0), d[rays], bg, eps, outputs)
        for name in outputs:
            out[name][rays] = part[name]
    return {name: out[name] for name in OUTPUTS if name in outputs}


def _render_leaves(
    octree: Octree,
    o: np.ndarray,
    d: np.ndarray,
    bg: Sequence[float],
    eps: float,
    outputs: Sequence[str],
    chunk: int = 16384,
) -> dict[str, np.ndarray]:
    parts = []
    values = torch.from_numpy(octree.values)
    origins, directions = _per_ray(o, len(d)), torch.from_numpy(d)
    with torch.no_grad():
        for ro, rd in zip(origins.split(chunk), directions.split(chunk), strict=True):
            rgb, trans, depth = reference.render(octree, values, ro, rd, torch.tensor(bg), eps)
            part = {"rgb": rgb, "opacity": 1 - trans, "depth": depth}
            if "median_depth" in outputs:
                part["median_depth"] = reference.median_depth(
                    octree, reference.sample(octree, values, ro, rd, eps), len(rd)
                )
            if "normal" in outputs:
                part["normal"] = reference.normals(octree, values, ro, rd, eps)
            parts.append(part)
    return {k: torch.cat([p[k] for p in parts]).numpy() for k in OUTPUTS if k in outputs}


class _Render(torch.autograd.Function):
    """The compiled renderer and its adjoint, for autograd."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, octree: Octree, o: np.ndarray, d: np.ndarray, bg: Sequence[float], eps: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        compiled = native()
        assert compiled is not None
        n = len(d)
        rgb, trans, depth = (np.empty(shape, np.float32) for shape in ((n, 3), n, n))
        compiled.render(kernel_tree(octree, values.detach().numpy()), o, d, bg, eps, rgb, trans, depth, None, None)
        ctx.saved = (values.detach(), octree, o, d, bg, eps)
        return torch.from_numpy(rgb), torch.from_numpy(trans), torch.from_numpy(depth)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        compiled = native()
        assert compiled is not None
        values, octree, o, d, bg, eps = ctx.saved
        gradient = torch.zeros_like(values)
        slots = np.full(octree.n_vertices, -1, np.int32)
        cotangents = (g.contiguous().numpy() for g in grad_outputs)
        compiled.render_backward(
            kernel_tree(octree, values.numpy()), o, d, bg, eps, *cotangents, gradient.numpy(), slots
        )
        return gradient, None, None, None, None, None


def render_values(
    octree: Octree,
    values: Tensor,
    rays_o: ArrayLike,
    rays_d: ArrayLike,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Differentiable rendering with vertex rows ``values`` (n_vertices, row) in place of the octree's own.

    rays_o: (n, 3) or (ceil(n / 64), 3); rays_d: (n, 3). Returns rgb (n, 3), transmittance (n,), expected distance (n,);
    gradients flow to ``values``. float64 values run on the reference, float32 on the compiled kernels where they exist.
    Raises ValueError where the values do not have the octree's shape, where background or threshold are not what they should
    be, and, of rays for the kernels, as ops.render_rays does.
    """
    if values.shape != octree.values.shape:
        raise ValueError(f"values must have the octree's shape {octree.values.shape}, got {tuple(values.shape)}")
    bg, early_stop_eps = check_background(background), check_early_stop(early_stop_eps)
    if values.dtype == torch.float32 and native() is not None:
        o, d = check_rays(rays_o, rays_d)
        return _Render.apply(values.contiguous(), octree, o, d, bg, float(early_stop_eps))
    directions = torch.as_tensor(np.asarray(rays_d)).to(values.dtype)
    origins = _per_ray(rays_o, len(directions)).to(values.dtype)
    return reference.render(octree, values, origins, directions, torch.tensor(bg, dtype=values.dtype), early_stop_eps)


def loss_gradient(octree: Octree, values: Tensor, batch: Batch, options: LossOptions) -> Tensor:
    """Gradient of the training loss in ``values`` (n_vertices, row); float64 on the reference, float32 compiled.

    Raises ValueError where the batch's parts or the values do not fit.
    """
    o, d, _, _ = check_batch(batch, options)
    if values.dtype == torch.float32 and (compiled := native()) is not None:
        gradient = torch.zeros_like(values)
        slots = np.full(octree.n_vertices, -1, np.int32)
        tree = kernel_tree(octree, values.detach().contiguous().numpy())
        compiled.loss_gradient(
            tree, kernel_batch(o, d, batch), kernel_options(options), gradient=gradient.numpy(), slots=slots
        )
        return gradient
    leaf = values.detach().clone().requires_grad_()
    total, _ = _reference_loss(octree, leaf, batch, options)
    return torch.autograd.grad(total, leaf)[0]


def _reference_loss(
    octree: Octree, values: Tensor, batch: Batch, options: LossOptions
) -> tuple[Tensor, dict[str, Any]]:
    live = torch.from_numpy(batch.weight > 0)
    to = lambda a: torch.as_tensor(np.asarray(a)).to(values.dtype)  # noqa: E731
    origins, directions = _per_ray(batch.rays_o, len(batch.rays_d)), to(batch.rays_d)
    total, report = reference.loss(
        octree, values, to(origins)[live], directions[live], to(batch.target)[live], to(batch.weight)[live], options
    )
    report["live"] = live
    return total, report


def train_step(
    octree: Octree, state: TrainState, batch: Batch, options: LossOptions, rates: Rates, pixel_angle: float
) -> StepReport:
    """ops.train_step on the reference, with arguments that were checked there."""
    values = torch.from_numpy(octree.values)
    leaf = values.clone().requires_grad_()
    total, report = _reference_loss(octree, leaf, batch, options)
    gradient = torch.autograd.grad(total, leaf)[0]
    with torch.no_grad():
        leaves = report["samples"].segments.leaf
        touched = torch.from_numpy(octree.corners).long()[leaves].flatten().unique()
        g, moments = gradient[touched], torch.from_numpy(state.moments)
        old = moments[touched]
        new = torch.where(old > 0, rates.beta * old + (1 - rates.beta) * g * g, g * g)
        moments[touched] = new
        values[touched] -= _rate_row(octree, rates) * g / (new.sqrt() + rates.eps)
    return _add_statistics(octree, batch, report, pixel_angle, state)


def leaf_statistics(
    octree: Octree, batch: Batch, options: LossOptions, pixel_angle: float, into: LeafStatistics
) -> StepReport:
    """ops.leaf_statistics on the reference, with arguments that were checked there."""
    with torch.no_grad():
        _, report = _reference_loss(octree, torch.from_numpy(octree.values), batch, options)
    return _add_statistics(octree, batch, report, pixel_angle, into)


@torch.no_grad()
def _add_statistics(octree: Octree, batch: Batch, report: dict, pixel_angle: float, into: LeafStatistics) -> StepReport:
    samples: reference.Samples = report["samples"]
    seg, weight = samples.segments, torch.from_numpy(batch.weight)[report["live"]]
    max_weight, footprint = torch.from_numpy(into.max_weight), torch.from_numpy(into.footprint)
    max_weight.scatter_reduce_(0, seg.leaf, samples.weights.detach(), "amax")
    error = samples.weights.detach() * (weight * report["squared_error"])[seg.ray]
    torch.from_numpy(into.error).index_add_(0, seg.leaf, error)
    side = torch.from_numpy(octree.leaf_sizes()).float()[seg.leaf]
    footprint.scatter_reduce_(0, seg.leaf, side / (samples.middle.clamp_min(1e-6) * pixel_angle), "amax")
    squared = float((weight * report["squared_error"]).sum())
    return StepReport(squared / max(3 * float(weight.sum()), 1e-30), len(seg.ray) / max(len(batch.rays_d), 1))


def _rate_row(octree: Octree, rates: Rates) -> Tensor:
    row = torch.full((octree.values.shape[1],), float(rates.sh))
    row[[0, 4, 8]] = rates.dc
    row[12] = rates.density
    row[13:16] = 0
    return row
