"""A recovered density against the truth: exact where both are known, and off by what was planted."""

import zipfile

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.measure import truth
from nerfvol.octree.rows import explin_inverse
from nerfvol.octree.tree import Octree

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


BALL, RADIUS = 12.0, 0.4


def ball(points):
    """Extinction of a soft ball around the origin."""
    return BALL * np.maximum(0.0, 1.0 - (points**2).sum(-1) / RADIUS**2)


def ball_over_slab(slab: bool) -> Octree:
    """The ball in leaves of 1/32 of [-1, 1]^3, and under z = -0.6 an opaque slab."""
    cells = np.stack(np.meshgrid(*[np.arange(64)] * 3, indexing="ij"), -1).reshape(-1, 3)
    center = (cells + 0.5) / 32 - 1
    in_slab = center[:, 2] < -0.6
    cells = cells[(np.abs(center).max(1) < 0.5) | (in_slab & slab)]
    scale = 0.01  # explin is the identity for all but the faintest extinctions
    octree = Octree.from_leaves(np.full(len(cells), 6), cells, (-1.0,) * 3, 2.0, 0, scale)
    vertices = octree.vertex_positions()
    sigma = np.where(vertices[:, 2] < -0.55, 1000.0, np.maximum(ball(vertices), 1e-6))
    octree.density = explin_inverse(sigma / scale)
    return octree


def ball_grid(path, half=0.5, n=61) -> truth.Grid:
    axis = np.linspace(-half, half, n)
    sigma = ball(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1))
    np.savez(path, density=sigma, lo=[-half] * 3, hi=[half] * 3, voxel_size=[2 * half / (n - 1)] * 3)
    return truth.load_grid(path)


def test_what_stands_outside_the_grid_does_not_count(tmp_path):
    """A floor under the medium is held by the octree and not by the true grid: the row is that of the medium alone."""
    grid = ball_grid(tmp_path / "density.npz")
    alone, over_slab = (truth.compare(ball_over_slab(slab), grid) for slab in (False, True))
    assert over_slab == pytest.approx(alone, rel=1e-6)
    assert over_slab["opacity_relative_l1"] < 0.01 and over_slab["opacity_correlation"] > 0.9999


def test_a_leaf_on_a_face_of_the_box_counts_inside_it_alone(tmp_path):
    """A homogeneous medium in eight leaves that reach 0.2 beyond a box of no special size: cut to half a voxel."""
    octree = Octree.from_leaves([1] * 8, list(np.ndindex(2, 2, 2)), (-0.5,) * 3, 1.0, 0, 1.0)
    octree.density = explin_inverse(np.array(SIGMA))
    np.savez(
        tmp_path / "density.npz", density=np.full((41,) * 3, SIGMA), lo=[-0.3] * 3, hi=[0.3] * 3, voxel_size=[0.015] * 3
    )
    scores = truth.compare(octree, truth.load_grid(tmp_path / "density.npz"))
    assert scores["density_relative_l1"] < 1e-6
    assert scores["opacity_relative_l1"] < 0.015 / 0.3  # a voxel in all on chords of at least half the box on average


def test_an_octree_with_nothing_in_the_box_is_clear_there(tmp_path):
    octree = Octree.from_leaves([3], [[0, 0, 0]], (-1.0,) * 3, 2.0, 0, 1.0)
    octree.density = explin_inverse(np.array(SIGMA))
    scores = truth.compare(octree, ball_grid(tmp_path / "density.npz", n=21))
    assert scores["opacity_relative_l1"] == 1.0 and np.isnan(scores["opacity_correlation"])


def test_chords_begin_and_end_on_the_box():
    """Their mean length in a convex body, by Cauchy, is near 4 V / S: isotropic lines, here through the sphere around it.

    Chords between uniform points of a sphere are those lines exactly.
    """
    lo, hi = np.array([-0.8, -0.8, -1.1]), np.array([0.8, 0.8, 1.3])
    start, direction, length = truth.random_chords(lo, hi)
    for points in (start, start + length[:, None] * direction):
        assert np.abs(np.maximum(lo - points, points - hi).max(1)).max() < 1e-9
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, rtol=1e-12)
    x, y, z = hi - lo
    expected = 4 * x * y * z / (2 * (x * y + y * z + z * x))
    assert abs(length.mean() - expected) < 4 * length.std() / np.sqrt(len(length))


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


@pytest.mark.parametrize("changed", [{"hi": [-0.5] * 3}, {"lo": [np.nan] * 3}, {"hi": [1.0]}, {"voxel_size": 0.1}])
def test_what_is_no_box_is_refused(changed, tmp_path):
    box = {"lo": [-0.5] * 3, "hi": [0.5] * 3, "voxel_size": [0.25] * 3} | changed
    np.savez(tmp_path / "bad.npz", density=np.ones((4, 4, 4)), **box)
    with pytest.raises(InputError, match="expected a box with lo < hi"):
        truth.load_grid(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    "name, content", [("density", b""), ("lo", b"\x93NUMPZ rubbish"), ("voxel_size", b"0.1, 0.1, 0.1")]
)
def test_members_that_are_no_arrays_are_refused(tmp_path, name, content):
    """numpy gives the bytes of what does not begin as an array does."""
    path = tmp_path / "density.npz"
    grid = {"density": np.ones((3, 3, 3)), "lo": np.zeros(3), "hi": np.ones(3), "voxel_size": np.full(3, 1 / 3)}
    np.savez(path, **{key: value for key, value in grid.items() if key != name})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(f"{name}.npy", content)
    with pytest.raises(InputError, match=f"density.npz: expected .* but its '{name}' is no array"):
        truth.load_grid(path)
