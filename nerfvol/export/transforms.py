"""``.json`` of cameras as nerfstudio, instant-ngp and our own ``--data`` and ``--cameras`` read them (cameras/paths.py)."""

from __future__ import annotations

import os
from pathlib import Path

from nerfvol.cameras.paths import cameras_document
from nerfvol.errors import InputError
from nerfvol.export.surface import Cameras
from nerfvol.files.atomic import write_json
from nerfvol.models import Model


def memory(model: Model, cameras: Cameras | None = None) -> int:
    """Bytes that writing takes."""
    return 1 << 14 if cameras is None else 4000 * len(cameras.cameras)


def write(model: Model, path: str | os.PathLike[str], cameras: Cameras | None = None) -> int:
    """The cameras with their intrinsics frame by frame; InputError where there are none."""
    given = require_cameras(cameras, "transforms")
    document = cameras_document(given.cameras, given.names)
    low, high = model.aabb()
    write_json(path, {"aabb": [low.tolist(), high.tolist()], **document})
    return Path(path).stat().st_size


def require_cameras(cameras: Cameras | None, format: str) -> Cameras:
    """``cameras``; InputError where there are none."""
    if cameras is None or not len(cameras.cameras):
        raise InputError(
            f"the format {format} writes cameras, and nothing says which: give --cameras FILE|DATA, or a run with its data"
        )
    return cameras
