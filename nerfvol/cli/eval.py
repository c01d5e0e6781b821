"""``nerfvol eval``: scores of a model on the views of a split."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from nerfvol import __version__
from nerfvol.cli.target import resolve_background
from nerfvol.config.assemble import run_settings
from nerfvol.config.values import Colour, Count, fraction, pixels
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.load import load_dataset
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.files import pictures, run_folder
from nerfvol.files.atomic import ensure_writable_folder, write_json
from nerfvol.kernels import ops
from nerfvol.machine import describe_hardware
from nerfvol.measure.scores import evaluate_octree
from nerfvol.octree.io import load_octree
from nerfvol.octree.tree import Octree
from nerfvol.views import Float, depth_range, render_image, surface_depth


def run_eval(options: EvalOptions) -> int:
    """``nerfvol eval``: prints the scores and writes what the options ask for."""
    data = options.data or run_settings(options.target).get("data")
    if not data:
        raise InputError(f"nerfvol eval needs --data DIR: {options.target} has no config.yaml that says what it saw")
    if options.save_images is not None:
        ensure_writable_folder(options.save_images)
    if options.json is not None:
        ensure_writable_folder(Path(options.json).parent)
    path = run_folder.octree_path(options.target)
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
    from nerfvol.measure import truth

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


@dataclass
class EvalOptions:
    """``nerfvol eval``."""

    target: str = ""
    data: str | None = None
    split: Literal["train", "val", "test"] = "val"
    downscale: Count = 1
    background: Colour | None = None
    early_stop_eps: Annotated[float, fraction] = DEFAULT_EARLY_STOP
    lod: Annotated[float, pixels] = DEFAULT_LOD
    json: str | None = None
    save_images: str | None = None
    truth: str | None = None
    threads: int = 0
