"""Gaussian splats in plain torch: what the kernels compute, readable, differentiable, and in float64 if asked.

A splat with mean m, scales s, unit quaternion q and opacity o = sigmoid(logit), seen by a pinhole camera (x right, y
down, z forward; t = W m + translation):

- slopes u = t_x / t_z, v = t_y / t_z, centre (f_x u + c_x, f_y v + c_y); A = J W R(q) diag(s) with
  J = [[f_x, 0, -f_x u], [0, f_y, -f_y v]] / t_z, for J alone the slopes clamped to the picture and 0.3 half-fields
  next to it [EWA];
- covariance S = A A^T + 0.3 I in px^2; "mip" opacity o rho, rho = sqrt(det A A^T / det S), at least 0.005
  [Mip-Splatting];
- alpha = min(0.99, o rho exp(-d^T S^-1 d / 2)) at pixel centres, 0 below 1/255; w = T alpha, T *= 1 - alpha, in the
  order of t_z (its float32 bits less those of the near plane, shifted by 5), ties by index; a pixel ends with the splat
  where T < early_stop_eps;
- colour max(0, 1/2 + sum_k k Y(d)), d from the camera to m; the picture is sum w c + T background [3DGS].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfvol.kernels.splat_state import SplatOptions, SplatView
from nerfvol.sh import eval_colour
from nerfvol.splats.splats import Splats

TILE = 16
LOW_PASS = 0.3
LEAST_RHO = 0.005
ALPHA_MIN, ALPHA_MAX = 1 / 255, 0.99
SSIM_1, SSIM_2 = 1e-4, 9e-4
DEPTH_SHIFT, DEPTH_BITS = 5, 22


@dataclass(frozen=True)
class Parameters:
    """means (n, 3), log_scales (n, 3), quats (n, 4), logits (n,), sh (n, 3, K); any one floating type."""

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logits: Tensor
    sh: Tensor

    @classmethod
    def of(cls, splats: Splats, dtype: torch.dtype = torch.float64, requires_grad: bool = False) -> Parameters:
        """A copy of the splats' arrays as tensors of ``dtype``; means stay relative to the splats' origin."""
        arrays = (splats.means, splats.log_scales, splats.quats, splats.logits, splats.sh)
        return cls(*(torch.tensor(a, dtype=dtype, requires_grad=requires_grad) for a in arrays))

    def tensors(self) -> tuple[Tensor, ...]:
        """All five, in the order of the fields."""
        return self.means, self.log_scales, self.quats, self.logits, self.sh


@dataclass(frozen=True)
class Footprints:
    """What a camera sees of n splats: centre (n, 2) and covariance (n, 2, 2) in pixels, opacity (n,) with rho, colour (n, 3),
    depth t_z (n,), normal (n, 3), order (m,): those that may be seen, front to back."""

    centre: Tensor
    covariance: Tensor
    opacity: Tensor
    colour: Tensor
    depth: Tensor
    normal: Tensor
    order: Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """(n, 3, 3) of quaternions (n, 4) of any length."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def depth_keys(depth: Tensor, near: float) -> np.ndarray:
    """(n,) integers by which splats are ordered."""
    bits = depth.detach().to(torch.float32).numpy().view(np.int32).astype(np.int64)
    first = int(np.float32(near).view(np.int32))
    return np.minimum((bits - first) >> DEPTH_SHIFT, (1 << DEPTH_BITS) - 1)


def _slopes(t: Tensor, f: float, c: float, size: int, axis: int) -> Tensor:
    margin = 0.15 * size / f
    return (t[:, axis] / t[:, 2]).clamp(-c / f - margin, (size - c) / f + margin)


