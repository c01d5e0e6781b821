"""Runs on the tiny scene that take a second, and what they leave."""

import dataclasses
import json
from pathlib import Path

from nerfvol.cli import main
from nerfvol.config.assemble import assemble
from nerfvol.config.training import Config
from nerfvol.files import run_folder
from nerfvol.training import train
from nerfvol.training.prepare import prepare_run

TINY = {
    "threads": 1,
    "checkpoint_every": 1e-9,  # after every step
    "storage": "float32",
    "octree": {
        "steps": 60, "levels": [4, 5, 5], "downscales": [2, 1, 1], "until": [0.3, 0.6, 1.0], "tiles": [16, 16, 16],
        "prunes": [1, 1, 1], "prune_steps": 2,
    },
    "field": {
        "steps": 20, "downscales": [4, 2], "stage_ends": [0.3, 1.0], "march_steps": [32, 48], "samples_per_step": 2048,
        "max_rays": 512, "grid_resolution": 16,
        "shape": {"width": 16, "hash_levels": 4, "hash_log2_table": 10, "hash_min": 4, "hash_max": 24},
    },
    "distill": {"level": 5, "coarse_level": 3, "compare_downscale": 2, "visibility_downscale": 1},
}  # fmt: skip


def settings(scene, out, **more) -> Config:
    return assemble(Config, (TINY, "tiny"), ({"data": str(scene), "out": str(out), **more}, "test"))


def start(config: Config, **keywords) -> Path:
    prepare_run(config)
    main.set_threads(config.threads)
    return train.train(config, **keywords)


def product(run: Path) -> bytes:
    """The octree file, without the lengths of its metadata's paths mattering: all runs read the same scene."""
    return (run / run_folder.OCTREE).read_bytes()


def log_of(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / run_folder.LOG).read_text().splitlines()]


def metrics_of(run: Path) -> dict:
    return json.loads((run / run_folder.METRICS).read_text())


@dataclasses.dataclass
class Pretended:
    """What a run asks of a phase for its plans."""

    name: str
    n_leaves: int = 0
    steps_done: int = 0
    most_steps: float = 1000.0
