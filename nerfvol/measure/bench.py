"""``nerfvol bench``: repeatable medians of loading, rendering and training speed, and what they stand against.

Views are those of the octree's own orbit. Training steps run at learning rate zero on tiles of such views, so that the
octree under measurement stays what it is while every byte is touched as in training. Coarser octrees for the cost
against size are the given one cut off at each level (lod.at_level). Pictures are drawn as ``nerfvol render`` does.
roofline.py says what the machine allows at most.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol.cameras.camera import Camera, tile_pixels
from nerfvol.defaults import DEFAULT_EARLY_STOP, WHITE
from nerfvol.kernels import ops
from nerfvol.measure import roofline
from nerfvol.native import need_torch
from nerfvol.octree import lod
from nerfvol.octree.io import load_octree
from nerfvol.octree.tree import Octree
from nerfvol.views import render_image

VIEWS = 4
BASE_SIZE = 800
TRAIN_TILES = 512
REFERENCE_RAYS = 2048
REFERENCE_TILES = 256
"""Of the training step that both sides make: a whole batch, since plain torch pays for every vertex in each step."""
PAPER_SAMPLES = (64, 192)
"""Field evaluations a ray costs in the NeRF paper: 64 by the coarse network, 64 + 128 by the fine one."""


def median_seconds(run: Callable[[int], object], repeats: int) -> float:
    """The median wall-clock time of ``run(0)``, ``run(1)``, ... after one call that is not counted."""
    run(0)
    times = []
    for index in range(repeats):
        started = time.perf_counter()
        run(index)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def measure_loading(path: Path, repeats: int) -> dict[str, float]:
    """Bytes of the file and seconds until it can be rendered (from the system's cache)."""
    return {"bytes": path.stat().st_size, "seconds": median_seconds(lambda _: load_octree(path), min(repeats, 3))}


def measure_rendering(
    octree: Octree, views: Sequence[list[Camera]], threads: int, repeats: int
) -> list[dict[str, Any]]:
    """Frames a second at each size, with 1 and all threads, for each build of the kernels."""
    rows = []
    in_use = ops.isa()
    for isa in ops.available_isas():
        if isa != "reference":
            ops.set_isa(isa)
        for count in sorted({1, threads}):
            ops.set_threads(count)
            for cameras in views:
                lens = cameras[0].intrinsics
                seconds = _frame_seconds(octree, cameras, repeats)
                rows.append({"isa": isa, "threads": count, "size": lens.width, "frames_per_second": 1.0 / seconds})
    if in_use != "reference":
        ops.set_isa(in_use)
    ops.set_threads(threads)
    return rows


def _frame_seconds(octree: Octree, cameras: Sequence[Camera], repeats: int) -> float:
    def frame(index: int) -> object:
        return render_image(octree, cameras[index % len(cameras)], WHITE, DEFAULT_EARLY_STOP, ("rgb",))

    return median_seconds(frame, repeats)


def measure_sizes(
    octree: Octree, cameras: Sequence[Camera], repeats: int, machine: roofline.Machine
) -> list[dict[str, Any]]:
    """Rendering and training rates of the octree and of coarser versions of it, coarsest first, and what limits them."""
    rows = []
    for level in range(max(5, octree.max_level - 4), octree.max_level + 1):
        tree = octree if level == octree.max_level else lod.at_level(octree, level)
        rate, samples, tested = training_rate(tree, cameras, repeats)
        rows.append(
            {
                "level": level,
                "leaves": tree.n_leaves,
                "frames_per_second": 1.0 / _frame_seconds(tree, cameras, repeats),
                "train_rays_per_second": rate,
                "samples_per_ray": samples,
                "train_segments_per_second": rate * samples,
                "leaves_tested_per_tile": tested,
                **roofline.roofs(tree, cameras[0], _batch(tree, cameras[0], 0, TRAIN_TILES), machine),
            }
        )
    return rows


def exponents(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """The powers of the number of leaves with which the time of a frame and of a training ray grow; None: one size."""
    leaves = [row["leaves"] for row in rows]
    keys = {"frame": "frames_per_second", "train_ray": "train_rays_per_second"}
    return {name: roofline.fitted_exponent(leaves, [1.0 / row[key] for row in rows]) for name, key in keys.items()}


def training_rate(octree: Octree, cameras: Sequence[Camera], repeats: int) -> tuple[float, float, float]:
    """Rays a second of forward, backward and optimiser on 8x8 tiles, segments a ray, and leaves that the walk had to test for a
    tile; ``octree`` stays as it is."""
    batches = [_batch(octree, camera, seed, TRAIN_TILES) for seed, camera in enumerate(cameras)]
    reports = []
    train_step = _still(ops.train_step, octree, cameras[0])

    def step(index: int) -> None:
        reports.append(train_step(batches[index % len(batches)]))

    seconds = median_seconds(step, repeats)
    samples, tested = (statistics.median(getattr(report, name) for report in reports) for name in ("samples", "tested"))
    return len(batches[0].rays_d) / seconds, samples, tested


def _still(
    train_step: Callable[..., ops.StepReport], octree: Octree, camera: Camera
) -> Callable[[ops.Batch], ops.StepReport]:
    """``train_step`` at learning rate zero."""
    state, loss = ops.TrainState(octree), ops.LossOptions(WHITE, colour=0.03, distortion=0.01)
    rates, pixel_angle = ops.Rates(density=0.0, dc=0.0, sh=0.0), 1.0 / camera.intrinsics.fx
    return lambda batch: train_step(octree, state, batch, loss, rates, pixel_angle)


def _batch(octree: Octree, camera: Camera, seed: int, n_tiles: int) -> ops.Batch:
    """Random whole tiles of a view that see something, with the octree's own colours, a little off, as the target."""
    lens = camera.intrinsics
    image = render_image(octree, camera, WHITE, DEFAULT_EARLY_STOP, ("rgb", "opacity"))
    tiles = tile_pixels(lens.width, lens.height)
    seen = (tiles >= 0).all(axis=1) & (image["opacity"].reshape(-1)[np.maximum(tiles, 0)].max(axis=1) > 0.01)
    candidates = np.flatnonzero(seen) if seen.any() else np.flatnonzero((tiles >= 0).all(axis=1))
    chosen = tiles[np.sort(np.random.default_rng(seed).choice(candidates, n_tiles))].reshape(-1)
    origin, directions = camera.rays()
    target = np.clip(image["rgb"].reshape(-1, 3)[chosen] * 0.9, 0.0, 1.0)
    origins = np.broadcast_to(origin, (n_tiles, 3)).copy()
    return ops.Batch(origins, directions[chosen], target, np.ones(len(chosen), np.float32))


def measure_reference(octree: Octree, cameras: Sequence[Camera], record: dict[str, Any]) -> dict[str, Any]:
    """Rays a second of plain torch on the same octree, and of a network of the paper's size; ratios to the kernels."""
    need_torch("the comparison with plain torch (--no-reference leaves it out)")
    import torch

    from nerfvol.config.field import FieldShape
    from nerfvol.field.fields import make_field
    from nerfvol.field.layout import Domain
    from nerfvol.kernels import on_torch, reference

    ops.set_threads(ops.get_threads())  # torch was loaded only now
    camera = cameras[0]
    origin, directions = camera.rays()
    picked = np.random.default_rng(0).choice(len(directions), REFERENCE_RAYS, replace=False)
    rays_d = torch.from_numpy(directions[picked])
    rays_o = torch.from_numpy(origin).expand_as(rays_d)
    values = torch.from_numpy(octree.values)

    def plain(_: int) -> None:
        with torch.no_grad():
            reference.render(octree, values, rays_o, rays_d, torch.ones(3), DEFAULT_EARLY_STOP)

    paper = FieldShape(encoding="frequency", width=256, depth=8, skip=5, head="rgb")
    field = make_field(Domain((0.0, 0.0, 0.0), 1.0), paper)
    n_rays = 64
    positions = torch.rand(n_rays * sum(PAPER_SAMPLES), 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    viewdirs = torch.nn.functional.normalize(positions, dim=-1)

    def network(_: int) -> None:
        with torch.no_grad():
            field(positions, viewdirs)

    batch = _batch(octree, camera, 0, REFERENCE_TILES)
    kernel_step, torch_step = (_still(step, octree, camera) for step in (ops.train_step, on_torch.train_step))
    kernel_seconds = median_seconds(lambda _: kernel_step(batch), 3)
    torch_seconds = median_seconds(lambda _: torch_step(batch), 3)
    torch_rate = REFERENCE_RAYS / median_seconds(plain, 3)
    mlp_rate = n_rays / median_seconds(network, 3)
    kernel_rate = record["size"][-1]["frames_per_second"] * BASE_SIZE**2
    return {
        "kernel_rays_per_second": kernel_rate,
        "torch_rays_per_second": torch_rate,
        "paper_mlp_rays_per_second": mlp_rate,
        "kernel_over_torch": kernel_rate / torch_rate,
        "train_step_rays": len(batch.rays_d),
        "kernel_train_step_seconds": kernel_seconds,
        "torch_train_step_seconds": torch_seconds,
        "train_step_kernel_over_torch": torch_seconds / kernel_seconds,
        "kernel_over_paper_mlp": kernel_rate / mlp_rate,
    }