def moved(view: SplatView, motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation (3, 3), translation (3,) and eye (3,) of a view after a motion (w, v) (6,): its axes see what they saw at t at
    exp([w]) t + v."""
    rotation, translation = (torch.tensor(a, dtype=motion.dtype) for a in (view.rotation, view.translation))
    x, y, z, zero = *motion[:3], motion.new_zeros(())
    turn = torch.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3))
    rotation, translation = turn @ rotation, turn @ translation + motion[3:]
    return rotation, translation, -rotation.T @ translation


def project(p: Parameters, view: SplatView, mode: str, motion: Tensor | None = None) -> Footprints:
    """How ``view``, after a ``motion`` (6,) (default: none), sees the splats ``p``."""
    dtype = p.means.dtype
    rotation, translation, eye = moved(view, torch.zeros(6, dtype=dtype) if motion is None else motion)
    t = p.means @ rotation.T + translation
    x, y, z = t.unbind(-1)
    u, v = _slopes(t, view.fx, view.cx, view.width, 0), _slopes(t, view.fy, view.cy, view.height, 1)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([view.fx / z, zero, -view.fx * u / z, zero, view.fy / z, -view.fy * v / z], -1).reshape(
        -1, 2, 3
    )
    axes = rotation_matrices(p.quats)
    a = jacobian @ rotation @ (axes * p.log_scales.exp()[:, None, :])
    flat = a @ a.transpose(1, 2)
    covariance = flat + LOW_PASS * torch.eye(2, dtype=dtype)
    opacity = torch.sigmoid(p.logits)
    if mode == "mip":
        flat_det = torch.linalg.cross(a[:, 0], a[:, 1]).square().sum(-1)
        ratio = flat_det / torch.det(covariance)
        opacity = opacity * ratio.clamp_min(LEAST_RHO**2).sqrt()
    ray = p.means - eye
    direction = ray / ray.norm(dim=-1, keepdim=True)
    colour = eval_colour(p.sh, direction).clamp_min(0)
    shortest = axes[torch.arange(len(axes)), :, p.log_scales.argmin(-1)]
    normal = torch.where((shortest * direction).sum(-1, keepdim=True) < 0, shortest, -shortest)
    centre = torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], -1)
    seen = ((z > view.near) & (opacity > ALPHA_MIN)).detach().numpy()
    order = np.flatnonzero(seen)
    order = order[np.argsort(depth_keys(z, view.near)[order], kind="stable")]
    return Footprints(centre, covariance, opacity, colour, z, normal, torch.from_numpy(order))


@dataclass(frozen=True)
class Tile:
    """A tile of 16x16 pixels: its corner, the splats that may touch it front to back (m,), their alphas (256, m)."""

    left: int
    top: int
    splats: Tensor
    alpha: Tensor


def tiles(f: Footprints, view: SplatView) -> Iterator[Tile]:
    """All tiles of the picture, row by row."""
    with torch.no_grad():
        reach = 2 * torch.log(255 * f.opacity.clamp_min(1e-30))
        half = (reach.clamp_min(0)[:, None] * torch.diagonal(f.covariance, dim1=1, dim2=2)).sqrt() + 1
        low, high = (f.centre - half)[f.order], (f.centre + half)[f.order]
    for top in range(0, view.height, TILE):
        for left in range(0, view.width, TILE):
            corner = torch.tensor([left, top])
            near = ((high >= corner) & (low <= corner + TILE)).all(-1)
            splats = f.order[near]
            grid = torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="ij")
            pixels = torch.stack([grid[1].ravel() + left, grid[0].ravel() + top], -1) + 0.5
            d = pixels[:, None].to(f.centre.dtype) - f.centre[splats]
            conic = torch.linalg.inv(f.covariance[splats])
            power = -0.5 * torch.einsum("pni,nij,pnj->pn", d, conic, d)
            alpha = (f.opacity[splats] * power.exp()).clamp_max(ALPHA_MAX)
            yield Tile(left, top, splats, torch.where(alpha < ALPHA_MIN, 0.0, alpha))


def weights(alpha: Tensor, early_stop_eps: float, start: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Weights (p, n) and what passes (p,), front to back along the last axis. start: transmittance before (p,)."""
    first = alpha.new_ones(len(alpha)) if start is None else start
    before = torch.cat([first[:, None], first[:, None] * torch.cumprod(1 - alpha, -1)[:, :-1]], -1)[:, : alpha.shape[1]]
    alpha = torch.where(before < early_stop_eps, 0.0, alpha)
    return before * alpha, first * torch.prod(1 - alpha, -1)


def render(
    p: Parameters, view: SplatView, background: Sequence[float], early_stop_eps: float = 0.0, mode: str = "mip"
) -> dict[str, Tensor]:
    """All outputs of splat_ops.render_splats, (height, width[, 3]), in the parameters' type."""
    f = project(p, view, mode)
    rows, columns = -(-view.height // TILE) * TILE, -(-view.width // TILE) * TILE
    shapes = {"rgb": 3, "opacity": 1, "depth": 1, "median_depth": 1, "normal": 3}
    out = {name: p.means.new_zeros(rows, columns, k) for name, k in shapes.items()}
    for tile in tiles(f, view):
        w, passed = weights(tile.alpha, early_stop_eps)
        z = f.depth[tile.splats]
        after = 1 - torch.cumsum(w, -1)
        crossing = (after <= 0.5) & (after + w > 0.5)
        values = {
            "rgb": w @ f.colour[tile.splats] + passed[:, None] * passed.new_tensor(background),
            "opacity": 1 - passed[:, None],
            "depth": (w @ z)[:, None],
            "median_depth": (crossing * z).sum(-1, keepdim=True),
            "normal": w @ f.normal[tile.splats],
        }
        for name, value in values.items():
            place = (slice(tile.top, tile.top + TILE), slice(tile.left, tile.left + TILE))
            out[name][place] = value.reshape(TILE, TILE, -1)
    x = (torch.arange(columns, dtype=p.means.dtype) + 0.5 - view.cx) / view.fx
    y = (torch.arange(rows, dtype=p.means.dtype) + 0.5 - view.cy) / view.fy
    length = (1 + x.square()[None, :] + y.square()[:, None]).sqrt()[..., None]
    out["depth"], out["median_depth"] = out["depth"] * length, out["median_depth"] * length
    cut = {name: a[: view.height, : view.width] for name, a in out.items()}
    return {name: a if shapes[name] == 3 else a[..., 0] for name, a in cut.items()}


def ssim_loss(colour: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM of blocks of 4x4 pixels of a tile (256, 3), row by row: (16 blocks, 3)."""

    def blocks(a: Tensor) -> Tensor:
        return a.reshape(4, 4, 4, 4, 3).permute(0, 2, 1, 3, 4).reshape(16, 16, 3)

    x, y = blocks(colour), blocks(target)
    mu, nu = x.mean(1), y.mean(1)
    dx, dy = x - mu[:, None], y - nu[:, None]
    a = (2 * mu * nu + SSIM_1) * (2 * (dx * dy).mean(1) + SSIM_2)
    b = (mu.square() + nu.square() + SSIM_1) * (dx.square().mean(1) + dy.square().mean(1) + SSIM_2)
    return 1 - a / b


@dataclass
class LossParts:
    """The loss of one view and what a step's report and statistics need; the last three by splat (n,). of_pixels: without the
    terms of the splats themselves."""

    loss: Tensor
    of_pixels: float
    squared_error: float
    hit: Tensor
    error: Tensor
    max_weight: Tensor


def loss(
    p: Parameters,
    view: SplatView,
    image: np.ndarray,
    options: SplatOptions,
    mode: str = "mip",
    motion: Tensor | None = None,
) -> LossParts:
    """What a training step minimises, over the image's pixels with weight m = alpha / 255, M their sum; of the view after a
    ``motion`` (6,) (default: none).

    (1/M) sum m mean_c (l1 |C - t| + squared (C - t)^2)
    + (1/M) ssim sum over blocks without a masked pixel of 16 mean_c (1 - SSIM) / 2
    + scale mean_splats sum s + opacity mean_splats o, the last two for splats that are hit.
    """
    f = project(p, view, mode, motion)
    background = p.means.new_tensor(options.background)
    total, squared = p.means.new_zeros(()), 0.0
    hit = torch.zeros(len(p.means), dtype=torch.bool)
    error, largest = torch.zeros(len(p.means), dtype=p.means.dtype), torch.zeros(len(p.means), dtype=p.means.dtype)
    pixels = torch.from_numpy(image.astype(np.float64) / 255).to(p.means.dtype)
    valid = float(pixels[..., 3].sum())
    for tile in tiles(f, view):
        place = (slice(tile.top, tile.top + TILE), slice(tile.left, tile.left + TILE))
        target, mask = pixels[place][..., :3].reshape(-1, 3), pixels[place][..., 3].reshape(-1)
        start = (mask > 0).to(mask.dtype)
        with torch.no_grad():
            strongest = weights(tile.alpha, options.early_stop_eps, start)[0].amax(0)
            lines = strongest > options.weight_threshold
        alpha = torch.where(lines, tile.alpha, tile.alpha.detach())
        colours = torch.where(lines[:, None], f.colour[tile.splats], f.colour[tile.splats].detach())
        w, passed = weights(alpha, options.early_stop_eps, start)
        colour = w @ colours + passed[:, None] * background
        e = colour - target
        of_pixel = mask * (options.l1 * e.abs() + options.squared * e.square()).mean(-1)
        total = total + of_pixel.sum()
        whole = (mask.reshape(4, 4, 4, 4).permute(0, 2, 1, 3).reshape(16, 16) == 1).all(1)
        total = total + options.ssim * 8 * (ssim_loss(colour, target).mean(-1) * whole).sum()
        with torch.no_grad():
            squared += float((mask * e.square().mean(-1)).sum())
            hit[tile.splats[lines]] = True
            error[tile.splats[lines]] += (of_pixel @ w)[lines]
            largest[tile.splats] = torch.maximum(largest[tile.splats], torch.where(lines, strongest, 0.0))
    total = total / max(valid, 1e-30) if valid else total * 0
    n, of_pixels = max(len(p.means), 1), float(total.detach())
    total = total + options.scale * (p.log_scales.exp().sum(-1) * hit).sum() / n
    total = total + options.opacity * (torch.sigmoid(p.logits) * hit).sum() / n
    return LossParts(total, of_pixels, squared / max(valid, 1e-30), hit, error, largest)


def gradients(
    p: Parameters, view: SplatView, image: np.ndarray, options: SplatOptions, mode: str = "mip"
) -> tuple[Tensor, ...]:
    """Of :func:`loss`, by autograd, each in the shape of its parameter and the order of Parameters.tensors().

    image: (H16, W16, 4) uint8; ``p`` must require gradients.
    """
    parts = loss(p, view, image, options, mode)
    found = torch.autograd.grad(parts.loss, p.tensors(), allow_unused=True)
    return tuple(torch.zeros_like(a) if g is None else g for a, g in zip(p.tensors(), found, strict=True))
