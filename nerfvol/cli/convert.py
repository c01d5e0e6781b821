"""``nerfvol convert``: an octree from splats or a field, splats from an octree or a field, and what that costs."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from nerfvol.cli.command import Command, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.config.assemble import run_settings
from nerfvol.config.parsers import Colour, seconds
from nerfvol.config.values import Count, within
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera
    from nerfvol.datasets.dataset import Dataset
    from nerfvol.models import Model
    from nerfvol.region import SceneBounds


@dataclass
class ConvertOptions:
    """``nerfvol convert``."""

    target: str = ""
    to: Literal["octree", "splats"] | None = None
    out: str = ""
    data: str | None = None
    downscale: Count | None = None
    time_budget: Annotated[float | None, seconds] = None
    level: Annotated[int, within(3, 14)] | None = None
    max_splats: Count | None = None
    background: Colour | None = None
    storage: Literal["float32", "float16", "compact"] = "compact"
    seed: int = 0
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--to", metavar="octree|splats", help="what it becomes")
    p.add_argument("--out", metavar="FILE", help="a .safetensors of nerfvol; splats also as .ply or .spz")
    p.add_argument("--data", metavar="DIR", help="posed images: their cameras decide what is seen and how fine it is, and the "
                   "result is compared with the model on their held-out views (default: those of the run; without any, "
                   "cameras all around)")  # fmt: skip
    p.add_argument("--downscale", metavar="N", help="area-average the images by N (default: that of the run, else 1)")
    p.add_argument("--time-budget", metavar="TIME", help="train the result on the images until so much is over for everything, "
                   "such as 25s (default: not at all)")  # fmt: skip
    p.add_argument("--level", metavar="L", help="octree: finest leaves, 2^L along the scene (default: 1.4 pixels wide)")
    p.add_argument("--max-splats", metavar="N", help="splats: at most so many: the octree's finest level that has no more, "
                   "or, where they are trained, discs on what is seen (default: all visible leaves; 100000 discs)")  # fmt: skip
    p.add_argument("--background", metavar="COLOUR", help="white, black or R,G,B (default: that of the training)")
    p.add_argument(
        "--storage", metavar="compact|float16|float32", help="octree: how its file holds values (default: compact)"
    )
    p.add_argument("--seed", metavar="N", help="seed of every random choice (default: 0)")


def run(options: ConvertOptions) -> int:
    """Converts, says what it cost and writes the file; the exit code.

    Raises:
        InputError: no such model or images, a model that is what is asked for already, or nothing in it that is seen.
    """
    need("convert", target=options.target, to=options.to, out=options.out)
    suffix = Path(options.out).suffix.lower()
    if suffix not in ((".safetensors", ".ply", ".spz") if options.to == "splats" else (".safetensors",)):
        ends = ".safetensors, .ply or .spz" if options.to == "splats" else ".safetensors"
        raise InputError(f"--out {options.out}: expected a file that ends in {ends}, for it becomes an {options.to} file"
                         .replace("an splats", "a splats"))  # fmt: skip
    target = open_target(options.target, options.background)
    if target.model.kind == options.to:
        raise InputError(
            f"{target.path} holds {options.to} already; convert makes an octree of splats or a field, or splats "
            "of an octree or a field"
        )
    prepare_outputs(file=options.out)
    set_threads(options.threads)
    images = _images_of(options)
    if options.time_budget is not None and images is None:
        raise InputError("--time-budget trains on images: say which with --data DIR")
    from nerfvol.datasets.load import dataset_cameras, load_dataset

    training = None if images is None or options.time_budget is None else load_dataset(split="train", **images)
    if training is not None:
        seen = training.cameras, training.scene
    else:
        seen = None if images is None else dataset_cameras(split="train", **images)
    held_out = None if images is None else load_dataset(split="val", **images)
    model = _converted(options, target, seen, training, 0 if held_out is None else len(held_out))
    _write(model, options, suffix)
    _say_cost(target, model, held_out)
    described = model.describe()
    size = f"{described['leaves']:,} leaves" if options.to == "octree" else f"{described['splats']:,} splats"
    print(f"{options.out}: {size}, {Path(options.out).stat().st_size / 1e6:.1f} MB")
    return 0


def _images_of(options: ConvertOptions) -> dict[str, Any] | None:
    """What load_dataset is given for the images: as asked, else as the run was, where they are still there; None: none."""
    settings = run_settings(options.target)
    own = settings.get("data") if options.data is None else None
    if options.data is not None and not Path(options.data).exists():
        raise InputError(f"--data {options.data}: no such folder or file")
    data = options.data or (str(own) if own and Path(str(own)).exists() else None)
    if data is None:
        return None
    images = {"path": data, "downscale": options.downscale or int(settings.get("downscale", 1))}
    if own is not None:
        images |= {name: settings[name] for name in ("holdout", "scene", "aabb") if settings.get(name) is not None}
    return images


def _converted(
    options: ConvertOptions,
    target: Target,
    seen: tuple[list[Camera], SceneBounds] | None,
    training: Dataset | None,
    scored: int,
) -> Model:
    """``seen``: the images' cameras and bounds; ``training``: the images, where there is time to train on them; ``scored``:
    views that the result will be compared on."""
    from nerfvol.clouds import PointModel
    from nerfvol.config.field import DistillConfig
    from nerfvol.config.octree import OctreeConfig
    from nerfvol.config.training import Config
    from nerfvol.neural import FieldModel
    from nerfvol.starts.gaussians import splats_of_leaves
    from nerfvol.training import convert, tuning
    from nerfvol.views import OctreeModel, SplatModel

    background, model = target.background, target.model
    if seen is None:
        scene, cameras = convert.scene_around(model), convert.cameras_around(model)
    else:
        scene, cameras = seen[1], convert.small_cameras(*seen)
    octree = OctreeConfig() if options.level is None else OctreeConfig().no_finer_than(options.level)
    distill = DistillConfig(level=options.level)
    config = Config(time_budget=options.time_budget, seed=options.seed, octree=octree, distill=distill)
    if training is not None:
        config = config.for_few_views(len(training), training.scene)
    metadata = {k: v for k, v in model.metadata.items() if k in ("orbit", "provenance")} | {
        "background": list(background)
    }
    if options.to == "splats" and not isinstance(model, OctreeModel | FieldModel):
        raise InputError(f"{target.path} holds {model.kind}, and splats are made of an octree or a field alone")
    if options.to == "splats" and isinstance(model, OctreeModel) and training is None:
        return SplatModel(splats_of_leaves(model.octree, options.max_splats), metadata)
    if isinstance(model, SplatModel | PointModel) and training is not None:
        # What pictures of the splats stand for is at hand.
        octree, config = tuning.surfaces_to_train(model.splats, training, background, config, options.level)
        return OctreeModel(tuning.tuned_octree(octree, training, background, config, scored), metadata)
    if isinstance(model, SplatModel | PointModel):
        octree = convert.octree_of(model.splats, scene, cameras, background, options.level, options.seed)
        return OctreeModel(octree, metadata)
    pictures = convert.seen_by(model, cameras, scene, background)
    if isinstance(model, FieldModel):
        octree = convert.octree_of_field(model, pictures, background, config.distill)
        if options.to == "octree":
            if training is not None:
                octree = tuning.tuned_octree(octree, training, background, config, scored)
            return OctreeModel(octree, metadata)
        model = OctreeModel(octree, metadata)
    assert isinstance(model, OctreeModel)
    if training is None:
        return SplatModel(splats_of_leaves(model.octree, options.max_splats), metadata)
    discs = convert.discs_of(model.octree, pictures, background, options.max_splats)
    tuned = tuning.tuned_splats(discs, training, background, config, scored)
    return SplatModel(tuned.packed, {**metadata, **tuned.metadata})


def _write(model: Model, options: ConvertOptions, suffix: str) -> None:
    """The file; other programs' by the exports, which know them."""
    if suffix == ".safetensors":
        model.save(options.out, options.storage)
        return
    from nerfvol.export import export_model

    export_model(model, options.out)


def _say_cost(target: Target, model: Model, held_out: Dataset | None) -> None:
    """How much less, or more, the result shows right: on held-out photographs, else against pictures of the model."""
    from nerfvol.training import convert

    if held_out is not None:
        before, after = convert.cost(target.model, model, held_out, target.background)
        print(f"{len(held_out)} held-out views: {target.model.kind} {before:.2f} dB, {model.kind} {after:.2f} dB: "
              f"{before - after:.2f} dB lost")  # fmt: skip
        return
    cameras = convert.cameras_around(target.model)[1::8]
    pictures = convert.seen_by(target.model, cameras, convert.scene_around(target.model), target.background)
    after = convert.evaluate(model, pictures, target.background)["psnr"]
    print(f"against {len(cameras)} pictures of {target.path}: {after:.2f} dB")


COMMAND = Command(
    summary="Make an octree of splats or a field, or splats of an octree or a field.",
    example="nerfvol convert run --to octree --out octree.safetensors\nnerfvol convert run --to splats --out scene.ply",
    options=ConvertOptions,
    arguments=arguments,
    run=run,
    place=37,
)
