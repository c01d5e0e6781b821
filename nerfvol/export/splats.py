"""``.ply`` of Gaussians, the layout of 3D Gaussian splatting (splats/ply.py says what it holds)."""

from __future__ import annotations

import os

from nerfvol.models import Model
from nerfvol.splats.ply import save_ply


def memory(model: Model) -> int:
    """Bytes that writing takes: the arrays once more, and the columns that are made of them."""
    splats = model.splats  # type: ignore[attr-defined]
    return 3 * sum(array.nbytes for array in (splats.means, splats.log_scales, splats.quats, splats.logits, splats.sh))


def write(model: Model, path: str | os.PathLike[str]) -> int:
    """The Gaussians of a model of splats, or those that draw a point cloud; positions are absolute float32."""
    return save_ply(path, model.splats)  # type: ignore[attr-defined]
