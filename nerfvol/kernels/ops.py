"""The operators on octrees, on numpy arrays: argument checks and the choice between compiled kernels and reference.

The same in torch, with gradients, is in ``on_torch``; it is imported only where it is used.

Rays: ``rays_d`` (n, 3) unit directions; ``rays_o`` (n, 3), or (ceil(n / 64), 3) where each run of 64 rays shares its
origin. The kernels are fast when such a run is an 8x8 tile of one image (cameras.tile_pixels).
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np

from nerfvol.defaults import DEFAULT_EARLY_STOP, WHITE
from nerfvol.kernels.checks import (
    check_background,
    check_batch,
    check_coarse,
    check_early_stop,
    check_outputs,
    check_rays,
)
from nerfvol.kernels.state import (
    OUTPUTS,
    SQUARE,
    TILE_RAYS,
    Batch,
    LossOptions,
    Rates,
    StepReport,
    TrainState,
    View,
    from_squares,
)
from nerfvol.kernels.threads import available_isas, get_threads, isa, set_isa, set_threads
from nerfvol.kernels.tree import kernel_tree
from nerfvol.native import native
from nerfvol.octree.tree import Octree

# ------------------------------------------------------------------ which code runs


__all__ = [
    "OUTPUTS", "TILE_RAYS", "Batch", "LossOptions", "Rates", "StepReport", "TrainState", "View", "available_isas",
    "get_threads", "isa", "render_rays", "render_view", "set_isa", "set_threads", "train_step",
]  # fmt: skip


def _on_torch() -> ModuleType:
    from nerfvol.kernels import on_torch

    return on_torch


# ------------------------------------------------------------------ rendering


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
    check_outputs(outputs)
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
    squares = (-(-height // SQUARE), -(-width // SQUARE), 4, 3, TILE_RAYS)
    if directions.shape != squares or directions.dtype != np.float32 or not directions.flags.c_contiguous:
        raise ValueError(f"directions must be float32 {squares}, got {directions.dtype} {directions.shape}")
    rotation, origin = np.asarray(camera_to_world)[:3, :3], np.asarray(camera_to_world, np.float32)[:3, 3]
    if not np.isfinite(camera_to_world).all():
        raise ValueError("camera_to_world must be finite")
    bg, eps = check_background(background), check_early_stop(early_stop_eps)
    check_outputs(outputs)
    coarse = check_coarse(octree, origin, coarse)
    if (compiled := native()) is None:
        flat = from_squares(directions, height, width).reshape(-1, 3) @ rotation.T.astype(np.float32)
        origins = np.broadcast_to(origin, (-(-len(flat) // TILE_RAYS), 3)).copy()
        rays = _on_torch().render_rays(octree, origins, flat, bg, eps, outputs, coarse)
        return {name: rows.reshape(height, width, *rows.shape[1:]) for name, rows in rays.items()}
    out = _empty_outputs(outputs, (height, width))
    tree = kernel_tree(octree, np.ascontiguousarray(octree.values, dtype=np.float32), coarse)
    frame = (rotation.ravel().tolist(), origin.tolist(), height, width)
    compiled.render_view(tree, directions, *frame, bg, eps, *(out.get(name) for name in OUTPUTS))
    return _finished(out)


def _empty_outputs(outputs: Sequence[str], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Arrays for the kernels to fill; they write the transmittance where the opacity is wanted."""
    vectors = ("rgb", "normal")
    return {k: np.empty((*shape, 3) if k in vectors else shape, np.float32) for k in OUTPUTS if k in outputs}


def _finished(out: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    if "opacity" in out:
        np.subtract(1, out["opacity"], out=out["opacity"])
    return out


# ------------------------------------------------------------------ training


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
