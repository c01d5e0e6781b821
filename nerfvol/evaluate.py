"""Scores of a representation on posed images: PSNR and SSIM per view, their means, and the time a view took."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol import __version__, pictures, runs
from nerfvol.cameras import Camera
from nerfvol.datasets import Dataset, load_dataset
from nerfvol.datasets.images import map_threads
from nerfvol.errors import InputError
from nerfvol.files import ensure_writable_folder, write_json
from nerfvol.kernels import ops
from nerfvol.machine import describe_hardware
from nerfvol.metrics import psnr, ssim
from nerfvol.octree import Octree
from nerfvol.octree_io import load_octree
from nerfvol.options import DEFAULT_EARLY_STOP, DEFAULT_LOD, EvalOptions
from nerfvol.render import depth_range, render_image, resolve_background, surface_depth

LARGEST_PSNR = 100.0
"""Equal images have infinite PSNR, which JSON cannot say; an 8-bit image has 100 dB only where it is equal."""

Float = NDArray[np.float32]


def score_views(
    render: Callable[[Camera], Float],
    dataset: Dataset,
    background: Sequence[float],
    on_view: Callable[[int, Float, Float], None] | None = None,
) -> dict[str, Any]:
    """Scores of ``render`` (camera -> (H, W, 3) float32) against every image of ``dataset`` over ``background``.

    Returns psnr and ssim (means of the per-view values), seconds_per_frame (median) and rows with name, psnr, ssim and
    seconds. Renders are clipped to [0, 1] first. ``on_view(index, truth, render)`` sees each pair.
    """

    def score(rendered: tuple[int, Float, float]) -> dict[str, Any]:
        index, image, seconds = rendered
        truth = dataset.composited(index, background)
        return {
            "name": dataset.names[index],
            "psnr": min(psnr(image, truth), LARGEST_PSNR),
            "ssim": ssim(image, truth),
            "seconds": seconds,
        }

    rows, at_once = [], ops.get_threads()
    for first in range(0, len(dataset), at_once):
        # A few views one after the other, for their times; then their scores side by side.
        few = []
        for index in range(first, min(first + at_once, len(dataset))):
            started = time.perf_counter()
            image = render(dataset.cameras[index])
            seconds = time.perf_counter() - started
            few.append((index, np.clip(image, 0.0, 1.0), seconds))
        rows += map_threads(score, few, at_once)
        if on_view is not None:
            for index, image, _ in few:
                on_view(index, dataset.composited(index, background), image)
    return {
        "psnr": statistics.fmean(row["psnr"] for row in rows),
        "ssim": statistics.fmean(row["ssim"] for row in rows),
        "seconds_per_frame": statistics.median(row["seconds"] for row in rows),
        "rows": rows,
    }


def evaluate_octree(
    octree: Octree,
    dataset: Dataset,
    background: Sequence[float],
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    on_view: Callable[[int, Float, Float], None] | None = None,
    lod: float = DEFAULT_LOD,
) -> dict[str, Any]:
    """:func:`score_views` of ``octree``, drawn as ``nerfvol render`` draws it (see render.render_image)."""

    def render(camera: Camera) -> Float:
        return render_image(octree, camera, background, early_stop_eps, ("rgb",), lod)["rgb"]

    return score_views(render, dataset, background, on_view)


def run_eval(options: EvalOptions) -> int:
    """``nerfvol eval``: prints the scores and writes what the options ask for."""
    data = options.data or runs.run_settings(options.target).get("data")
    if not data:
        raise InputError(f"nerfvol eval needs --data DIR: {options.target} has no config.yaml that says what it saw")
    if options.save_images is not None:
        ensure_writable_folder(options.save_images)
    if options.json is not None:
        ensure_writable_folder(Path(options.json).parent)
    path = runs.octree_path(options.target)
    octree, metadata = load_octree(path)
    background = resolve_background(options.background, options.target, metadata)
    dataset = load_dataset(data, options.split, options.downscale)
    for message in dataset.messages:
        print(message, file=sys.stderr)
    on_view = None
    if options.save_images is not None:
        on_view = _comparison_writer(Path(options.save_images), octree, dataset, background, options)
    scores = evaluate_octree(octree, dataset, background, options.early_stop_eps, on_view, options.lod)
    record = _record(options, scores, str(path), str(data), background, dataset)
    _print_scores(record, options.split)
    if options.truth is not None:
        record["truth"] = _compare_with_truth(octree, options.truth, options.save_images)
    if options.json is not None:
        write_json(options.json, record)
        print(f"scores: {options.json}")
    if options.save_images is not None:
        print(f"pictures (truth | render | error | depth): {options.save_images}")
    return 0


def _compare_with_truth(octree: Octree, path: str, folder: str | None) -> dict[str, float]:
    from nerfvol import truth

    grid = truth.load_grid(path)
    scores = truth.compare(octree, grid)
    for name in ("density", "opacity"):
        print(
            f"{name}: relative L1 {scores[f'{name}_relative_l1']:.3f}, correlation {scores[f'{name}_correlation']:.4f}"
        )
    if folder is not None:
        truth.write_slices(Path(folder) / "density_slices.png", octree, grid)
    return scores


def _record(
    options: EvalOptions, scores: dict[str, Any], path: str, data: str, background: Sequence[float], dataset: Dataset
) -> dict[str, Any]:
    """What ``--json`` holds: the scores and everything they depend on."""
    sizes = sorted({(camera.intrinsics.width, camera.intrinsics.height) for camera in dataset.cameras})
    return {
        "psnr": scores["psnr"],
        "ssim": scores["ssim"],
        "n_images": len(scores["rows"]),
        "seconds_per_frame": scores["seconds_per_frame"],
        "image_size": list(sizes[-1]),
        "image_sizes": [list(size) for size in sizes],
        "background": list(background),
        "split": options.split,
        "downscale": options.downscale,
        "early_stop_eps": options.early_stop_eps,
        "lod": options.lod,
        "threads": ops.get_threads(),
        "kernel_path": ops.isa(),
        "hardware": describe_hardware(),
        "octree": path,
        "data": data,
        "nerfvol": __version__,
        "rows": scores["rows"],
    }


def _print_scores(record: dict[str, Any], split: str) -> None:
    width = max(len(row["name"]) for row in record["rows"])
    for row in record["rows"]:
        print(f"{row['name']:{width}s}  {row['psnr']:6.2f} dB  ssim {row['ssim']:.4f}  {row['seconds']:.3f} s")
    size = "x".join(map(str, record["image_size"]))
    background = ",".join(f"{component:g}" for component in record["background"])
    print(
        f"{record['n_images']} {split} views at {size} on background {background}: "
        f"PSNR {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}, {record['seconds_per_frame']:.3f} s per frame "
        f"({record['threads']} threads, {record['kernel_path']})"
    )


def _comparison_writer(
    folder: Path, octree: Octree, dataset: Dataset, background: Sequence[float], options: EvalOptions
) -> Callable[[int, Float, Float], None]:
    depths = depth_range(octree, dataset.cameras)

    def write(index: int, truth: Float, image: Float) -> None:
        camera = dataset.cameras[index]
        geometry = render_image(octree, camera, background, options.early_stop_eps, ("opacity", "depth"), options.lod)
        depth = pictures.depth_to_grey(surface_depth(geometry), geometry["opacity"], *depths)
        panels = [truth, image, pictures.error_map(truth, image), depth]
        pictures.write_png(folder / f"{dataset.names[index]}.png", pictures.side_by_side(panels))

    return write
