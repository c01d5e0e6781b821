"""``nerfvol eval``: scores of a model on the views of a split."""

from __future__ import annotations

import argparse
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from nerfvol import __version__
from nerfvol.cli.command import FITTED, POSED, Command, add_drawing, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.config.assemble import run_settings
from nerfvol.config.parsers import Colour, fraction, pixels
from nerfvol.config.values import Count
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.datasets.dataset import Dataset


@dataclass
class EvalOptions:
    """``nerfvol eval``."""

    target: str = ""
    data: str | None = None
    split: Literal["train", "val", "test"] = "val"
    holdout: Literal["own", "arc"] | None = None
    downscale: Count = 1
    background: Colour | None = None
    early_stop_eps: Annotated[float, fraction] = DEFAULT_EARLY_STOP
    lod: Annotated[float, pixels] = DEFAULT_LOD
    json: str | None = None
    save_images: str | None = None
    truth: str | None = None
    lpips: bool = False
    cluster: str | None = None
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--data", metavar="DIR", help="posed images to compare with (default: those of the run)")
    p.add_argument("--split", metavar="train|val|test", help="which views (default: val)")
    p.add_argument("--holdout", metavar="own|arc", help="how views were held out (default: as the run did, else own)")
    p.add_argument("--downscale", metavar="N", help="area-average the images by N (default: 1)")
    p.add_argument("--json", metavar="FILE", help="write scores, per-image rows, seconds per frame and hardware")
    p.add_argument("--save-images", metavar="DIR", help="write truth | render | error | depth for every view")
    p.add_argument(
        "--lpips", action="store_true", help="also score LPIPS (VGG); needs nerfvol[lpips] and some seconds a view"
    )
    p.add_argument("--truth", metavar="FILE.npz", help="the density.npz or truth.npz of a synthetic scene: also compare "
                   "the density, of media the albedo too "
                   "(with --save-images: slices of both)")  # fmt: skip
    add_drawing(p)
    p.add_argument("--cluster", metavar="WHERE", help="on the workers of an engine, which must see the data: "
                   "local:N, tcp://host:8786 or a scheduler file; same scores (docs/cluster.md)")  # fmt: skip


def run(options: EvalOptions) -> int:
    """Prints the scores and writes what the options ask for; the exit code.

    Raises:
        InputError: no such model or images, or a path that cannot be written.
    """
    need("eval", target=options.target)
    set_threads(options.threads)
    from nerfvol.datasets.load import load_dataset
    from nerfvol.files.atomic import write_json
    from nerfvol.files.run_folder import REFINED
    from nerfvol.measure.perceptual import NETWORK, load_lpips
    from nerfvol.measure.scores import comparison_writer, evaluate
    from nerfvol.training.refined import with_refined

    prepare_outputs(options.save_images, options.json)
    target = open_target(options.target, options.background)
    data = options.data or run_settings(options.target).get("data")
    if not data:
        raise InputError(f"nerfvol eval needs --data DIR: {options.target} has no config.yaml that says what it saw")
    settings = run_settings(options.target)
    holdout = options.holdout or ("own" if options.data else settings.get("holdout", "own"))
    kind = settings.get("scene")
    scene = "auto" if kind is None else kind
    dataset = load_dataset(data, options.split, options.downscale, holdout=holdout, scene=scene)
    if options.data is None and options.split == "train":
        dataset = with_refined(dataset, target.path.parent / REFINED)
    for message in dataset.messages:
        print(message, file=sys.stderr)
    drawing = target.background, options.early_stop_eps, options.lod
    seers = []
    if options.save_images is not None:
        seers.append(comparison_writer(Path(options.save_images), target.model, dataset, *drawing))
    distances: dict[int, float] = {}
    if options.lpips:
        distance = load_lpips()
        seers.append(lambda i, truth, image: distances.__setitem__(i, distance(image, truth)))

    def on_view(index: int, truth: Any, image: Any) -> None:
        for see in seers:
            see(index, truth, image)

    if options.cluster is None:
        scores = evaluate(target.model, dataset, *drawing, on_view if seers else None)
    else:
        loaded = {
            "data": data,
            "split": options.split,
            "downscale": options.downscale,
            "holdout": holdout,
            "scene": scene,
        }
        scores = _on_cluster(options.cluster, target, dataset, drawing, loaded, on_view if seers else None)
    rows = {row["name"]: row for row in scores["rows"]}
    for index, value in distances.items():
        rows[dataset.names[index]]["lpips"] = value
    record = _record(options, scores, target, str(data), dataset) | {"holdout": holdout}
    if distances:
        record |= {"lpips": statistics.fmean(distances.values()), "lpips_network": NETWORK}
    _print_scores(record, options.split)
    if options.truth is not None:
        record["truth"] = _compare_with_truth(target, options.truth, options.save_images)
    if options.json is not None:
        write_json(options.json, record)
        print(f"scores: {options.json}")
    if options.save_images is not None:
        print(f"pictures (truth | render | error | depth): {options.save_images}")
    return 0


