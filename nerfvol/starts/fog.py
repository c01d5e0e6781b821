"""The low-density start: a nearly transparent octree that fills the scene."""

from __future__ import annotations

import numpy as np

from nerfvol.datasets.dataset import Dataset
from nerfvol.octree.rows import DENSITY_SCALE
from nerfvol.octree.tree import Octree


def low_density_octree(dataset: Dataset, level: int, sh_degree: int) -> Octree:
    """A nearly transparent octree: 2**level cells along the inner cube, then shells of doubling cells to the horizon.

    Each shell reaches twice as far as the one inside it with cells twice as large, so that cells look about equally
    large from the middle. Right before the lenses there is nothing (Dataset.before_a_lens).
    """
    scene = dataset.scene
    lo, hi = scene.aabb
    detail, shells, n = float((hi - lo).max()), scene.n_shells, 2**level
    size = detail * 2**shells
    origin = (lo + hi) / 2 - size / 2
    cube = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    levels, cells = [], []
    for shell in range(shells + 1):
        inner = ((cube >= n // 4) & (cube < n - n // 4)).all(1)
        ijk = cube if shell == 0 else cube[~inner]
        levels.append(np.full(len(ijk), level + shells - shell))
        cells.append(ijk + (2 ** (level + shells - shell) - n) // 2)
    levels, cells = np.concatenate(levels), np.concatenate(cells)
    kept = ~dataset.before_a_lens(origin + (cells + 0.5) * (size / 2.0**levels)[:, None])
    levels, cells = levels[kept], cells[kept]
    return Octree.from_leaves(levels, cells, origin, size, sh_degree, density_scale=DENSITY_SCALE / detail)
