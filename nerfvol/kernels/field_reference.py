"""Compiled fields in plain torch: what the kernels compute, readable, differentiable, and in float64 if asked.

A ray enters the region at t_0 (or its near plane) and is cut at the edges of ``layout.step_edges``, shifted by its jitter; a
step counts where its middle lies inside the region and in an occupied cell. With sigma_i and c_i the field's at the middles,
tau_i = sigma_i delta_i, T_i = exp(-sum_{j<i} tau_j), w_i = T_i (1 - exp(-tau_i)), until T < early_stop_eps behind a sample:

    C = sum w_i c_i + T background

    loss = mean |C - target|^2 + colour mean (sum w_i |c_i - target|^2 + T |background - target|^2)
         + distortion mean_rays (sum_ij w_i w_j |m_i - m_j| + sum w_i^2 delta_i / 3) + entropy mean_rays H(T)

means over rays and channels where nothing else is said; m and delta in edges of the inner cube;
H(T) = -T log T - (1 - T) log(1 - T), T limited to [1e-4, 1 - 1e-4]. The network, its encodings and its head are
``nerfvol.field.fields``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfvol.field.fields import NeuralField, make_field
from nerfvol.field.occupancy import Samples
from nerfvol.field.sampling import intersect_aabb
from nerfvol.kernels.field_state import FieldBatch, FieldLoss, FieldRates, FieldState, FieldStepReport, Float, March
from nerfvol.quadrature import accumulate, composite_packed


def as_field(state: FieldState, dtype: torch.dtype = torch.float64) -> NeuralField:
    """The same field in torch, its parameters copied."""
    field = make_field(state.domain, state.shape).to(dtype)
    flat, at = torch.from_numpy(state.network.copy()), 0
    for name, parameter in field.named_parameters():
        if name == "encoding.table":
            parameter.data.copy_(torch.from_numpy(state.table))
            continue
        parameter.data.copy_(flat[at : at + parameter.numel()].view_as(parameter))
        at += parameter.numel()
    return field


def from_field(field: NeuralField) -> FieldState:
    """The state whose values are a torch field's: the inverse of :func:`as_field`, moments zero."""
    state = FieldState(field.domain, field.shape)
    named = dict(field.named_parameters())
    table = named.pop("encoding.table", None)
    if table is not None:
        state.table[...] = table.detach().numpy()
    state.network[...] = torch.cat([p.detach().reshape(-1) for p in named.values()]).numpy()
    return state


def march_rays(state: FieldState, batch: FieldBatch, march: March, dtype: torch.dtype = torch.float64) -> Samples:
    """Packed samples of all rays, each step looked at: no coarse cells."""
    o, d = (torch.from_numpy(a).to(dtype) for a in (batch.rays_o, batch.rays_d))
    where, domain = march.occupancy, state.domain
    near, far = intersect_aabb(o, d, domain.aabb.to(dtype))
    near = near.clamp(min=march.near_plane)
    edges = torch.from_numpy(march.edges).to(dtype)
    start = near + (torch.from_numpy(batch.jitter).to(dtype) - 0.5) * float(edges[1])
    t = start[:, None] + edges
    middle = (t[:, 1:] + t[:, :-1]) / 2
    x = domain.scaled(o[:, None] + d[:, None] * middle[..., None])
    keep = torch.from_numpy(where.cells().reshape(-1))[_cells(x, march)]
    keep &= (middle < far[:, None]) & (middle >= near[:, None])
    rays, steps = keep.nonzero(as_tuple=True)
    return Samples(rays, t[rays, steps], t[rays, steps + 1])


def _cells(x: Tensor, march: March) -> Tensor:
    """Flat cells of points (..., 3) in units of the inner cube, in the smallest cube that holds each."""
    r, last = march.occupancy.resolution, march.occupancy.cubes - 1
    size = x.abs().amax(-1).clamp(min=1e-6)
    cube = torch.log2(size).ceil().clamp(0, last)
    ijk = ((x / torch.exp2(cube)[..., None] + 1) * (r / 2)).long().clamp(0, r - 1)
    return ((cube.long() * r + ijk[..., 0]) * r + ijk[..., 1]) * r + ijk[..., 2]


@dataclass(frozen=True)
class Drawn:
    """Rays of a field: colour (n, 3), trans (n,), weights and rgb of the samples (m,), (m, 3), and which those are."""

    colour: Tensor
    trans: Tensor
    weights: Tensor
    rgb: Tensor
    samples: Samples


