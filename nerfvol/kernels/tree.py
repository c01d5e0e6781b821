"""The kernels' view of an octree."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfvol.native import native
from nerfvol.octree import lod
from nerfvol.octree.rows import BLOCKS
from nerfvol.octree.tree import Octree


def kernel_tree(octree: Octree, values: np.ndarray, coarse: float = 0.0) -> Any:
    """The kernels' view of ``octree`` with ``values`` (n_vertices, row) in place of its own.

    Where ``coarse`` > 0, nodes whose side is below ``coarse`` times their distance stand in for their leaves.
    """
    compiled = native()
    assert compiled is not None
    shape = (octree.n_vertices, 16 * BLOCKS[octree.sh_degree])
    if values.shape != shape or values.dtype != np.float32:
        raise ValueError(f"the octree's values must be float32 {shape}, got {values.dtype} {values.shape}")
    averages = lod.node_averages(octree) if coarse > 0 else None
    return compiled.Tree(
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
        averages and averages.corners,
        averages and averages.values,
        coarse,
    )
