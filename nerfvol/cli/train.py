"""``nerfvol train``: a model from a folder of posed images."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfvol.cli.command import FITTED, POSED, Command, assemble_options, need, set_threads
from nerfvol.cli.photographs import with_poses
from nerfvol.cli.terminal import go_on_without_reader
from nerfvol.config.assemble import read_yaml
from nerfvol.config.training import Config
from nerfvol.datasets.formats import formats_help
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.training.train import Results


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    p.add_argument("--data", metavar="DIR", help=f"{formats_help()}; or a JSON file of transforms itself")
    p.add_argument("--out", metavar="RUN", help="run folder: the model, config.yaml, metrics.json, log.jsonl, "
                   "previews/, checkpoint.safetensors")  # fmt: skip
    p.add_argument("--config", metavar="FILE", help="YAML file of settings, such as configs/smoke.yaml")
    p.add_argument("--representation", metavar="auto|octree|splats|field|medium", help="auto: splats on photographs, which "
                   "they draw sharper and sooner; the octree, which has a density, on objects and media; field: a "
                   "small network behind a hash grid, which the others can be made of (default: auto)")  # fmt: skip
    p.add_argument("--light", metavar="FILE", help="JSON of the suns that the pictures were taken under and the phase function "
                   "(docs/relighting.md): fits extinction and albedo of a medium, which can be lit anew")  # fmt: skip
    p.add_argument("--init", metavar="START", help="where it starts. octree: direct (low density everywhere), mlp (a small "
                   "field, trained first and distilled, which auto takes for objects of few views or with a long time "
                   "budget) or splats (trained first, too, which auto takes for photographs with a time budget, and "
                   "for other objects where it is short); splats: mlp (discs on what a small field is "
                   "distilled to, which auto takes for objects of few views), points (of a COLMAP "
                   "model), sweep (of planes through the photographs), points+sweep, "
                   "hull (of the silhouettes of a cut-out object), random, or a file of splats or an "
                   "octree (default: auto)")  # fmt: skip
    p.add_argument("--time-budget", metavar="TIME", help="wall-clock time for everything, such as 120s or 5m; none: "
                   "a fixed number of steps, the same result every time (default: none)")  # fmt: skip
    p.add_argument("--background", metavar="COLOUR", help="white, black or R,G,B from 0 to 1: what images with alpha "
                   "are composited on (default: white, or the plain backdrop that they show)")  # fmt: skip
    p.add_argument("--downscale", metavar="N", help="area-average the images by N (default: 1)")
    p.add_argument("--aabb", metavar="X0,Y0,Z0,X1,Y1,Z1", help="the region of detail in the units of the poses: lowest "
                   "and highest corner (default: worked out from the cameras)")  # fmt: skip
    p.add_argument("--holdout", metavar="own|arc", help="views that are scored, not trained on. own: the data's, or every 8th; "
                   "arc: an eighth of the training views, next to each other, which asks for more (default: own)")  # fmt: skip
    p.add_argument("--scene", metavar="KIND", help="auto, object (before nothing or a plain backdrop), surroundings (around a "
                   "subject), room (seen from inside) or forward (all look one way) (default: auto)")  # fmt: skip
    p.add_argument("--poses", metavar="given|auto", help="auto: photographs without poses, or a video, get them first, in "
                   "RUN/scene (needs nerfvol[poses]; default: given)")  # fmt: skip
    p.add_argument("--appearance", metavar="auto|on|off", help="a colour map for each photograph; auto: where exposures "
                   "differ by more than 8 %% (default: auto)")  # fmt: skip
    p.add_argument("--refine-poses", action="store_true", help="move the cameras along the loss's gradient while splats are "
                   "trained: for poses that are off by more than a pixel or two")  # fmt: skip
    p.add_argument("--threads", metavar="N", help="CPU threads; the result does not depend on it (default: all)")
    p.add_argument("--seed", metavar="N", help="seed of every random choice (default: 0)")
    p.add_argument("--view", action="store_true", help="show the model in the browser while it is trained, a new one after "
                   "each stage and every 20 s; the encoding takes a share of one core")  # fmt: skip
    p.add_argument("--resume", action="store_true", help="go on from RUN's checkpoint; settings come from RUN")
    p.add_argument("--checkpoint-every", metavar="TIME", help="the most a crash can cost (default: 30s)")
    p.add_argument("--storage", metavar="compact|float16|float32|mapped", help="how the model's file holds its values "
                   "(default: compact)")  # fmt: skip
    p.add_argument("--set", action="append", metavar="KEY=VALUE", help="any setting of the sections, such as "
                   "octree.sh_degree=2; repeatable (config.yaml in a run folder lists them all)")  # fmt: skip


def run(given: dict[str, Any]) -> int:
    """Train, and print what came of it; the exit code.

    Raises:
        InputError: no such data, settings that do not fit, a run that cannot be resumed, or one that fails (see train.train).
    """
    base, view = None, bool(given.pop("view", False))
    if given.get("resume") and given.get("out"):
        from nerfvol.training.prepare import resumable_config

        saved = resumable_config(given["out"])
        base = (read_yaml(saved), str(saved))
    config = assemble_options(Config, given, base)
    need("train", data=config.data, out=config.out)
    if not Path(config.data).exists():
        raise InputError(f"--data {config.data}: no such folder or file")
    if config.light is not None and not Path(config.light).is_file():
        raise InputError(f"--light {config.light}: no such file")
    config = with_poses(config)
    set_threads(config.threads)
    go_on_without_reader()
    from nerfvol.training.train import train

    if view:
        return _run_viewed(config)
    results = train(config)
    if results is not None:
        print_results(results)
    return 0


def _run_viewed(config: Config) -> int:
    """Train with a viewer that stays, once the training is over, until Ctrl-C."""
    import threading

    from nerfvol.cli.view import announce
    from nerfvol.datasets.load import load_dataset
    from nerfvol.models import load_model
    from nerfvol.training.train import train
    from nerfvol.viewer.live import Live
    from nerfvol.viewer.server import ViewServer
    from nerfvol.viewer.shown import Shown

    shown = Shown(Path(config.out).name)
    server, live = ViewServer(shown), Live(shown)
    try:
        announce(server, True)
        server.start()
        shown.training = True
        results = train(config, watch=live)
        shown.training = False
        if results is not None:
            print_results(results)
            live.join()
            shown.dataset = load_dataset(config.data, "train", config.downscale)
            shown.publish(load_model(results.model), "Training is over; load again for the photographs")
            print(f"the viewer stays at {server.address} until Ctrl-C", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                threading.Event().wait()
        return 0
    finally:
        server.close()


def print_results(results: Results) -> None:
    """What the run came to, in a few lines."""
    metrics = results.metrics
    if metrics["results"]:
        print(f"\n{results.compared:21s}PSNR    SSIM   seconds     leaves      MB   s/frame")
        for name, row in metrics["results"].items():
            leaves = "" if row["leaves"] is None else f"{row['leaves']:,}"
            print(f"{name.replace('_', '-'):18s} {row['psnr']:6.2f}  {row['ssim']:.4f} {row['seconds']:9.1f} "
                  f"{leaves:>10s} {row['MB']:7.1f} {row['seconds_per_frame']:9.4f}")  # fmt: skip
    background = ",".join(f"{c:g}" for c in metrics["background"])
    print(f"\n{metrics['n_images']} held-out views on background {background}: PSNR {metrics['psnr']:.2f} dB, "
          f"SSIM {metrics['ssim']:.4f}; {results.size}, {metrics['MB']:.1f} MB, "
          f"{metrics['seconds_per_frame']:.3f} s per frame, {metrics['seconds']:.0f} s in all")  # fmt: skip
    if "psnr_posed" in metrics:
        print(POSED.format(metrics["psnr_posed"], metrics["ssim_posed"]))
    if "psnr_fitted" in metrics:
        print(FITTED.format(metrics["psnr_fitted"], metrics["ssim_fitted"]))
    print(f"model: {results.model}")


COMMAND = Command(
    summary="Train a model from a folder of posed images.",
    example="nerfvol train --data scene --out run --time-budget 60s\nnerfvol train --resume --out run",
    options=None,
    arguments=arguments,
    run=run,
    place=10,
)
