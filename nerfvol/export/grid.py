"""``.npz`` and ``.npy``: an octree's density, or the opacity of a voxel, on a dense grid.

Samples are at the centres of cubic voxels of the box around the leaves, index order x, y, z. An .npz holds ``density`` (or
``opacity``), ``lo``, ``hi`` and ``voxel_size`` (3,), as the density.npz of a synthetic scene does; next to an .npy lies a
.json of the same name that says the same.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, write_json
from nerfvol.models import Model
from nerfvol.octree.points import octree_density
from nerfvol.views import OctreeModel

Quantity = Literal["sigma", "opacity"]
RESOLUTION = 256
LARGEST = 2048
_RUN = 1 << 18  # samples that are asked for at a time
_PER_SAMPLE = 400  # bytes of such a sample


def _grid(model: Model, resolution: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float, tuple[int, ...]]:
    """lo, hi (3,), the voxel's side and the shape; hi is moved out to whole voxels."""
    if not 1 <= resolution <= LARGEST:
        raise InputError(f"--resolution must lie between 1 and {LARGEST}, got {resolution}")
    lo, hi = model.aabb()
    voxel = float((hi - lo).max() / resolution)
    shape = np.maximum(np.ceil((hi - lo) / voxel - 1e-6), 1).astype(int)
    return lo, lo + shape * voxel, voxel, tuple(int(n) for n in shape)


def memory(model: Model, resolution: int = RESOLUTION, quantity: Quantity = "sigma") -> int:
    """Bytes that writing takes: the grid in float32 once, and a run of samples."""
    shape = _grid(model, resolution)[3]
    return 4 * int(np.prod(shape, dtype=object)) + _PER_SAMPLE * _RUN


def write(
    model: Model, path: str | os.PathLike[str], resolution: int = RESOLUTION, quantity: Quantity = "sigma"
) -> int:
    """The grid with ``resolution`` voxels along the longest side of the leaves' box."""
    assert isinstance(model, OctreeModel)
    lo, hi, voxel, shape = _grid(model, resolution)
    values = np.empty(shape, np.float32)
    flat = values.reshape(-1)
    for at in range(0, flat.size, _RUN):
        index = np.arange(at, min(at + _RUN, flat.size))
        places = lo + (np.stack(np.unravel_index(index, shape), axis=1) + 0.5) * voxel
        sigma = octree_density(model.octree, places)
        flat[index] = sigma if quantity == "sigma" else -np.expm1(-sigma * voxel)
    name = "density" if quantity == "sigma" else quantity
    box = {"lo": lo, "hi": hi, "voxel_size": np.full(3, voxel)}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        if Path(path).suffix.lower() == ".npz":
            np.savez_compressed(file, **{name: values}, **box)
        else:
            np.save(file, values)
    if Path(path).suffix.lower() != ".npz":
        write_json(
            Path(path).with_suffix(".json"), {"quantity": quantity, **{key: a.tolist() for key, a in box.items()}}
        )
    return Path(path).stat().st_size
