"""The operators on octrees: argument checks, autograd, and the choice between compiled kernels and torch reference.

Rays: ``rays_d`` (n, 3) unit directions; ``rays_o`` (n, 3), or (ceil(n / 64), 3) where each run of 64 rays shares its
origin. The kernels are fast when such a run is an 8x8 tile of one image (cameras.tile_pixels).
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nerfvol.kernels import reference
from nerfvol.kernels.state import DEFAULT_EARLY_STOP, WHITE, Batch, LossOptions, Rates, StepReport, TrainState
from nerfvol.native import native
from nerfvol.octree import BLOCKS, Octree

TILE = 64


# ------------------------------------------------------------------ which code runs
def set_threads(n: int) -> None:
    """Threads of the kernels and of torch."""
    if n < 1:
        raise ValueError(f"threads must be at least 1, got {n}")
    torch.set_num_threads(n)
    if (compiled := native()) is not None:
        compiled.set_threads(n)


def get_threads() -> int:
    compiled = native()
    return compiled.get_threads() if compiled is not None else torch.get_num_threads()


def available_isas() -> list[str]:
    """Builds of the kernels that this CPU can run, best first; ["reference"] without compiled kernels."""
    compiled = native()
    return compiled.available_isas() if compiled is not None else ["reference"]


def isa() -> str:
    """The build in use."""
    compiled = native()
    return compiled.isa() if compiled is not None else "reference"


def set_isa(name: str) -> None:
    """Chooses a build: "auto" or one of :func:`available_isas`."""
    compiled = native()
    if compiled is None or not compiled.set_isa(name):
        raise ValueError(f"instruction set {name!r} is not available here, choose from {available_isas()}")


if native() is not None and "NERFVOL_ISA" in os.environ:
    set_isa(os.environ["NERFVOL_ISA"])


def _tree(octree: Octree, values: np.ndarray):
    compiled = native()
    assert compiled is not None
    shape = (octree.n_vertices, 16 * BLOCKS[octree.sh_degree])
    if values.shape != shape or values.dtype != np.float32:
        raise ValueError(f"the octree's values must be float32 {shape}, got {values.dtype} {values.shape}")
    return compiled.Tree(
        octree.node_mask,
        octree.leaf_mask,
        octree.first_node,
        octree.first_leaf,
        octree.corners,
        values,
        octree.sh_degree,
        [float(x) for x in octree.origin],
        octree.size,
        octree.density_scale,
    )


def _check_rays(rays_o, rays_d) -> tuple[np.ndarray, np.ndarray]:
    o, d = (np.ascontiguousarray(a, dtype=np.float32) for a in (rays_o, rays_d))
    if d.ndim != 2 or d.shape[1] != 3:
        raise ValueError(f"rays_d must have shape (n, 3), got {d.shape}")
    if o.ndim != 2 or o.shape[1] != 3 or len(o) not in (len(d), -(-len(d) // TILE)):
        raise ValueError(f"rays_o must have one row per ray or one per {TILE} rays of {len(d)}, got shape {o.shape}")
    for name, a in (("rays_o", o), ("rays_d", d)):
        if not np.isfinite(np.dot(a.ravel(), a.ravel())):  # one pass; unit directions cannot overflow
            raise ValueError(f"{name} must be finite, {int((~np.isfinite(a)).any(1).sum())} rows are not")
    return o, d


def _check_early_stop(eps) -> float:
    if not 0 <= eps < 1:  # also refuses NaN
        raise ValueError(f"early_stop_eps must lie in [0, 1), got {eps}")
    return float(eps)


def _check_background(background) -> list[float]:
    values = [float(x) for x in background]
    if len(values) != 3 or not np.isfinite(values).all():
        raise ValueError(f"background must be three finite numbers, got {background}")
    return values


def _per_ray(rays_o, n: int) -> Tensor:
    o = torch.as_tensor(np.asarray(rays_o))
    return o if len(o) == n else o.repeat_interleave(TILE, 0)[:n]


# ------------------------------------------------------------------ rendering
OUTPUTS = ("rgb", "opacity", "depth", "median_depth", "normal")


def render_rays(
    octree: Octree,
    rays_o,
    rays_d,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = OUTPUTS,
) -> dict[str, Tensor]:
    """Renders rays.

    Returns float32 tensors for the names in ``outputs``: rgb (n, 3) over ``background``, opacity 1 - T (n,), depth
    sum_i w_i t_i (n,), median_depth (n,) the distance where T falls to 1/2 (0 where it does not), normal (n, 3) the
    weighted mean of unit normals. Distances in scene units. A ray ends when T < early_stop_eps, which changes a colour
    by less than that; 0 is exact.
    """
    o, d = _check_rays(rays_o, rays_d)
    bg, eps = _check_background(background), _check_early_stop(early_stop_eps)
    _check_outputs(outputs)
    if (compiled := native()) is None:
        return _render_reference(octree, o, d, bg, eps, outputs)
    out = _empty_outputs(outputs, (len(d),))
    tree = _tree(octree, np.ascontiguousarray(octree.values, dtype=np.float32))
    compiled.render(tree, o, d, bg, eps, *(out.get(name) for name in OUTPUTS))
    return _finished(out)


def render_view(
    octree: Octree,
    directions: np.ndarray,
    camera_to_world: np.ndarray,
    size: tuple[int, int],
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = OUTPUTS,
) -> dict[str, Tensor]:
    """Renders a camera's picture of ``size`` (height, width); results as in :func:`render_rays`, (height, width[, 3]).

    directions: (tile rows, tile columns, 64, 3) float32 unit directions in camera axes, one row of 64 for each 8x8 tile;
    tiles at the right and lower edge may reach beyond the picture. camera_to_world: (4, 4), or (3, 4).
    """
    height, width = size
    tiles = (-(-height // 8), -(-width // 8), TILE, 3)
    if directions.shape != tiles or directions.dtype != np.float32 or not directions.flags.c_contiguous:
        raise ValueError(f"directions must be float32 {tiles}, got {directions.dtype} {directions.shape}")
    rotation, origin = np.asarray(camera_to_world)[:3, :3], np.asarray(camera_to_world, np.float32)[:3, 3]
    if not np.isfinite(camera_to_world).all():
        raise ValueError("camera_to_world must be finite")
    bg, eps = _check_background(background), _check_early_stop(early_stop_eps)
    _check_outputs(outputs)
    if (compiled := native()) is None:
        flat = directions.reshape(-1, 3) @ rotation.T.astype(np.float32)
        origins = np.broadcast_to(origin, (len(flat) // TILE, 3)).copy()
        rays = _render_reference(octree, origins, flat, bg, eps, outputs)
        return {name: _from_tiles(rows, tiles[0], tiles[1])[:height, :width] for name, rows in rays.items()}
    out = _empty_outputs(outputs, (height, width))
    tree = _tree(octree, np.ascontiguousarray(octree.values, dtype=np.float32))
    frame = (rotation.ravel().tolist(), origin.tolist(), height, width)
    compiled.render_view(tree, directions, *frame, bg, eps, *(out.get(name) for name in OUTPUTS))
    return _finished(out)


def _check_outputs(outputs: Sequence[str]) -> None:
    if unknown := set(outputs) - set(OUTPUTS):
        raise ValueError(f"outputs must be among {OUTPUTS}, got {sorted(unknown)}")


def _empty_outputs(outputs: Sequence[str], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Arrays for the kernels to fill; they write the transmittance where the opacity is wanted."""
    vectors = ("rgb", "normal")
    return {k: np.empty((*shape, 3) if k in vectors else shape, np.float32) for k in OUTPUTS if k in outputs}


