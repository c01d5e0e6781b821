"""The operators on octrees, on numpy arrays: argument checks and the choice between compiled kernels and reference.

The same in torch, with gradients, is in ``on_torch``; it is imported only where it is used.

Rays: ``rays_d`` (n, 3) unit directions; ``rays_o`` (n, 3), or (ceil(n / 64), 3) where each run of 64 rays shares its
origin. The kernels are fast when such a run is an 8x8 tile of one image (cameras.tile_pixels).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from nerfvol import lod
from nerfvol.kernels.state import (
    DEFAULT_EARLY_STOP,
    SQUARE,
    WHITE,
    Batch,
    LossOptions,
    Rates,
    StepReport,
    TrainState,
    View,
    from_squares,
)
from nerfvol.native import native
from nerfvol.octree import BLOCKS, Octree

TILE = 64


# ------------------------------------------------------------------ which code runs
def set_threads(n: int) -> None:
    """Threads of the kernels, and of torch where it is loaded or stands in for them."""
    if n < 1:
        raise ValueError(f"threads must be at least 1, got {n}")
    if (compiled := native()) is not None:
        compiled.set_threads(n)
    if compiled is None or sys.modules.get("torch") is not None:
        import torch

        torch.set_num_threads(n)


def get_threads() -> int:
    compiled = native()
    if compiled is not None:
        return compiled.get_threads()
    import torch

    return torch.get_num_threads()


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


def kernel_tree(octree: Octree, values: np.ndarray, coarse: float = 0.0) -> Any:
    """The kernels' view of ``octree`` with ``values`` (n_vertices, row) in place of its own.

    Where ``coarse`` > 0, nodes whose side is below ``coarse`` times their distance stand in for their leaves.
    """
    compiled = native()
    assert compiled is not None
    shape = (octree.n_vertices, 16 * BLOCKS[octree.sh_degree])
    if values.shape != shape or values.dtype != np.float32:
        raise ValueError(f"the octree's values must be float32 {shape}, got {values.dtype} {values.shape}")
    averages = lod.node_averages(octree) if coarse > 0 else None
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
        averages and averages.corners,
        averages and averages.values,
        coarse,
    )


def check_rays(rays_o, rays_d) -> tuple[np.ndarray, np.ndarray]:
    """Both as contiguous float32; ValueError where they are no rays as the module's head says, or not finite."""
    o, d = (np.ascontiguousarray(a, dtype=np.float32) for a in (rays_o, rays_d))
    if d.ndim != 2 or d.shape[1] != 3:
        raise ValueError(f"rays_d must have shape (n, 3), got {d.shape}")
    if o.ndim != 2 or o.shape[1] != 3 or len(o) not in (len(d), -(-len(d) // TILE)):
        raise ValueError(f"rays_o must have one row per ray or one per {TILE} rays of {len(d)}, got shape {o.shape}")
    for name, a in (("rays_o", o), ("rays_d", d)):
        if not np.isfinite(np.dot(a.ravel(), a.ravel())):  # one pass; unit directions cannot overflow
            raise ValueError(f"{name} must be finite, {int((~np.isfinite(a)).any(1).sum())} rows are not")
    return o, d


def check_early_stop(eps) -> float:
    """``eps``; ValueError outside [0, 1)."""
    if not 0 <= eps < 1:  # also refuses NaN
        raise ValueError(f"early_stop_eps must lie in [0, 1), got {eps}")
    return float(eps)


def check_coarse(octree: Octree, origins: np.ndarray, coarse) -> float:
    """``coarse``, or 0 where no node is so small from any of ``origins``; ValueError where it is negative or not finite."""
    if not 0 <= coarse < np.inf:
        raise ValueError(f"coarse must be an angle in radians, 0 or more and finite, got {coarse}")
    return float(coarse) if coarse > 0 and lod.may_stand_in(octree, origins, coarse) else 0.0


def check_background(background) -> list[float]:
    """Three floats; ValueError where they are not three or not finite."""
    values = [float(x) for x in background]
    if len(values) != 3 or not np.isfinite(values).all():
        raise ValueError(f"background must be three finite numbers, got {background}")
    return values


def _on_torch() -> ModuleType:
    from nerfvol.kernels import on_torch

    return on_torch


# ------------------------------------------------------------------ rendering
OUTPUTS = ("rgb", "opacity", "depth", "median_depth", "normal")


def render_rays(
    octree: Octree,
    rays_o,
    rays_d,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = OUTPUTS,
    coarse: float = 0.0,
) -> dict[str, np.ndarray]:
    """Renders rays.

    Returns float32 arrays for the names in ``outputs``: rgb (n, 3) over ``background``, opacity 1 - T (n,), depth
    sum_i w_i t_i (n,), median_depth (n,) the distance where T falls to 1/2 (0 where it does not), normal (n, 3) the
    weighted mean of unit normals. Distances in scene units. A ray ends when T < early_stop_eps, which changes a colour
    by less than that; 0 is exact. A node whose side is below ``coarse`` times the distance of its centre from the ray's
    origin stands in for its leaves (nerfvol.lod); 0: none does.
    """
    o, d = check_rays(rays_o, rays_d)
    bg, eps = check_background(background), check_early_stop(early_stop_eps)
    _check_outputs(outputs)
    coarse = check_coarse(octree, o, coarse)
    if (compiled := native()) is None:
        return _on_torch().render_rays(octree, o, d, bg, eps, outputs, coarse)
    out = _empty_outputs(outputs, (len(d),))
    tree = kernel_tree(octree, np.ascontiguousarray(octree.values, dtype=np.float32), coarse)
    compiled.render(tree, o, d, bg, eps, *(out.get(name) for name in OUTPUTS))
    return _finished(out)


def render_view(
    octree: Octree,
    view: View,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = OUTPUTS,
    coarse: float = 0.0,
) -> dict[str, np.ndarray]:
    """Renders a camera's picture; results as in :func:`render_rays`, (height, width[, 3])."""
    directions, camera_to_world, height, width = view.directions, view.camera_to_world, view.height, view.width
    squares = (-(-height // SQUARE), -(-width // SQUARE), 4, 3, TILE)
    if directions.shape != squares or directions.dtype != np.float32 or not directions.flags.c_contiguous:
        raise ValueError(f"directions must be float32 {squares}, got {directions.dtype} {directions.shape}")
    rotation, origin = np.asarray(camera_to_world)[:3, :3], np.asarray(camera_to_world, np.float32)[:3, 3]
    if not np.isfinite(camera_to_world).all():
        raise ValueError("camera_to_world must be finite")
    bg, eps = check_background(background), check_early_stop(early_stop_eps)
    _check_outputs(outputs)
    coarse = check_coarse(octree, origin, coarse)
    if (compiled := native()) is None:
        flat = from_squares(directions, height, width).reshape(-1, 3) @ rotation.T.astype(np.float32)
        origins = np.broadcast_to(origin, (-(-len(flat) // TILE), 3)).copy()
        rays = _on_torch().render_rays(octree, origins, flat, bg, eps, outputs, coarse)
        return {name: rows.reshape(height, width, *rows.shape[1:]) for name, rows in rays.items()}
    out = _empty_outputs(outputs, (height, width))
    tree = kernel_tree(octree, np.ascontiguousarray(octree.values, dtype=np.float32), coarse)
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


def _finished(out: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    if "opacity" in out:
        np.subtract(1, out["opacity"], out=out["opacity"])
    return out


# ------------------------------------------------------------------ training
def check_batch(batch: Batch, options: LossOptions) -> tuple[np.ndarray, np.ndarray, list[float], float]:
    """Origins, directions, background and early-stop threshold; ValueError where the parts of the batch do not fit."""
    o, d = check_rays(batch.rays_o, batch.rays_d)
    if batch.target.shape != d.shape or batch.weight.shape != d.shape[:1]:
        raise ValueError(f"target {batch.target.shape} and weight {batch.weight.shape} do not fit rays {d.shape}")
    return o, d, check_background(options.background), check_early_stop(options.early_stop_eps)


def train_step(
    octree: Octree, state: TrainState, batch: Batch, options: LossOptions, rates: Rates, pixel_angle: float
) -> StepReport:
    """One optimiser step on ``octree.values`` in place. pixel_angle: angle between neighbouring rays, radians.

    Bitwise the same for any number of threads.
    """
    o, d, bg, eps = check_batch(batch, options)
    state.check(octree)
    octree.averages = None
    if (compiled := native()) is None:
        return _on_torch().train_step(octree, state, batch, options, rates, pixel_angle)
    squared, weight, samples = compiled.train_step(
        kernel_tree(octree, octree.values),
        o,
        d,
        batch.target,
        batch.weight,
        bg,
        eps,
        float(options.colour),
        float(options.distortion),
        float(options.smooth_density),
        float(options.smooth_colour),
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