def draw(field: NeuralField, batch: FieldBatch, samples: Samples, background: Sequence[float], eps: float) -> Drawn:
    """Compositing of ``samples``; those behind the end of their ray are dropped."""
    dtype = samples.t_starts.dtype
    o, d = (torch.from_numpy(a).to(dtype) for a in (batch.rays_o, batch.rays_d))
    sigmas, rgb = field(samples.positions(o, d), d[samples.ray_indices])
    deltas = samples.t_ends - samples.t_starts
    with torch.no_grad():
        kept = composite_packed(sigmas, deltas, samples.ray_indices, len(o)).trans >= eps
    samples = Samples(*(column[kept] for column in samples))
    rgb = rgb[kept]
    parts = composite_packed(sigmas[kept], deltas[kept], samples.ray_indices, len(o))
    colour = accumulate(parts.weights, rgb, samples.ray_indices, len(o))
    colour = colour + parts.trans_final[:, None] * torch.tensor(background, dtype=dtype)
    return Drawn(colour, parts.trans_final, parts.weights, rgb, samples)


def loss(field: NeuralField, batch: FieldBatch, samples: Samples, options: FieldLoss) -> tuple[Tensor, Tensor]:
    """All terms, and the mean squared error alone."""
    drawn = draw(field, batch, samples, options.background, options.early_stop_eps)
    dtype = drawn.colour.dtype
    target, background = torch.from_numpy(batch.target).to(dtype), torch.tensor(options.background, dtype=dtype)
    error = (drawn.colour - target).square().mean()
    rays, n = drawn.samples.ray_indices, len(target)
    total = error
    if options.colour > 0:
        apart = (drawn.rgb - target[rays]).square().mean(-1)
        behind = (background - target).square().mean(-1)
        total = total + options.colour / n * ((drawn.weights * apart).sum() + (drawn.trans * behind).sum())
    if options.distortion > 0:
        total = total + options.distortion / n * _distortion(drawn, field.domain.half)
    if options.entropy > 0:
        t = drawn.trans.clamp(1e-4, 1 - 1e-4)
        total = total - options.entropy / n * (t * t.log() + (1 - t) * (1 - t).log()).sum()
    return total, error


def _distortion(drawn: Drawn, half: float) -> Tensor:
    """Sum over rays, over all pairs of samples of a ray."""
    samples, w = drawn.samples, drawn.weights
    middle = (samples.t_starts + samples.t_ends) / (4 * half)
    same = samples.ray_indices[:, None] == samples.ray_indices
    pairs = (w[:, None] * w * (middle[:, None] - middle).abs() * same).sum()
    return pairs + (w.square() * (samples.t_ends - samples.t_starts)).sum() / (6 * half)


def loss_gradient(
    state: FieldState, batch: FieldBatch, march: March, options: FieldLoss, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients in table (entries, features) and network (n,), and the loss."""
    field = as_field(state, dtype)
    total, _ = loss(field, batch, march_rays(state, batch, march, dtype), options)
    named = dict(field.named_parameters())
    grads = dict(zip(named, torch.autograd.grad(total, list(named.values()), allow_unused=True), strict=True))
    table = grads.pop("encoding.table", None)
    table = torch.zeros(state.table.shape, dtype=dtype) if table is None else table
    parts = [torch.zeros(named[name].numel(), dtype=dtype) if g is None else g.reshape(-1) for name, g in grads.items()]
    return table, torch.cat(parts), total.detach()


def adam(
    values: Float, first: Float, second: Float, gradient: np.ndarray, rates: FieldRates, decay: float, n: int
) -> None:
    """Adam's n-th update of numbers that have a gradient, in place, the decay inside the gradient [L2, not AdamW]."""
    touched = gradient != 0
    g = gradient[touched] + decay * values[touched].astype(np.float64)
    m = rates.beta1 * first[touched] + (1 - rates.beta1) * g
    v = rates.beta2 * second[touched] + (1 - rates.beta2) * g * g
    first[touched], second[touched] = m, v
    moved = m / (1 - rates.beta1**n) / (np.sqrt(v / (1 - rates.beta2**n)) + rates.eps)
    values[touched] -= (rates.rate * moved).astype(values.dtype)


def train_step(
    state: FieldState,
    batch: FieldBatch,
    march: March,
    options: FieldLoss,
    rates: FieldRates,
    moves: Sequence[bool] | None = None,
) -> FieldStepReport:
    """One step on ``state`` in place, see field_ops.train_step."""
    table, network, total = loss_gradient(state, batch, march, options)
    state.table_gradient += table.numpy().astype(np.float32)
    for level in range(state.n_levels):
        if moves is None or moves[level]:
            assert state.levels is not None
            part = slice(state.levels.starts[level], state.levels.starts[level + 1])
            state.updates[level] += 1
            values, gradient = state.table[part], state.table_gradient[part]
            first, second = state.table_first[part], state.table_second[part]
            adam(values, first, second, gradient, rates, rates.table_decay, int(state.updates[level]))
            gradient[...] = 0
    state.updates[-1] += 1
    first, second = state.network_first, state.network_second
    adam(state.network, first, second, network.numpy(), rates, rates.network_decay, int(state.updates[-1]))
    samples = march_rays(state, batch, march)
    return FieldStepReport(float(total), float("nan"), len(samples.t_starts), len(samples.t_starts))
