"""``.spz``: Gaussians in about a fifth of a PLY, through an optional library (splats/spz.py says what is rounded)."""

from __future__ import annotations

import os

from nerfvol.export import splats
from nerfvol.export.part import Up
from nerfvol.models import Model
from nerfvol.splats.spz import save_spz


def memory(model: Model, up: Up = "none") -> int:
    """Bytes that writing takes: the arrays, the library's copy, its packed bytes."""
    return 2 * splats.memory(model, up)


def write(model: Model, path: str | os.PathLike[str], up: Up = "none") -> int:
    """The Gaussians of splats.splats_of, in version 3, which is read everywhere."""
    return save_spz(path, splats.splats_of(model, up))
