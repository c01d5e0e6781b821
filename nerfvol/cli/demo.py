"""The demo: a synthetic scene, an octree trained on it, its scores, side-by-side pictures and a video."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol.cameras.paths import orbit_cameras
from nerfvol.config.assemble import assemble, read_yaml
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.files import pictures, run_folder
from nerfvol.files.atomic import ensure_writable_folder
from nerfvol.octree.io import load_octree
from nerfvol.training.prepare import prepare_run

SCENE = "showcase"
VIEWS = 60
SIZE = (400, 400)
ORBIT_VIEWS = 120
ORBIT_SIZE = (600, 600)
SHEET_ROWS = 3


def run_demo(config_file: Path, folder: Path) -> int:
    """Do everything in ``folder`` and print where it is; the exit code."""
    from nerfvol.cli.main import set_threads

    started = time.perf_counter()
    ensure_writable_folder(folder)
    scene, run = folder / "scene", folder / "run"
    _make_scene(scene)
    settings = {"data": str(scene), "out": str(run)}
    config = assemble(Config, (read_yaml(config_file), str(config_file)), (settings, "demo"))
    prepare_run(config)
    set_threads(config.threads)
    from nerfvol.training.train import train

    train(config, started=time.perf_counter())  # the budget is the training's own: the scene is made once
    scores = _score(run, scene, folder)
    video = _orbit(run, folder / "orbit.mp4", config.background)
    octree_file = run_folder.octree_path(run)
    print(
        f"\nDone in {time.perf_counter() - started:.0f} s: PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f} on "
        f"{scores['n_images']} views that were held out, {scores['seconds_per_frame']:.3f} s per frame\n"
        f"  pictures  {folder / 'comparison.png'} (truth | render | error | depth); all: {folder / 'pictures'}\n"
        f"  video     {video}\n"
        f"  scores    {folder / 'scores.json'}\n"
        f"  octree    {octree_file} ({octree_file.stat().st_size / 1e6:.0f} MB)"
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


def _score(run: Path, scene: Path, folder: Path) -> dict[str, Any]:
    """Scores of the test views, their pictures, and a sheet of a few of them."""
    from nerfvol.cli.eval import EvalOptions, run_eval
    from nerfvol.files.atomic import read_json

    run_eval(
        EvalOptions(
            target=str(run), data=str(scene), split="test",
            json=str(folder / "scores.json"), save_images=str(folder / "pictures"),
        )
    )  # fmt: skip
    scores = read_json(folder / "scores.json")
    rows = scores["rows"]
    chosen = [rows[index]["name"] for index in np.linspace(0, len(rows) - 1, min(SHEET_ROWS, len(rows))).astype(int)]
    strips = [_read_png(folder / "pictures" / f"{name}.png") for name in chosen]
    gap = np.full((8, *strips[0].shape[1:]), 255, np.uint8)
    sheet = np.concatenate([piece for strip in strips for piece in (strip, gap)][:-1])
    pictures.write_png(folder / "comparison.png", sheet)
    return scores


def _orbit(run: Path, path: Path, background: tuple[float, float, float]) -> Path:
    from nerfvol.cli.target import find_orbit
    from nerfvol.views import render_image

    octree, metadata = load_octree(run_folder.octree_path(run))
    cameras = orbit_cameras(ORBIT_VIEWS, find_orbit(str(run), octree, metadata), ORBIT_SIZE)
    with pictures.open_video(path, fps=30) as video:
        for camera in cameras:
            video.add(render_image(octree, camera, background, outputs=("rgb",))["rgb"])
    return path


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
