"""The roofline: what rays touch against brute force, costs worked out by hand, the machine's measurement."""

import numpy as np
import pytest

from nerfvol.cameras.paths import default_orbit, orbit_cameras
from nerfvol.measure import roofline
from nerfvol.measure.roofline import Machine, Work
from nerfvol.octree.tree import Octree
from tests.fixtures.tiny import make_sphere_octree


def crossings(octree: Octree, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(rays, leaves): which boxes each ray crosses, in float64."""
    low = octree.origin + octree.leaf_ijk * octree.leaf_sizes()[:, None]
    high = low + octree.leaf_sizes()[:, None]
    d = directions.astype(np.float64)[:, None]
    a, b = (low - origin) / d, (high - origin) / d
    return np.minimum(a, b).max(2).clip(0) < np.maximum(a, b).min(2)


@pytest.mark.parametrize("size", [16, 20])  # 20: tiles that reach beyond the picture
def test_what_a_view_touches_agrees_with_brute_force(size, monkeypatch):
    monkeypatch.setattr(roofline, "FRAME_TILES", 2)  # what one batch touches and the next touches again counts once
    octree = make_sphere_octree(4)
    octree.density_scale = 1e-3  # no ray ends early
    before = octree.values.copy()
    (camera,) = orbit_cameras(1, default_orbit([[-1, -1, -1], [1, 1, 1]]), (size, size))
    work = roofline.touched(octree, roofline.view_batches(camera), 0.01)
    origin, directions = camera.rays()
    crossed = crossings(octree, origin, directions)
    met = crossed.any(0)
    assert 0 < met.sum() < octree.n_leaves
    assert (work.rays, round(work.segments), work.leaves) == (size**2, crossed.sum(), met.sum())
    assert work.vertices == len(np.unique(octree.corners[met]))
    assert np.array_equal(octree.values, before)


def test_costs_by_hand():
    """10 rays, 20 segments, 3 leaves of 8 vertices; rows of one block (degree 0) and of four (degree 3)."""
    work = Work(rays=10, segments=20, leaves=3, vertices=8)
    assert roofline.frame_cost(work, 0) == roofline.Cost(8 * 64 + 3 * 32 + 10 * 24, 20 * 256)
    assert roofline.frame_cost(work, 3) == roofline.Cost(8 * 256 + 3 * 32 + 10 * 24, 20 * 1024)
    # Values and moments, each read and written; three statistics a leaf, read and written.
    assert roofline.step_cost(work, 0) == roofline.Cost(4 * 8 * 64 + 3 * 56 + 10 * 28, 20 * (256 + 272))


def test_limits():
    machine = Machine(read=800.0, copy=1696.0, operations=15360.0, threads=1)
    assert roofline.limits(roofline.Cost(848, 5120), machine) == {"bandwidth": 2.0, "arithmetic": 3.0}


def test_the_exponent_is_that_of_a_power_law():
    leaves = np.array([1e3, 2e4, 1e6])
    assert roofline.fitted_exponent(leaves, 3e-6 * leaves**0.25) == pytest.approx(0.25)
    assert roofline.fitted_exponent([5000], [1.0]) is None


def test_the_machine_is_measured():
    machine = roofline.measure_machine(1)
    assert machine.threads == 1 and machine.bandwidth == max(machine.read, machine.copy)
    assert machine.read > 1e8 and machine.operations > 1e8  # slower than any computer of this century
