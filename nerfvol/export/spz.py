"""``.spz``: Gaussians in about a fifth of a PLY, through an optional library (splats/spz.py says what is rounded)."""

from __future__ import annotations

import os

from nerfvol.models import Model
from nerfvol.splats.spz import save_spz


def memory(model: Model) -> int:
    """Bytes that writing takes: the arrays, the library's copy, its packed bytes."""
    splats = model.splats  # type: ignore[attr-defined]
    return 4 * sum(array.nbytes for array in (splats.means, splats.log_scales, splats.quats, splats.logits, splats.sh))


def write(model: Model, path: str | os.PathLike[str]) -> int:
    """The Gaussians of a model of splats, or those that draw a point cloud, in version 3, which is read everywhere."""
    return save_spz(path, model.splats)  # type: ignore[attr-defined]
