"""``nerfvol demo``: a synthetic scene, a field and an octree trained on it, their scores, pictures and a video."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfvol.cli import eval as eval_command
from nerfvol.cli.command import Command, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.cli.train import print_results
from nerfvol.config.assemble import assemble
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.export import export_model

SCENE = "showcase"
VIEWS = 60
SIZE = (400, 400)
ORBIT_VIEWS = 120
ORBIT_SIZE = (600, 600)
SHEET_ROWS = 3


@dataclass
class DemoOptions:
    """``nerfvol demo``. Training: a small neural field, its octree, the octree fine-tuned, all within ``time_budget``."""

    out: str = "demo"
    time_budget: str = "150s"
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    p.add_argument("--out", metavar="DIR", help="folder for everything (default: demo)")
    p.add_argument("--time-budget", metavar="TIME", help="for training (default: 150s)")
    p.add_argument("--threads", metavar="N", help="CPU threads (default: all)")


def run(options: DemoOptions) -> int:
    """Do everything in a folder and print where it is; the exit code.

    Raises:
        InputError: the folder cannot be written.
    """
    from nerfvol.files.atomic import ensure_writable_folder
    from nerfvol.training.train import train

    started = time.perf_counter()
    folder = ensure_writable_folder(options.out)
    scene = folder / "scene"
    _make_scene(scene)
    settings = {"data": str(scene), "out": str(folder / "run"), "init": "mlp", "time_budget": options.time_budget}
    config = assemble(Config, (settings, "demo"))
    set_threads(options.threads)
    results = train(config, started=time.perf_counter())  # the budget is the training's own: the scene is made once
    assert results is not None  # nothing was resumed
    print_results(results)
    target = open_target(str(folder / "run"))
    scores = _score(target, scene, folder)
    video = _orbit(target, folder / "orbit.mp4")
    page = folder / "scene.html"
    export_model(target.model, page)
    print(
        f"\nDone in {time.perf_counter() - started:.0f} s: PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f} on "
        f"{scores['n_images']} views that were held out, {scores['seconds_per_frame']:.3f} s per frame\n"
        f"  pictures  {folder / 'comparison.png'} (truth | render | error | depth); all: {folder / 'pictures'}\n"
        f"  video     {video}\n"
        f"  page      {page} ({page.stat().st_size / 1e6:.0f} MB; a double click opens it in the browser)\n"
        f"  scores    {folder / 'scores.json'}\n"
        f"  model     {target.path} ({target.path.stat().st_size / 1e6:.0f} MB)"
    )
    return 0


def _make_scene(folder: Path) -> None:
    """Render the scene unless an earlier demo left it whole (its provenance is written last)."""
    from data_synth.cli import main as synth

    if (folder / "provenance.json").is_file():
        print(f"the scene is there: {folder}")
        return
    print(f"rendering the scene {SCENE}: {VIEWS} training views at {SIZE[0]}x{SIZE[1]}, and held-out ones", flush=True)
    code = synth([SCENE, "--out", str(folder), "--views", str(VIEWS), "--size", f"{SIZE[0]}x{SIZE[1]}"])
    if code:
        raise InputError(f"the scene {SCENE} could not be made in {folder}")


def _score(target: Target, scene: Path, folder: Path) -> dict[str, Any]:
    """Scores of the test views, their pictures, and a sheet of a few of them."""
    from nerfvol.files import pictures
    from nerfvol.files.atomic import read_json

    eval_command.run(
        eval_command.EvalOptions(
            target=target.name, data=str(scene), split="test",
            json=str(folder / "scores.json"), save_images=str(folder / "pictures"),
        )
    )  # fmt: skip
    scores = read_json(folder / "scores.json")
    rows = scores["rows"]
    last = len(rows) - 1
    chosen = sorted({round(last * row / max(1, SHEET_ROWS - 1)) for row in range(SHEET_ROWS)})
    strips = [pictures.read_png(folder / "pictures" / f"{rows[index]['name']}.png") for index in chosen]
    pictures.write_png(folder / "comparison.png", pictures.stacked(strips))
    return scores


def _orbit(target: Target, path: Path) -> Path:
    from nerfvol.cameras.paths import orbit_cameras
    from nerfvol.film import Film, write_videos

    film = Film(target.model, orbit_cameras(ORBIT_VIEWS, target.orbit(), ORBIT_SIZE), target.background)
    return write_videos(path, film, fps=30)[0]


COMMAND = Command(
    summary="Make a scene, train on it, score it and make a video, in a few minutes.",
    example="nerfvol demo",
    options=DemoOptions,
    arguments=arguments,
    run=run,
    place=5,
)
