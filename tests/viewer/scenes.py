"""Small models that a page shows: a coloured ball of leaves of two levels, and a ball of splats."""

import numpy as np

from nerfvol.octree.tree import Octree
from nerfvol.splats.splats import Splats
from nerfvol.views import OctreeModel, SplatModel

ORBIT = {
    "center": [0.0, 0.0, 0.0],
    "radius": 3.0,
    "elevation_deg": 20.0,
    "up": [0.0, 0.0, 1.0],
    "camera_angle_x": 0.8,
    "size": [300, 200],
}
METADATA = {"background": [1.0, 0.9, 0.7], "orbit": ORBIT, "provenance": {}}


def ball(degree: int = 1, level: int = 5) -> OctreeModel:
    """A shell of fine leaves around coarse ones, opaque and coloured by place and direction."""
    n = 2**level
    ijk = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    radius = np.linalg.norm((ijk + 0.5) * 2 / n - 1, axis=1)
    fine = ijk[(radius < 0.85) & (radius > 0.55)]
    coarse = np.stack(np.meshgrid(*[np.arange(n // 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    middle = coarse[np.linalg.norm((coarse + 0.5) * 8 / n - 1, axis=1) < 0.3]
    covered = {tuple(p) for p in middle}
    fine = np.array([p for p in fine if tuple(p // 4) not in covered])
    levels = np.concatenate([np.full(len(fine), level), np.full(len(middle), level - 2)])
    octree = Octree.from_leaves(levels, np.concatenate([fine, middle]), (-1, -1, -1), 2.0, degree, 60.0)
    places = octree.vertex_positions()
    rng = np.random.default_rng(0)
    octree.density = np.where(places[:, 2] > 0.4, -1.5, 1.5) + rng.normal(0, 0.3, len(places))
    sh = rng.normal(0, 0.15, (len(places), 3, (degree + 1) ** 2))
    sh[:, :, 0] = np.sin(7 * places + [0, 1, 2]) * 1.4
    octree.sh = sh
    return OctreeModel(octree, METADATA)


def cloud_of_splats(degree: int = 1, n: int = 500, mode: str = "mip") -> SplatModel:
    """Splats of all sizes and shapes in a ball."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(n, 3))
    means *= rng.uniform(0.2, 1, (n, 1)) / np.linalg.norm(means, axis=1, keepdims=True)
    scales = np.log(rng.uniform(0.02, 0.15, (n, 3)))
    sh = rng.normal(0, 0.1, (n, 3, (degree + 1) ** 2))
    sh[:, :, 0] = np.sin(4 * means) * 1.5
    splats = Splats(means, scales, rng.normal(size=(n, 4)), rng.normal(1, 2, n), sh, np.array([0.1, 0.2, -0.1]), mode)
    return SplatModel(splats, METADATA)
