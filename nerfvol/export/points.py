"""``.ply`` of coloured points: x y z float32, scene units, red green blue bytes as in the training images.

Of an octree the centres of leaves, of splats their means, of a cloud its points; each with the colour that it shows on average
over all directions. Only what is opaque enough: a leaf along its side, a splat in its middle.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from nerfvol.clouds import PointModel
from nerfvol.errors import InputError
from nerfvol.models import Model
from nerfvol.octree.points import octree_density
from nerfvol.splats.plyfile import write_ply
from nerfvol.splats.points import Y00
from nerfvol.views import OctreeModel, SplatModel

Places = tuple[NDArray, NDArray, NDArray]
"""Positions (n, 3), colours (n, 3), opacities (n,)."""


def memory(model: Model, threshold: float = 0.5) -> int:
    """Bytes that writing takes: float64 positions, colours, densities and what they are made of."""
    if isinstance(model, OctreeModel):
        return 600 * model.octree.n_leaves
    return 300 * (len(model.cloud) if isinstance(model, PointModel) else model.splats.n)  # type: ignore[attr-defined]


def write(model: Model, path: str | os.PathLike[str], threshold: float = 0.5) -> int:
    """Points of opacity ``threshold`` or more.

    Raises:
        InputError: none is so opaque, or the path cannot be written.
    """
    positions, colours, opacity = _places(model)
    shown = opacity >= threshold
    if not shown.any():
        raise InputError(
            f"nothing is as opaque as {threshold:g}, the most is {opacity.max(initial=0.0):.3g}: lower --threshold"
        )
    columns: dict[str, NDArray] = {name: positions[shown, k].astype(np.float32) for k, name in enumerate("xyz")}
    bytes_ = np.round(255 * np.clip(colours[shown], 0, 1)).astype(np.uint8)
    columns |= {name: bytes_[:, k] for k, name in enumerate(("red", "green", "blue"))}
    return write_ply(path, [], columns)


def _places(model: Model) -> Places:
    if isinstance(model, OctreeModel):
        octree = model.octree
        centers = octree.leaf_centers()
        opacity = -np.expm1(-octree_density(octree, centers) * octree.leaf_sizes())
        constant = np.zeros((octree.n_leaves, 3))
        sh = octree.sh[:, :, 0]
        for corner in range(8):
            constant += sh[octree.corners[:, corner]] / 8
        return centers, 0.5 + Y00 * constant, opacity
    if isinstance(model, SplatModel):
        splats = model.splats
        means = splats.means.astype(np.float64) + splats.origin
        return means, 0.5 + Y00 * splats.sh[:, :, 0], 1 / (1 + np.exp(-splats.logits.astype(np.float64)))
    assert isinstance(model, PointModel)
    return model.cloud.positions, model.cloud.colours, np.ones(len(model.cloud))