def _finished(out: dict[str, np.ndarray]) -> dict[str, Tensor]:
    if "opacity" in out:
        np.subtract(1, out["opacity"], out=out["opacity"])
    return {k: torch.from_numpy(v) for k, v in out.items()}


def _from_tiles(rows: Tensor, down: int, across: int) -> Tensor:
    """(down * across * 64, ...) in tiles as a picture (8 down, 8 across, ...)."""
    tiles = rows.reshape(down, across, 8, 8, *rows.shape[1:])
    return tiles.transpose(1, 2).reshape(8 * down, 8 * across, *rows.shape[1:])


def _render_reference(octree: Octree, o, d, bg, eps, outputs, chunk: int = 16384) -> dict[str, Tensor]:
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
    return {k: torch.cat([p[k] for p in parts]) for k in OUTPUTS if k in outputs}


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, octree, o, d, bg, eps):
        compiled = native()
        n = len(d)
        rgb, trans, depth = (np.empty(shape, np.float32) for shape in ((n, 3), n, n))
        compiled.render(_tree(octree, values.detach().numpy()), o, d, bg, eps, rgb, trans, depth, None, None)
        ctx.saved = (values.detach(), octree, o, d, bg, eps)
        return torch.from_numpy(rgb), torch.from_numpy(trans), torch.from_numpy(depth)

    @staticmethod
    def backward(ctx, d_rgb, d_trans, d_depth):
        values, octree, o, d, bg, eps = ctx.saved
        gradient = torch.zeros_like(values)
        slots = np.full(octree.n_vertices, -1, np.int32)
        cotangents = (g.contiguous().numpy() for g in (d_rgb, d_trans, d_depth))
        native().render_backward(_tree(octree, values.numpy()), o, d, bg, eps, *cotangents, gradient.numpy(), slots)
        return gradient, None, None, None, None, None


