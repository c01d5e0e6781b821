"""A recovered density against the truth: exact where both are known, and off by what was planted."""

import numpy as np
import pytest

from nerfvol import truth
from nerfvol.errors import InputError
from nerfvol.octree import Octree, explin_inverse

SIGMA = 2.0


@pytest.fixture(scope="module")
def cube() -> Octree:
    """Extinction SIGMA in [-1/2, 1/2]^3: 8^3 leaves in a root cube of side 1."""
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(512, 3), cells, (-0.5, -0.5, -0.5), 1.0, 0, 1.0)
    octree.density = explin_inverse(np.array(SIGMA))
    return octree


def written(path, sigma):
    voxel = 1.0 / sigma.shape[0]
    np.savez(path, density=sigma, lo=[-0.5] * 3, hi=[0.5] * 3, voxel_size=[voxel] * 3)
    return path


def test_equal_fields_agree(cube, tmp_path):
    """A homogeneous cube on 32^3 centred samples. The grid fades out over half a voxel at its rim, the octree ends."""
    grid = truth.load_grid(written(tmp_path / "density.npz", np.full((32, 32, 32), SIGMA)))
    scores = truth.compare(cube, grid)
    assert scores["density_relative_l1"] < 1e-6
    # Optical depths differ by at most two rims of half a voxel on paths of order 1: a few voxels' worth in all.
    assert scores["opacity_relative_l1"] < 0.05 and scores["opacity_correlation"] > 0.99


def test_a_denser_truth_shows(cube, tmp_path):
    """Twice the density: relative L1 one half, and the opacities' differ as 1 - exp(-tau) does."""
    grid = truth.load_grid(written(tmp_path / "density.npz", np.full((32, 32, 32), 2 * SIGMA)))
    scores = truth.compare(cube, grid)
    assert scores["density_relative_l1"] == pytest.approx(0.5, abs=1e-6)
    assert scores["opacity_relative_l1"] > 0.1


def test_octree_density_is_trilinear_in_the_raw_density(cube):
    octree = Octree.from_leaves([3, 3], [[3, 4, 4], [4, 4, 4]], (-0.5, -0.5, -0.5), 1.0, 0, 3.0)
    octree.density = octree.vertex_positions()[:, 0] * 8 + 4.0  # linear and above 1, where explin is the identity
    points = np.array([[-0.03, 0.05, 0.06], [0.11, 0.01, 0.12], [0.3, 0.0, 0.0]])
    np.testing.assert_allclose(truth.octree_density(octree, points), [3 * (4 - 0.24), 3 * 4.88, 0], rtol=1e-6)


@pytest.mark.parametrize("sigma", [np.full((4, 4, 4), -1.0), np.full((4, 4), 1.0), np.full((4, 4, 4), np.nan)])
def test_what_is_no_density_is_refused(sigma, tmp_path):
    with pytest.raises(InputError, match="expected a 3-D grid of finite, non-negative"):
        truth.load_grid(written(tmp_path / "bad.npz", sigma))
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(InputError, match=r"text.npz: expected the density.npz"):
        truth.load_grid(tmp_path / "text.npz")