def _on_cluster(
    where: str,
    target: Target,
    dataset: Dataset,
    drawing: tuple[Any, float, float],
    loaded: dict[str, Any],
    on_view: Any,
) -> dict[str, Any]:
    from nerfvol.cluster.views import evaluate

    background, early_stop_eps, lod = drawing
    settings = {"background": list(background), "early_stop_eps": early_stop_eps, "lod": lod, **loaded}
    return evaluate(
        where, target.path, target.model, dataset, settings, lambda text: print(text, file=sys.stderr), on_view
    )


def _compare_with_truth(target: Target, path: str, folder: str | None) -> dict[str, float]:
    from nerfvol.measure import truth
    from nerfvol.medium.model import MediumModel
    from nerfvol.views import OctreeModel

    if not isinstance(target.model, OctreeModel | MediumModel):
        raise InputError(
            f"--truth compares densities, which {target.path}, a model of {target.model.kind}, does not have"
        )
    if isinstance(target.model, MediumModel) and Path(path).name == truth.TRUTH:
        scores = truth.compare_medium(target.model, *truth.load_medium(path))
        print(f"albedo: mean error {scores['albedo_error']:.4f} (RGB, weighted by the true extinction)")
    elif isinstance(target.model, MediumModel):
        scores = truth.compare_medium(target.model, truth.load_grid(path))
    else:
        scores = truth.compare(target.model.octree, truth.load_grid(path))
    for name in ("density", "opacity"):
        print(
            f"{name}: relative L1 {scores[f'{name}_relative_l1']:.3f}, correlation {scores[f'{name}_correlation']:.4f}"
        )
    if folder is not None and isinstance(target.model, OctreeModel):
        truth.write_slices(Path(folder) / "density_slices.png", target.model.octree, truth.load_grid(path))
    return scores


def _record(
    options: EvalOptions, scores: dict[str, Any], target: Target, data: str, dataset: Dataset
) -> dict[str, Any]:
    """What ``--json`` holds: the scores and everything they depend on."""
    from nerfvol.kernels import ops
    from nerfvol.machine import describe_hardware

    sizes = sorted({(camera.intrinsics.width, camera.intrinsics.height) for camera in dataset.cameras})
    return {
        "psnr": scores["psnr"],
        "ssim": scores["ssim"],
        **{name: scores[name] for name in ("psnr_posed", "ssim_posed", "psnr_fitted", "ssim_fitted") if name in scores},
        "n_images": len(scores["rows"]),
        "seconds_per_frame": scores["seconds_per_frame"],
        "image_size": list(sizes[-1]),
        "image_sizes": [list(size) for size in sizes],
        "background": list(target.background),
        "split": options.split,
        "downscale": options.downscale,
        "early_stop_eps": options.early_stop_eps,
        "lod": options.lod,
        "threads": ops.get_threads(),
        "kernel_path": ops.isa(),
        "hardware": describe_hardware(),
        "model": str(target.path),
        "representation": target.model.kind,
        "data": data,
        "nerfvol": __version__,
        "rows": scores["rows"],
    }


def _print_scores(record: dict[str, Any], split: str) -> None:
    width = max(len(row["name"]) for row in record["rows"])
    for row in record["rows"]:
        distance = f"  lpips {row['lpips']:.4f}" if "lpips" in row else ""
        print(
            f"{row['name']:{width}s}  {row['psnr']:6.2f} dB  ssim {row['ssim']:.4f}{distance}  {row['seconds']:.3f} s"
        )
    size = "x".join(map(str, record["image_size"]))
    background = ",".join(f"{component:g}" for component in record["background"])
    distance = f", LPIPS {record['lpips']:.4f} ({record['lpips_network']})" if "lpips" in record else ""
    print(
        f"{record['n_images']} {split} views at {size} on background {background}: "
        f"PSNR {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}{distance}, {record['seconds_per_frame']:.3f} s per frame "
        f"({record['threads']} threads, {record['kernel_path']})"
    )
    if "psnr_posed" in record:
        print(POSED.format(record["psnr_posed"], record["ssim_posed"]))
    if "psnr_fitted" in record:
        print(FITTED.format(record["psnr_fitted"], record["ssim_fitted"]))


COMMAND = Command(
    summary="Score a model (PSNR, SSIM) on the views of a split.",
    example="nerfvol eval run --data scene --split test --save-images pictures",
    options=EvalOptions,
    arguments=arguments,
    run=run,
    place=20,
)
