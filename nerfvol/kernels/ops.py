"""The operators on octrees, on numpy arrays: argument checks and the choice between compiled kernels and reference.

The same in torch, with gradients, is in ``on_torch``; it is imported only where it is used.

Rays: ``rays_d`` (n, 3) unit directions; ``rays_o`` (n, 3), or (ceil(n / 64), 3) where each run of 64 rays shares its
origin. The kernels are fast when such a run is an 8x8 tile of one image (cameras.tile_pixels).
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

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
    LeafStatistics,
    LossOptions,
    Rates,
    StepReport,
    TrainState,
    View,
    from_squares,
)
from nerfvol.kernels.threads import (
    WITHOUT_KERNELS,
    arena_bytes,
    available_isas,
    get_threads,
    isa,
    release_arenas,
    set_isa,
    set_threads,
)
from nerfvol.kernels.tree import kernel_batch, kernel_options, kernel_statistics, kernel_tree
from nerfvol.native import native, need_torch
from nerfvol.octree.tree import Octree

__all__ = [
    "OUTPUTS", "TILE_RAYS", "Batch", "LeafStatistics", "LossOptions", "Rates", "StepReport", "TrainState", "View",
    "arena_bytes", "available_isas", "get_threads", "isa", "leaf_statistics", "release_arenas", "render_rays",
    "render_view", "set_isa", "set_threads", "train_step",
]  # fmt: skip


def _on_torch() -> ModuleType:
    need_torch(WITHOUT_KERNELS)
    from nerfvol.kernels import on_torch

    return on_torch


# ------------------------------------------------------------------ rendering


def render_rays(
    octree: Octree,
    rays_o: ArrayLike,
    rays_d: ArrayLike,
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
    origin is drawn as one prefiltered cell (nerfvol.octree.lod); 0: none is. Raises ValueError where rays, background,
    threshold, outputs or coarse are not what they should be.
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
    small: float = 0.0,
) -> dict[str, np.ndarray]:
    """Renders a camera's picture; results as in :func:`render_rays`, (height, width[, 3]).

    small: cells whose side is below so many times their distance have the spherical harmonics of the ray through their
    middle for all rays; 0 (and the reference, always): none.

    Raises ValueError where the view is no float32 array of squares or not finite, and as render_rays does.
    """
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
    frame = (rotation.ravel().tolist(), origin.tolist(), height, width, float(small))
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
    """One step of the optimiser on the loss over ``batch``; changes ``octree.values`` and ``state`` in place.

    pixel_angle: angle between neighbouring rays, radians. Bitwise the same for any number of threads. Raises ValueError
    where rays, targets, weights, options or state do not fit each other or the octree.
    """
    o, d, _, _ = check_batch(batch, options)
    state.check(octree)
    octree.prefiltered = None
    if (compiled := native()) is None:
        return _on_torch().train_step(octree, state, batch, options, rates, pixel_angle)
    report = compiled.train_step(
        kernel_tree(octree, octree.values),
        kernel_batch(o, d, batch),
        kernel_options(options),
        kernel_options(rates),
        values=octree.values,
        moments=state.moments,
        slots=state.slots,
        statistics=kernel_statistics(state, pixel_angle),
    )
    return _step_report(report, len(d))


def leaf_statistics(
    octree: Octree, batch: Batch, options: LossOptions, pixel_angle: float, into: LeafStatistics
) -> StepReport:
    """What the rays of ``batch`` say of the leaves: bit by bit the statistics of :func:`train_step`, with nothing moved.

    ``into`` is updated in place, so that batches add up; it may be a TrainState, whose moments stay. Of the options,
    background and early_stop_eps count. pixel_angle: as in train_step; so are the errors.
    """
    o, d, _, _ = check_batch(batch, options)
    LeafStatistics.check(into, octree)
    if (compiled := native()) is None:
        return _on_torch().leaf_statistics(octree, batch, options, pixel_angle, into)
    report = compiled.leaf_statistics(
        kernel_tree(octree, np.ascontiguousarray(octree.values, dtype=np.float32)),
        kernel_batch(o, d, batch),
        kernel_options(options),
        statistics=kernel_statistics(into, pixel_angle),
    )
    return _step_report(report, len(d))


def _step_report(report: tuple[float, float, float, float], n_rays: int) -> StepReport:
    squared, weight, samples, tested = report
    packets = max(-(-n_rays // TILE_RAYS), 1)
    return StepReport(squared / max(3 * weight, 1e-30), samples / max(n_rays, 1), tested=tested / packets)