def render_values(
    octree: Octree,
    values: Tensor,
    rays_o,
    rays_d,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Differentiable rendering with vertex rows ``values`` (n_vertices, row) in place of the octree's own.

    Returns rgb (n, 3), transmittance (n,), expected distance (n,); gradients flow to ``values``. float64 values run on
    the reference, float32 on the compiled kernels where they exist.
    """
    if values.shape != octree.values.shape:
        raise ValueError(f"values must have the octree's shape {octree.values.shape}, got {tuple(values.shape)}")
    bg, early_stop_eps = _check_background(background), _check_early_stop(early_stop_eps)
    if values.dtype == torch.float32 and native() is not None:
        o, d = _check_rays(rays_o, rays_d)
        return _Render.apply(values.contiguous(), octree, o, d, bg, float(early_stop_eps))
    directions = torch.as_tensor(np.asarray(rays_d)).to(values.dtype)
    origins = _per_ray(rays_o, len(directions)).to(values.dtype)
    return reference.render(octree, values, origins, directions, torch.tensor(bg, dtype=values.dtype), early_stop_eps)


# ------------------------------------------------------------------ training
def _check_batch(batch: Batch, options: LossOptions) -> tuple[np.ndarray, np.ndarray, list[float], float]:
    o, d = _check_rays(batch.rays_o, batch.rays_d)
    if batch.target.shape != d.shape or batch.weight.shape != d.shape[:1]:
        raise ValueError(f"target {batch.target.shape} and weight {batch.weight.shape} do not fit rays {d.shape}")
    return o, d, _check_background(options.background), _check_early_stop(options.early_stop_eps)


def train_step(
    octree: Octree, state: TrainState, batch: Batch, options: LossOptions, rates: Rates, pixel_angle: float
) -> StepReport:
    """One optimiser step on ``octree.values`` in place. pixel_angle: angle between neighbouring rays, radians.

    Bitwise the same for any number of threads.
    """
    o, d, bg, eps = _check_batch(batch, options)
    state.check(octree)
    if (compiled := native()) is None:
        return _train_step_reference(octree, state, batch, options, rates, pixel_angle)
    squared, weight, samples = compiled.train_step(
        _tree(octree, octree.values),
        o,
        d,
        batch.target,
        batch.weight,
        bg,
        eps,
        float(options.colour),
        float(options.distortion),
        float(pixel_angle),
        None,
        octree.values,
        state.moments,
        [rates.density, rates.dc, rates.sh],
        rates.beta,
        rates.eps,
        state.slots,
        state.max_weight,
        state.error,
        state.footprint,
    )
    return StepReport(squared / max(3 * weight, 1e-30), samples / max(len(d), 1))


def loss_gradient(octree: Octree, values: Tensor, batch: Batch, options: LossOptions) -> Tensor:
    """Gradient of the training loss in ``values`` (n_vertices, row); float64 on the reference, float32 compiled."""
    o, d, bg, eps = _check_batch(batch, options)
    if values.dtype == torch.float32 and (compiled := native()) is not None:
        gradient = torch.zeros_like(values)
        slots = np.full(octree.n_vertices, -1, np.int32)
        tree = _tree(octree, values.detach().contiguous().numpy())
        loss = (bg, eps, float(options.colour), float(options.distortion), 1.0)
        no_optimiser = (None, None, [0.0, 0.0, 0.0], 0.0, 0.0)
        no_statistics = (None, None, None)
        compiled.train_step(
            tree, o, d, batch.target, batch.weight, *loss, gradient.numpy(), *no_optimiser, slots, *no_statistics
        )
        return gradient
    leaf = values.detach().clone().requires_grad_()
    total, _ = _reference_loss(octree, leaf, batch, options)
    return torch.autograd.grad(total, leaf)[0]


def _reference_loss(octree: Octree, values: Tensor, batch: Batch, options: LossOptions):
    live = torch.from_numpy(batch.weight > 0)
    to = lambda a: torch.as_tensor(np.asarray(a)).to(values.dtype)  # noqa: E731
    origins, directions = _per_ray(batch.rays_o, len(batch.rays_d)), to(batch.rays_d)
    total, report = reference.loss(
        octree, values, to(origins)[live], directions[live], to(batch.target)[live], to(batch.weight)[live], options
    )
    report["live"] = live
    return total, report


def _train_step_reference(octree: Octree, state: TrainState, batch: Batch, options, rates: Rates, pixel_angle: float):
    values = torch.from_numpy(octree.values)
    leaf = values.clone().requires_grad_()
    total, report = _reference_loss(octree, leaf, batch, options)
    gradient = torch.autograd.grad(total, leaf)[0]
    samples: reference.Samples = report["samples"]
    seg = samples.segments
    with torch.no_grad():
        touched = torch.from_numpy(octree.corners).long()[seg.leaf].flatten().unique()
        g, moments = gradient[touched], torch.from_numpy(state.moments)
        old = moments[touched]
        new = torch.where(old > 0, rates.beta * old + (1 - rates.beta) * g * g, g * g)
        moments[touched] = new
        values[touched] -= _rate_row(octree, rates) * g / (new.sqrt() + rates.eps)

        weight = torch.from_numpy(batch.weight)[report["live"]]
        max_weight, footprint = torch.from_numpy(state.max_weight), torch.from_numpy(state.footprint)
        max_weight.scatter_reduce_(0, seg.leaf, samples.weights.detach(), "amax")
        error = samples.weights.detach() * (weight * report["squared_error"])[seg.ray]
        torch.from_numpy(state.error).index_add_(0, seg.leaf, error)
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
