"""``nerfvol capture``: from photographs or a video to a model, a page and a film, in one command that can be interrupted.

Each step leaves its product whole or not at all, and a step whose product is there is not done again: the same command goes
on where it was stopped, cameras and training in the middle too.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from nerfvol.cli.command import Command, need, set_threads
from nerfvol.cli.photographs import SCENE
from nerfvol.config.parsers import Seconds
from nerfvol.config.values import Count, at_least, within
from nerfvol.errors import InputError, shown

if TYPE_CHECKING:
    from nerfvol.training.train import Results

VIDEO, PAGE = "video.mp4", "scene.html"
FILM_VIEWS, FILM_SIDE = 150, 960
TIME_BUDGET = 120.0
"""Seconds of training where nobody says."""
SECONDS_A_PHOTOGRAPH, SECONDS_AT_THE_END = 0.4, 15.0
"""What a bar expects before it knows."""


@dataclass
class CaptureOptions:
    """``nerfvol capture``. ``time_budget``: of the training alone; None: what the folder's run was begun with, else
    :data:`TIME_BUDGET`."""

    source: str = ""
    out: str = ""
    time_budget: Seconds | None = None
    frames: Annotated[int, within(3, 2000)] = 120
    size: Annotated[int, within(200, 8000)] = 1000
    fisheye: bool = False
    views: Count = FILM_VIEWS
    threads: Annotated[int, at_least(0)] = 0
    seed: Annotated[int, at_least(0)] = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    p.add_argument("source", metavar="PHOTOS|VIDEO", nargs="?", help="folder of photographs, or a video")
    p.add_argument("--out", metavar="RUN", help="run folder: scene/ (pictures and cameras), the model, photographs.csv, "
                   "video.mp4")  # fmt: skip
    p.add_argument("--config", metavar="FILE", help="YAML file of this command's options")
    p.add_argument("--time-budget", metavar="TIME", help="for the training (default: 2m; of a run that goes on: what it was "
                   "begun with)")  # fmt: skip
    p.add_argument("--frames", metavar="N", help="most frames that are taken of a video (default: 120)")
    p.add_argument("--size", metavar="PIXELS", help="longest side of the pictures that are trained on (default: 1000)")
    p.add_argument("--fisheye", action="store_true", help="the lens is a fisheye (OpenCV's model)")
    p.add_argument("--views", metavar="N", help="pictures of the film (default: 150)")
    p.add_argument("--threads", metavar="N", help="CPU threads (default: all)")
    p.add_argument("--seed", metavar="N", help="seed of every random choice (default: 0)")


class Bar:
    """One bar over all steps with the time left; silent where the output is no terminal.

    ``expected``: seconds by step, in order. A step's own progress goes from 0 to 1.
    """

    def __init__(self, expected: dict[str, float]) -> None:
        self.expected, self.started = expected, time.perf_counter()
        self.shown = sys.stderr.isatty()

    def at(self, step: str, share: float, note: str = "") -> None:
        """The ``step`` is done to ``share``."""
        if not self.shown:
            return
        total, before = sum(self.expected.values()), 0.0
        for name, seconds in self.expected.items():
            if name == step:
                break
            before += seconds
        left = total - before - min(1.0, share) * self.expected[step]
        done = 1 - left / total
        line = f"{step:8s} {100 * done:3.0f}% |{'#' * round(20 * done):20s}| about {_minutes(left)} left  {note}"
        print(f"\r{line:100.100s}", end="", file=sys.stderr, flush=True)

    def say(self, sentence: str) -> None:
        """A sentence above the bar."""
        if self.shown:
            print(f"\r{'':100s}\r", end="", file=sys.stderr, flush=True)
        print(sentence, flush=True)


class TrainingBar:
    """What training takes for its own bar, passed on to the one over all steps."""

    def __init__(self, bar: Bar, done: float) -> None:
        self._bar, self._done, self._note = bar, done, ""

    def set_postfix_str(self, text: str, refresh: bool = False) -> None:
        """See tqdm."""
        self._note = text

    def update(self, more: float) -> None:
        """See tqdm."""
        self._done += more
        self._bar.at("training", self._done, self._note)

    def __enter__(self) -> TrainingBar:
        return self

    def __exit__(self, *failure: object) -> None:
        pass


def _minutes(seconds: float) -> str:
    return f"{round(seconds)} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def run(options: CaptureOptions) -> int:
    """Does every step that is not done and prints what came of it; the exit code.

    Raises:
        InputError: no pictures, none that hang together, pycolmap is missing, or the folder holds another capture.
    """
    if not options.source:
        raise InputError("nerfvol capture needs PHOTOS|VIDEO (see `nerfvol capture --help`)")
    need("capture", out=options.out)
    started = time.perf_counter()
    set_threads(options.threads)
    out = Path(options.out)
    bar = Bar({"cameras": options.frames * SECONDS_A_PHOTOGRAPH, "training": options.time_budget or TIME_BUDGET,
               "film": SECONDS_AT_THE_END})  # fmt: skip
    find_cameras(options, out / SCENE, bar)
    train_model(options, out, bar)
    products = [*write_page(out, bar), *write_film(options, out, bar)]
    bar.say(f"done in {time.perf_counter() - started:.0f} s: {', '.join(map(str, products))}")
    return 0


def find_cameras(options: CaptureOptions, scene: Path, bar: Bar) -> None:
    """The pictures and their cameras in ``scene``."""
    from nerfvol.cli.poses import print_poses
    from nerfvol.poses.child import Progress
    from nerfvol.poses.make import PoseSettings, make_poses

    settings = PoseSettings(
        frames=options.frames, size=options.size, fisheye=options.fisheye, seed=options.seed, threads=options.threads
    )
    progress = Progress(lambda step, share: bar.at("cameras", share, step))
    print_poses(make_poses(options.source, scene, settings, bar.say, progress))


def train_model(options: CaptureOptions, out: Path, bar: Bar) -> None:
    """The model in ``out``: trained, trained on from a checkpoint, or there already."""
    from nerfvol.cli.train import print_results
    from nerfvol.config.assemble import assemble, read_yaml
    from nerfvol.config.training import Config
    from nerfvol.files.run_folder import CONFIG, PREVIOUS
    from nerfvol.training.train import train

    asked: dict[str, Any] = {} if options.time_budget is None else {"time_budget": options.time_budget}
    going_on = training_state(out, out / SCENE)
    saved = read_yaml(out / CONFIG) if going_on != "none" else {}
    if going_on == "finished":
        before = saved.get("time_budget")
        if asked.get("time_budget", before) == before:
            bar.say(f"the model is there already: {out}")
            return
        bar.say(f"the model that is there had a time budget of {shown(before)} s: it goes to {out / PREVIOUS}, and another "
                "is trained")  # fmt: skip
    if going_on == "begun":
        layers = [(saved, str(out / CONFIG)), ({"resume": True, **asked}, "capture")]
    else:
        settings = {"data": str(out / SCENE), "out": str(out), "time_budget": TIME_BUDGET, "seed": options.seed,
                    "threads": options.threads}  # fmt: skip
        layers = [(settings, "capture"), (asked, "capture")]
    results: Results | None = train(
        assemble(Config, *layers), time.perf_counter(), bar.say, lambda name, done: TrainingBar(bar, done)
    )
    bar.say("")
    if results is not None:
        print_results(results)


def training_state(out: Path, scene: Path) -> str:
    """``none``, ``begun`` (a checkpoint of this scene's training is there) or ``finished``."""
    from nerfvol.config.assemble import read_yaml
    from nerfvol.files.run_folder import CHECKPOINT, CONFIG
    from nerfvol.poses.make import REPORT
    from nerfvol.training.saved import read_saved

    config, checkpoint, report = out / CONFIG, out / CHECKPOINT, scene / REPORT
    if not config.is_file() or not checkpoint.is_file():
        return "none"
    if Path(read_yaml(config).get("data", "")) != scene or config.stat().st_mtime < report.stat().st_mtime:
        return "none"  # of other pictures, or older than these cameras
    try:
        return "finished" if read_saved(checkpoint)["phase"] == "done" else "begun"
    except InputError:
        return "none"


def write_page(out: Path, bar: Bar) -> list[Path]:
    """The page that shows the model in a browser, where this version exports one."""
    from nerfvol.export import EXPORTS, export_model
    from nerfvol.files.run_folder import model_path
    from nerfvol.models import load_model

    if not any(".html" in row.suffixes for row in EXPORTS):
        return []
    page, model = out / PAGE, model_path(out)
    if not _newer(page, model):
        bar.at("film", 0.0, "page")
        export_model(load_model(model), page)
    return [page]


def write_film(options: CaptureOptions, out: Path, bar: Bar) -> list[Path]:
    """A video around the scene, or within the arc that was seen."""
    from nerfvol.cameras.paths import orbit_cameras
    from nerfvol.cli.target import open_target
    from nerfvol.files.run_folder import model_path
    from nerfvol.film import Film, write_videos

    video = out / VIDEO
    if _newer(video, model_path(out)):
        return [video]
    bar.at("film", 0.2, "video")
    target = open_target(str(out))
    cameras = orbit_cameras(options.views, target.orbit(), (FILM_SIDE, FILM_SIDE * 9 // 16))
    return write_videos(video, Film(target.model, cameras, target.background), fps=30)


def _newer(product: Path, source: Path) -> bool:
    return product.is_file() and product.stat().st_mtime >= source.stat().st_mtime


COMMAND = Command(
    summary="From photographs or a video to a model and a film, in one command (needs nerfvol[poses]).",
    example="nerfvol capture walk.mp4 --out run\nnerfvol capture photos --out run --time-budget 5m",
    options=CaptureOptions,
    arguments=arguments,
    run=run,
    place=7,
)
