"""``.vdb``: the octree's vertices as OpenVDB grids ``density`` (1/scene unit) and ``color`` (vec3s, the mean over directions).

Voxels are the points of the lattice of the finest level that lie in leaves, their corners among them; a coarser leaf is
filled by its own trilinear values. Programs interpolate trilinearly between voxels, as the leaves do. Around leaves the
field ends, a lattice fades over one voxel: rims grow by half a voxel. Colours are linear unless ``srgb``.
"""

from __future__ import annotations

import os

import numpy as np

from nerfvol.files.atomic import atomic_write
from nerfvol.files.pictures import srgb_to_linear
from nerfvol.models import Model
from nerfvol.octree.points import Y00
from nerfvol.octree.rows import explin, sh_slots
from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel

_PER_VOXEL = 220  # bytes: index, values, order and what sorting takes


def memory(model: Model, full_float: bool = False, srgb: bool = False) -> int:
    """Bytes that writing takes: what a voxel takes, for all leaves split to the finest level."""
    assert isinstance(model, OctreeModel)
    octree = model.octree
    finer = (octree.max_level - octree.leaf_level.astype(np.int64)).astype(np.float64)
    split = float(np.where(finer > 0, 8.0**finer, 0.0).sum())
    return int(_PER_VOXEL * (octree.n_vertices + 1.5 * split) + 4 * 16 * split)


def write(model: Model, path: str | os.PathLike[str], full_float: bool = False, srgb: bool = False) -> int:
    """Both grids; ``full_float``: 32 bits a number instead of 16; ``srgb``: colours as in the training images."""
    from data_synth.vdb_write import LARGEST_HALF, SparseGrid, write_grids

    assert isinstance(model, OctreeModel)
    octree = _at_one_level(model.octree)
    level = octree.max_level
    coords = np.empty((octree.n_vertices, 3), np.int32)
    for o in range(8):
        coords[octree.corners[:, o]] = octree.leaf_ijk + OFFSETS[o]
    density = (octree.density_scale * explin(octree.density)).astype(np.float32)
    if not full_float:
        density = np.minimum(density, np.float32(LARGEST_HALF))  # opaque all the same
    colour = np.clip(0.5 + Y00 * octree.values[:, sh_slots(octree.sh_degree)[:, 0]], 0, 1).astype(np.float32)
    if not srgb:
        colour = srgb_to_linear(colour)
    frame = octree.size / 2.0**level, octree.origin
    grids = [
        SparseGrid("density", coords, density, *frame),
        SparseGrid("color", coords, colour, *frame, kind="unknown"),
    ]
    with atomic_write(path) as temporary:
        return write_grids(temporary, grids, half=not full_float)


def _at_one_level(octree: Octree) -> Octree:
    """All leaves split to the finest level; the field is the same."""
    while (coarse := octree.leaf_level < octree.max_level).any():
        octree, _ = octree.subdivide(coarse)
    return octree
