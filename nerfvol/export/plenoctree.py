"""``.npz`` of a PlenOctree, for svox and volrend (octree/plenoctree.py says what it holds and what is fitted)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from nerfvol.files.atomic import atomic_write
from nerfvol.models import Model
from nerfvol.octree.plenoctree import plenoctree_arrays
from nerfvol.views import OctreeModel


def memory(model: Model) -> int:
    """Bytes that writing takes: the dense cells of all nodes, and the leaves' coefficients."""
    assert isinstance(model, OctreeModel)
    octree, numbers = model.octree, 3 * (model.octree.sh_degree + 1) ** 2 + 1
    return octree.n_nodes * 8 * (2 * numbers + 40) + octree.n_leaves * (16 * numbers + 100) + (100 << 20)


def write(model: Model, path: str | os.PathLike[str]) -> int:
    """Leaves as cells of constant density and colour: what is inside them varies no more."""
    assert isinstance(model, OctreeModel)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **plenoctree_arrays(model.octree))  # type: ignore[arg-type]
    return Path(path).stat().st_size
