"""What the kernels take: views of an octree and of a batch, and options whose fields travel by their names."""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

import numpy as np

from nerfvol.kernels.state import Batch, LeafStatistics, LossOptions, Rates
from nerfvol.native import native
from nerfvol.octree import lod
from nerfvol.octree.rows import BLOCKS
from nerfvol.octree.tree import Octree


def kernel_tree(octree: Octree, values: np.ndarray, coarse: float = 0.0) -> Any:
    """The kernels' view of ``octree`` with ``values`` (n_vertices, row) in place of its own.

    Where ``coarse`` > 0, nodes whose side is below ``coarse`` times their distance are drawn in place of their leaves. Raises
    ValueError where the values do not fit the octree.
    """
    shape = (octree.n_vertices, 16 * BLOCKS[octree.sh_degree])
    if values.shape != shape or values.dtype != np.float32:
        raise ValueError(f"the octree's values must be float32 {shape}, got {values.dtype} {values.shape}")
    prefiltered = lod.prefiltered_nodes(octree) if coarse > 0 else None
    return _compiled().Tree(
        octree.node_mask,
        octree.leaf_mask,
        octree.first_node,
        octree.first_leaf,
        octree.corners,
        values,
        octree.sh_degree,
        [float(x) for x in octree.origin],
        octree.size,
        octree.density_scale,
        prefiltered and prefiltered.corners,
        prefiltered and prefiltered.values,
        coarse,
    )


def kernel_batch(rays_o: np.ndarray, rays_d: np.ndarray, batch: Batch) -> Any:
    """The kernels' view of a batch whose rays were checked (checks.check_batch)."""
    return _compiled().Batch(rays_o=rays_o, rays_d=rays_d, target=batch.target, weight=batch.weight)


def kernel_options(options: LossOptions | Rates) -> Any:
    """``options`` as the kernels' class of the same name, field by field; AttributeError for one that they do not have."""
    out = getattr(_compiled(), type(options).__name__)()
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        setattr(out, field.name, float(value) if np.ndim(value) == 0 else [float(x) for x in value])
    return out


def kernel_statistics(statistics: LeafStatistics, pixel_angle: float) -> Any:
    """The kernels' view of arrays that they update; pixel_angle: between neighbouring rays, radians."""
    s = statistics
    return _compiled().LeafStatistics(
        max_weight=s.max_weight, error=s.error, footprint=s.footprint, pixel_angle=float(pixel_angle)
    )


def _compiled() -> ModuleType:
    compiled = native()
    assert compiled is not None
    return compiled
