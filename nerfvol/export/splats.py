"""``.ply`` of Gaussians, the layout of 3D Gaussian splatting (splats/ply.py says what it holds); of an octree its leaves."""

from __future__ import annotations

import os

from nerfvol.export.part import Up, turn_to
from nerfvol.models import Model
from nerfvol.splats.ply import save_ply
from nerfvol.splats.splats import Splats
from nerfvol.splats.turn import turned
from nerfvol.starts.gaussians import splats_of_leaves
from nerfvol.views import OctreeModel


def memory(model: Model, up: Up = "none") -> int:
    """Bytes that writing takes: the arrays once more, turned, and the columns that are made of them."""
    if isinstance(model, OctreeModel):
        return model.octree.n_leaves * (300 + 3 * 3 * 8 * (model.octree.sh_degree + 1) ** 2)
    splats = model.splats  # type: ignore[attr-defined]
    copies = 3 if up == "none" else 6
    return copies * sum(a.nbytes for a in (splats.means, splats.log_scales, splats.quats, splats.logits, splats.sh))


def splats_of(model: Model, up: Up = "none") -> Splats:
    """The Gaussians of a model of splats, those that draw a point cloud, or an octree's leaves (leaves.py); turned so that the
    model's up axis is ``up``, their colours with them."""
    splats = splats_of_leaves(model.octree) if isinstance(model, OctreeModel) else model.splats  # type: ignore[attr-defined]
    return turned(splats, turn_to(model, up))


def write(model: Model, path: str | os.PathLike[str], up: Up = "none") -> int:
    """See :func:`splats_of`; positions are absolute float32."""
    return save_ply(path, splats_of(model, up))
