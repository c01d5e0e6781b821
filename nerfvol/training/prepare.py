"""Before a run begins: its folder, the settings it is resumed with, and what becomes of an earlier run in its place."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

from nerfvol.config.assemble import read_yaml, to_plain, write_yaml
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.files.atomic import ensure_writable_folder, explain_os_error
from nerfvol.files.run_folder import CHECKPOINT, CONFIG, DISTILLED, LOG, METRICS, OCTREE, PREVIOUS

_FILES = (CONFIG, OCTREE, DISTILLED, CHECKPOINT, METRICS, LOG)


_FREE = {"data", "out", "time_budget", "threads", "resume", "checkpoint_every", "storage", "compare_views"}
"""Settings that a resumed run may change; all others have already shaped its numbers."""


def resumable_config(run: str | os.PathLike[str]) -> Path:
    """RUN/config.yaml of a run that can be resumed."""
    config, checkpoint = Path(run) / CONFIG, Path(run) / CHECKPOINT
    for path in (config, checkpoint):
        if not path.is_file():
            raise InputError(f"--resume: {run} holds no {path.name}, so there is nothing to resume")
    return config


def prepare_run(config: Config) -> Path:
    """Make the run folder, prove that it can be written, put an earlier run aside and write the resolved config.

    An earlier run in the same folder moves to RUN/previous (one generation is kept), unless this run resumes it.
    """
    run = ensure_writable_folder(config.out)
    if config.resume:
        _refuse_changes(read_yaml(run / CONFIG), to_plain(config))
    else:
        _set_aside(run)
    write_yaml(run / CONFIG, dataclasses.replace(config, resume=False))  # the file as --config starts a run of its own
    return run


def _refuse_changes(old: dict[str, Any], new: dict[str, Any]) -> None:
    """An InputError where a resumed run is asked for other settings than the ones it was begun with."""
    for key, value in new.items():
        before = old.get(key, value)
        if key in _FREE or before == value:
            continue
        if isinstance(value, dict) and isinstance(before, dict):
            inner = next(name for name in value if before.get(name) != value[name])
            key, before, value = f"{key}.{inner}", before.get(inner), value[inner]
        raise InputError(
            f"--resume: the run was begun with {key} = {before}, which cannot become {value} half-way; "
            "leave the option out, or train anew"
        )


def _set_aside(run: Path) -> None:
    old = [run / name for name in _FILES if (run / name).is_file()]
    if not old:
        return
    previous = ensure_writable_folder(run / PREVIOUS)
    try:
        for name in _FILES:  # a file of the generation before must not mix with it
            (previous / name).unlink(missing_ok=True)
        for path in old:
            os.replace(path, previous / path.name)
    except OSError as error:
        raise InputError(f"cannot move the earlier run to {previous}: {explain_os_error(error)}") from error
