"""Surfels of octrees: flat on the surface, of the right opacity whatever their size, and only of what is seen."""

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.octree.rows import explin_inverse
from nerfvol.octree.tree import Octree
from nerfvol.rotations import rotations
from nerfvol.splats.points import Y00
from nerfvol.starts.surfels import AGREEMENT, LARGEST, THICKNESS, WIDTH, surfels
from tests.fixtures.tiny import TINY_RADIUS, make_sphere_octree


def slab(sigma: float, sides: int = 16, thick: int = 1) -> Octree:
    """A plane of leaves of side 1 / sides, ``thick`` of them along x, empty on its outer face, of one colour."""
    cells = np.array([(sides // 2 + x, y, z) for x in range(thick) for y in range(sides) for z in range(sides)])
    octree = Octree.from_leaves(np.full(len(cells), 4), cells, (0, 0, 0), 1.0, 1, 10.0)
    octree.density = np.full(octree.n_vertices, explin_inverse(np.array(sigma / 10.0)))
    octree.density[octree.vertex_positions()[:, 0] > 0.5 + (thick - 0.5) / sides] -= 6
    sh = octree.sh
    sh[:, 0, 0], sh[:, 1, 2] = 0.3, -0.2
    octree.sh = sh
    return octree


def test_discs_have_the_opacity_of_the_leaves_they_stand_for():
    """A layer one leaf thick: 1 - exp(-mean sigma h) for a single leaf, and for every larger cell of the layer as well."""
    octree = slab(12.0)
    corners = octree.density_scale * np.where(octree.density[octree.corners] < 1, np.exp(octree.density[octree.corners] - 1),
                                              octree.density[octree.corners])  # fmt: skip
    expected = 1 - np.exp(-corners.mean(1)[0] / 16)
    splats = surfels(octree, np.ones(octree.n_leaves))
    assert splats.n == 256 // 4**LARGEST
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.logits)), expected, rtol=1e-4)
    scales = np.exp(splats.log_scales)
    np.testing.assert_allclose(
        scales, np.array([[WIDTH, WIDTH, THICKNESS]]) * 2**LARGEST / 16 * np.ones((splats.n, 1)), rtol=1e-5
    )
    np.testing.assert_allclose(np.abs(rotations(splats.quats)[:, :, 2]), np.tile([1.0, 0, 0], (splats.n, 1)), atol=1e-6)
    np.testing.assert_allclose(splats.sh[:, 0, 0], 0.3, rtol=1e-5)
    np.testing.assert_allclose(splats.sh[:, 1, 2], -0.2, rtol=1e-5)


def test_colours_that_differ_stay_apart():
    octree = slab(12.0)
    sh = octree.sh
    sh[:, 2, 0] = np.where(octree.vertex_positions()[:, 1] < 0.5, 0.5, -0.5) / Y00 * 0.5
    octree.sh = sh
    splats = surfels(octree, np.ones(octree.n_leaves))
    assert 4 < splats.n < 256 and len(np.unique(splats.log_scales[:, 0].round(4))) > 1
    np.testing.assert_allclose(splats.logits, splats.logits[0], rtol=1e-4)  # discs of every size are as opaque
    few = surfels(octree, np.ones(octree.n_leaves), most=10)
    assert few.n <= 10


def test_discs_lie_flat_on_a_sphere():
    octree = make_sphere_octree(5)
    centers, side = octree.leaf_centers(), float(octree.leaf_sizes()[0])
    beyond = np.linalg.norm(centers, axis=1) - TINY_RADIUS
    seen = (beyond > -side / 2) & (beyond < side)
    splats = surfels(octree, seen.astype(float))
    positions = splats.means + splats.origin
    radius = np.linalg.norm(positions, axis=1)
    largest = np.exp(splats.log_scales[:, 0]) / WIDTH
    # A disc's middle is the mean of points on the sphere within its cell: nearer to the centre by their sagitta at most.
    assert (np.abs(radius - TINY_RADIUS) < 1.5 * side + 3 * largest**2 / (8 * TINY_RADIUS)).all()
    normals = rotations(splats.quats)[:, :, 2]
    assert (np.abs((normals * positions).sum(1)) / radius > AGREEMENT).mean() > 0.99
    assert splats.n < seen.sum()


def test_only_what_is_seen_becomes_a_disc():
    octree = slab(12.0, thick=3)
    weights = (octree.leaf_ijk[:, 0] == 8).astype(float)
    splats = surfels(octree, weights)
    assert (splats.means + splats.origin)[:, 0].max() < 0.5 + 1 / 16
    with pytest.raises(InputError, match="no ray sees any"):
        surfels(octree, 0 * weights)
