"""What an octree's training does once its steps are over: the last pruning, what writing takes, and the sentence on what the
steps went into."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.kernels import ops
from nerfvol.octree import codec
from nerfvol.octree.rows import sh_slots
from nerfvol.octree.tree import Octree

FINAL_PRUNE_WEIGHTS = (0.04, 0.02, 0.01)
"""At the end: the first of these at which pruning costs no more than ``final_prune_loss``."""
FINAL_TILES = 4096
"""Training tiles on which the final pruning is judged: 0.4 of an 800x800 picture."""
SHARP = 2.0
"""Pixels: where the leaves that are seen are no wider, finer ones show little more: a trilinear field has a period of two."""

SECONDS_TO_WRITE = 0.5
"""... and read an octree, and to look at it; plus, a vertex, ..."""
PACKED_TIMES, PACKED_SAMPLE = 7.0, 50_000
"""... so many times what packing it takes, as measured on so many vertices: packing, reading and prefiltering a fern of 0.45
million leaves took 3.9 CPU seconds, its packing about 0.45, one of a million 6.0 and 1.0. The last pruning comes besides."""


def pruned_at_the_end(
    octree: Octree, needed: Sequence[NDArray[np.bool_]], batch: ops.Batch, background: Sequence[float], loss: float
) -> Octree:
    """The octree with the first of the sets of leaves ``needed``, (n_leaves,) each, at which the squared error of ``batch``
    grows by a share of ``loss`` at most; else as it is. A second octree is in memory while they are compared."""
    most = _squared_error(octree, batch, background) * (1 + loss)
    for keep in needed:
        if not keep.any():
            continue
        pruned = None  # one at a time
        pruned = octree.prune(keep)[0]
        if _squared_error(pruned, batch, background) <= most:
            return pruned
    return octree


def seconds_to_write(octree: Octree) -> float:
    """In compact storage, with the reading after it; measured, for machines are shared."""
    n = min(octree.n_vertices, PACKED_SAMPLE)
    started = time.perf_counter()
    codec.encode(octree.density[:n], octree.values[:n][:, sh_slots(octree.sh_degree)])
    packing = (time.perf_counter() - started) * octree.n_vertices / n
    return SECONDS_TO_WRITE + PACKED_TIMES * packing


def _squared_error(octree: Octree, batch: ops.Batch, background: Sequence[float]) -> float:
    """Sum over the batch's rays, with their weights, of the squared error of the colours as they are shown."""
    image = ops.render_rays(octree, batch.rays_o, batch.rays_d, background, outputs=("rgb",))["rgb"]
    difference = np.clip(image, 0, 1) - batch.target
    return float((difference**2).sum(1, dtype=np.float64) @ batch.weight)


def outcome(widths: NDArray[np.float64], downscales: Sequence[int], stage_steps: NDArray[np.int64]) -> str:
    """The steps on each size of the images, how wide (pixels, (n,)) the leaves that are seen, and whether more would pay."""
    steps: dict[int, int] = {}
    for factor, n in zip(downscales, stage_steps.tolist(), strict=True):
        steps[factor] = steps.get(factor, 0) + n
    sizes = ", ".join(
        f"{count:,} on {'whole images' if k == 1 else f'images /{k}'}" for k, count in steps.items() if count
    )
    middle, wide = np.percentile(widths, (50, 95))
    pays = "finer ones would show more: more time would pay" if middle > SHARP else "more time would sharpen little"
    if not sizes:
        sizes, pays = "none, for there was no time left", "more time would pay"
    return f"steps: {sizes}; the leaves that are seen are {middle:.1f} pixels wide (95 %: up to {wide:.1f}): {pays}"
