"""The operators on splats where no compiled kernels are: the reference, in float32, and Adam next to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from nerfvol.kernels import splat_reference
from nerfvol.kernels.splat_reference import LossParts, Parameters
from nerfvol.kernels.splat_state import SplatOptions, SplatRates, SplatReport, SplatState, SplatView
from nerfvol.splats import packing
from nerfvol.splats.packing import PackedSplats
from nerfvol.splats.splats import Splats


def render_splats(
    splats: Splats | PackedSplats, view: SplatView, bg: Sequence[float], eps: float, outputs: Sequence[str]
) -> dict[str, np.ndarray]:
    """splat_ops.render_splats on the reference, (H, W[, 3]), with arguments that were checked there."""
    plain = packing.unpack(splats) if isinstance(splats, PackedSplats) else splats
    with torch.no_grad():
        out = splat_reference.render(Parameters.of(plain, torch.float32), view, bg, eps, plain.mode)
    return {name: value.numpy() for name, value in out.items() if name in outputs}


def gradient_rows(
    state: SplatState, view: SplatView, image: np.ndarray, options: SplatOptions
) -> tuple[np.ndarray, tuple[float, ...], LossParts]:
    """Gradient (n, rows) of the loss in float32, that in the camera's motion (6,), and the loss's parts."""
    p = Parameters.of(state.splats(), torch.float32, requires_grad=True)
    motion = torch.zeros(6, requires_grad=True)
    parts = splat_reference.loss(p, view, image, options, state.mode, motion)
    asked = (*p.tensors(), motion)
    found = torch.autograd.grad(parts.loss, asked, allow_unused=True) if parts.loss.requires_grad else [None] * 6
    rows = [torch.zeros_like(a) if g is None else g for a, g in zip(asked, found, strict=True)]
    return torch.cat([r.reshape(state.n, -1) for r in rows[:5]], dim=1).numpy(), tuple(rows[5].tolist()), parts


def loss_gradient(
    state: SplatState, view: SplatView, image: np.ndarray, options: SplatOptions
) -> tuple[np.ndarray, SplatReport]:
    """splat_ops.loss_gradient on the reference: (n_blocks, rows, 16) float32; the report is as in :func:`train_step`."""
    rows, motion, parts = gradient_rows(state, view, image, options)
    return packing.to_blocks(rows, np.zeros(rows.shape[1], np.float32)), _report(parts, motion)


def _report(parts: LossParts, motion: tuple[float, ...] | None) -> SplatReport:
    return SplatReport(parts.of_pixels, parts.squared_error, int(parts.hit.sum()), 0, 0, motion)


def train_step(
    state: SplatState,
    view: SplatView,
    image: np.ndarray,
    options: SplatOptions,
    rates: SplatRates,
    motion: bool = False,
) -> SplatReport:
    """splat_ops.train_step on the reference, image (H16, W16, 4) uint8; changes ``state`` in place.

    ``visible`` counts the splats that were hit, entries and blocks are 0.
    """
    g, moved, parts = gradient_rows(state, view, image, options)
    hit = parts.hit.numpy()
    adam_step(state, g, hit, rates)
    for name, values in (("error", parts.error), ("max_weight", parts.max_weight)):
        total = state.per_splat(name)
        total[:] = total + values.numpy() if name == "error" else np.maximum(total, values.numpy())
    state.per_splat("seen")[hit] += 1
    return _report(parts, moved if motion else None)


def adam_step(state: SplatState, g: np.ndarray, hit: np.ndarray, rates: SplatRates) -> None:
    """Adam with gradients (n, rows) on the splats where ``hit`` (n,)."""
    n = state.n
    value, first, second = (packing.from_blocks(a, n) for a in (state.params, state.first, state.second))
    updates = state.per_splat("updates")
    updates[hit] += 1
    rate = rate_rows(value, rates)
    m, v = first + (1 - rates.beta1) * (g - first), second + (1 - rates.beta2) * (g * g - second)
    count = updates[:, None].clip(1)
    step = rate * m / (1 - rates.beta1**count) / (np.sqrt(v / (1 - rates.beta2**count)) + rates.eps)
    new_value = value - step
    if rates.most_log_ratio:
        scales = new_value[:, packing.LOG_SCALES]
        new_value[:, packing.LOG_SCALES] = np.minimum(
            scales, np.median(scales, 1, keepdims=True) + rates.most_log_ratio
        )
    fill = packing.padding(g.shape[1])
    for blocks, old, new in ((state.params, value, new_value), (state.first, first, m), (state.second, second, v)):
        rows = np.where(hit[:, None], new, old).astype(np.float32)
        blocks[...] = packing.to_blocks(rows, fill if blocks is state.params else np.zeros_like(fill))


def rate_rows(value: np.ndarray, rates: SplatRates) -> np.ndarray:
    """The rate of each number of splats (n, rows)."""
    out = np.empty_like(value)
    out[:, packing.MEANS] = rates.means * np.exp(value[:, packing.LOG_SCALES].mean(1, keepdims=True))
    out[:, packing.LOG_SCALES], out[:, packing.QUATS], out[:, packing.LOGIT] = (
        rates.log_scales,
        rates.quats,
        rates.logits,
    )
    out[:, packing.SH :] = rates.sh
    out[:, packing.SH :: (value.shape[1] - packing.SH) // 3] = rates.dc
    return out
