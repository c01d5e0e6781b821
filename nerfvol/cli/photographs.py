"""Photographs that have no poses yet: what commands on posed images say of them, and how they get some."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from nerfvol.config.training import Config
from nerfvol.datasets.formats import FORMATS
from nerfvol.errors import InputError

SCENE = "scene"
"""Folder inside a run for the photographs' copies and their cameras."""


def without_poses(path: Path) -> bool:
    """Whether ``path`` is a video, or a folder of pictures that no format of posed images recognises."""
    if not path.is_file() and (not path.is_dir() or any(row.reader.recognises(path) for row in FORMATS)):
        return False
    from nerfvol.poses.sources import HEIF_SUFFIXES, SUFFIXES, is_video

    if path.is_file():
        return is_video(path)
    found = (file for folder in (path, path / "images") if folder.is_dir() for file in folder.iterdir())
    return any(file.suffix.lower() in (*SUFFIXES, *HEIF_SUFFIXES) or is_video(file) for file in found)


def with_poses(config: Config) -> Config:
    """The settings with data that has poses: the same, or, with ``poses: auto``, RUN/scene, made now.

    Raises:
        InputError: photographs without poses and no ``poses: auto``, with what to do; or no cameras follow from them.
    """
    path = Path(config.data)
    if not without_poses(path):
        return config
    if config.poses != "auto":
        raise InputError(
            f"--data {path}: these pictures have no camera poses yet; `nerfvol poses {path} --out scene` finds them (then "
            f"--data scene), --poses auto does it on the way, and `nerfvol capture {path} --out {config.out or 'run'}` does all"
        )
    from nerfvol.cli.poses import print_poses
    from nerfvol.poses.make import PoseSettings, make_poses

    scene = Path(config.out) / SCENE
    print_poses(make_poses(path, scene, PoseSettings(seed=config.seed, threads=config.threads)))
    return dataclasses.replace(config, data=str(scene))
