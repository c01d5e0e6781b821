"""The run folder: what lies where, and which file a RUN|FILE argument means."""

from __future__ import annotations

import os
from pathlib import Path

from nerfvol.errors import InputError

CONFIG = "config.yaml"
OCTREE = "octree.safetensors"
SPLATS = "splats.safetensors"
FIELD = "field.safetensors"
MEDIUM = "medium.safetensors"
PRODUCTS = (OCTREE, SPLATS, FIELD, MEDIUM)
"""Models that a finished run may hold."""
CHECKPOINT = "checkpoint.safetensors"
DISTILLED = "distilled.safetensors"
METRICS = "metrics.json"
PHOTOGRAPHS = "photographs.csv"
PHOTOGRAPHS_PAGE = "photographs.html"
REFINED = "refined_poses.json"
LOG = "log.jsonl"
PREVIEWS = "previews"
PREVIOUS = "previous"
UNFINISHED = "unfinished"
"""Where a run without a model goes when ``previous`` holds one that must not be lost to it."""


def model_path(target: str | os.PathLike[str]) -> Path:
    """The file of the model that RUN|FILE means; a missing one is an InputError that says what was looked for."""
    path = Path(target)
    if path.is_dir():
        for name in PRODUCTS:
            if (path / name).is_file():
                return path / name
        if not (path / CONFIG).is_file():
            raise InputError(f"{path} is no run folder: it holds neither {' nor '.join((*PRODUCTS, CONFIG))}")
        raise InputError(f"{path} holds no {' or '.join(PRODUCTS)}: it is no finished run folder")
    if not path.exists():
        raise InputError(f"no such run folder or model file: {path}")
    return path
