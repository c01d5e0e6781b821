"""Cameras among the leaves: the walk meets all that their rays meet, and little else."""

import numpy as np
import pytest

from nerfvol.kernels import ops
from nerfvol.octree.tree import Octree
from tests.fixtures.random_octrees import random_octree, unit

LEVEL = 5


def filled_cube() -> Octree:
    """Thin matter everywhere in the unit cube, in 32^3 leaves."""
    cells = np.stack(np.meshgrid(*[np.arange(1 << LEVEL)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return Octree.from_leaves(np.full(len(cells), LEVEL), cells, (0.0, 0.0, 0.0), 1.0, 0, 1.0)


def places(rng: np.random.Generator, n: int) -> np.ndarray:
    """n origins in the unit cube: a third anywhere, a third in a plane of faces, a third where three planes meet; (n, 3)."""
    o = rng.uniform(0.2, 0.8, (n, 3))
    on_lattice = np.round(o * (1 << LEVEL)) / (1 << LEVEL)
    o[::3, 0], o[1::3] = on_lattice[::3, 0], on_lattice[1::3]
    return o.astype(np.float32)


def tile_ahead(rng: np.random.Generator, step: float) -> np.ndarray:
    """Directions of an 8x8 tile that looks anywhere, ``step`` between neighbours: (64, 3) float32."""
    forward = unit(rng.standard_normal(3))
    side = unit(np.cross(forward, rng.standard_normal(3)))
    u, v = np.meshgrid(*[(np.arange(8) - 3.5) * step] * 2)
    return unit(forward + u[..., None] * side + v[..., None] * np.cross(side, forward)).reshape(64, 3)


def test_leaves_beside_a_camera_are_not_tested(isa):
    """A pyramid that is narrower than a leaf: what is tested is what the box around a leaf's outline in the picture lets
    through. That box is at most three times as large as the outline of a cube (its side sqrt(3), the outline at least 1), and
    perspective and the walk's margin enlarge it where leaves are near: four times. The plane of leaves through the
    camera, which lies in no picture, has 32^2."""
    octree, rng = filled_cube(), np.random.default_rng(0)
    tested, met = 0.0, 0
    for origin in places(rng, 30):
        statistics = ops.LeafStatistics(octree)
        directions = tile_ahead(rng, 0.001)
        batch = ops.Batch(origin[None], directions, np.zeros((64, 3), np.float32), np.ones(64, np.float32))
        report = ops.leaf_statistics(octree, batch, ops.LossOptions(early_stop_eps=0.0), 0.001, statistics)
        seen = int((statistics.footprint > 0).sum())
        assert report.tested >= seen > 0
        tested, met = tested + report.tested, met + seen
    assert tested <= 4 * met


@pytest.mark.parametrize("step", [0.002, 0.05, 0.4])
def test_a_tile_from_among_the_leaves_is_its_rays_one_by_one(isa, step):
    rng = np.random.default_rng(1)
    octree = random_octree("mixed", 1, rng)
    for place in places(rng, 6):
        origin = (octree.origin + octree.size * place).astype(np.float32)
        directions = tile_ahead(rng, step)
        together = ops.render_rays(octree, origin[None], directions, early_stop_eps=0.0)
        for i in range(0, 64, 3):
            alone = ops.render_rays(octree, origin[None], directions[i : i + 1], early_stop_eps=0.0)
            for name, rows in alone.items():
                assert np.array_equal(rows[0], together[name][i]), (name, i)
