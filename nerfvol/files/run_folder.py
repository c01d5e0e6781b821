"""The run folder: what lies where, what a RUN|FILE argument means, and how an earlier run in the way is kept."""

from __future__ import annotations

import os
from pathlib import Path

from nerfvol.errors import InputError

CONFIG = "config.yaml"
OCTREE = "octree.safetensors"
CHECKPOINT = "checkpoint.safetensors"
DISTILLED = "distilled.safetensors"
METRICS = "metrics.json"
LOG = "log.jsonl"
PREVIEWS = "previews"
PREVIOUS = "previous"


def octree_path(target: str | os.PathLike[str]) -> Path:
    """The octree file that RUN|FILE means; a missing one is an InputError that says what was looked for."""
    path = Path(target)
    if path.is_dir():
        found = path / OCTREE
        if not found.is_file():
            raise InputError(f"{path} holds no {OCTREE}: it is no finished run folder")
        return found
    if not path.exists():
        raise InputError(f"no such run folder or octree file: {path}")
    return path
