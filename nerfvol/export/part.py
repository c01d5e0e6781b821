"""What of a model is written: the part inside a box, and an octree's levels down to one; and which way up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.clouds import PointModel
from nerfvol.errors import InputError
from nerfvol.models import Model
from nerfvol.octree.lod import simplified
from nerfvol.rotations import between
from nerfvol.views import OctreeModel, SplatModel

Up = Literal["none", "+x", "-x", "+y", "-y", "+z", "-z"]


def part_of(model: Model, level: int | None = None, crop: Sequence[float] | None = None) -> Model:
    """``model`` without what lies outside the box ``crop`` (x0, y0, z0, x1, y1, z1), scene units, and without leaves finer
    than ``level``. What has its middle in the box is inside.

    Raises:
        InputError: there is nothing in the box, or a level for what has none or below 1.
    """
    if crop is not None:
        model = _cropped(model, np.asarray(crop, np.float64).reshape(2, 3))
    if level is not None:
        if not isinstance(model, OctreeModel):
            raise InputError(f"--level is for octrees, this is a model of {model.kind}")
        if level < model.octree.max_level:
            model = OctreeModel(simplified(model.octree, level), model.metadata)
    return model


def _cropped(model: Model, box: NDArray[np.float64]) -> Model:
    def inside(places: NDArray) -> NDArray[np.bool_]:
        chosen = ((places >= box[0]) & (places <= box[1])).all(axis=1)
        if not chosen.any():
            low, high = (", ".join(f"{x:.3g}" for x in corner) for corner in model.aabb())
            raise InputError(f"--crop: nothing of the model lies in this box; it reaches from {low} to {high}")
        return chosen

    if isinstance(model, OctreeModel):
        return OctreeModel(model.octree.prune(inside(model.octree.leaf_centers()))[0], model.metadata)
    if isinstance(model, SplatModel):
        splats = model.splats
        return SplatModel(splats.select(inside(splats.means.astype(np.float64) + splats.origin)), model.metadata)
    if not isinstance(model, PointModel):
        raise InputError(f"--crop is for octrees, splats and points, this is a model of {model.kind}")
    cropped = PointModel(model.cloud[inside(model.cloud.positions)], model.metadata)
    cropped.composite = model.composite
    return cropped


def turn_to(model: Model, up: Up) -> NDArray[np.float64]:
    """The rotation (3, 3) by the smallest angle that takes the model's up axis to ``up``; "none": none.

    The model's up axis is that of its orbit, the mean of its training cameras, or +z.
    """
    if up == "none":
        return np.eye(3)
    orbit = model.metadata.get("orbit")
    stated = orbit.get("up") if isinstance(orbit, dict) else None
    source = np.asarray((0.0, 0.0, 1.0) if stated is None else stated, np.float64)
    source = source / np.linalg.norm(source)
    target = (1.0 if up[0] == "+" else -1.0) * np.eye(3)["xyz".index(up[1])]
    return between(source, target)
