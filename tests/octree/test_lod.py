"""Level of detail: prefiltered nodes, and pictures drawn with them in place of their leaves."""

import math

import numpy as np
import pytest

from nerfvol import native
from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.kernels.state import OUTPUTS
from nerfvol.octree import lod
from nerfvol.octree.io import load_octree, save_octree
from nerfvol.octree.rows import DENSITY_SLOT, explin, explin_inverse
from nerfvol.octree.topology import OFFSETS, level_starts, place_nodes
from nerfvol.octree.tree import Octree
from nerfvol.views import render_image
from tests.fixtures.random_octrees import camera_tiles, random_octree


def cube(level: int, scale: float = 1.0, degree: int = 1) -> Octree:
    """Every cell of ``level`` in [-1, 1]^3."""
    ijk = np.argwhere(np.ones([2**level] * 3))
    return Octree.from_leaves(np.full(len(ijk), level), ijk, (-1, -1, -1), 2.0, degree, scale)


def camera_at(position, size: int, target=(0.0, 0.0, 0.0), focal: float = 1.0) -> Camera:
    """Looks at ``target``; focal length ``focal`` x the picture's width."""
    lens = Intrinsics(size, size, focal * size, focal * size, size / 2, size / 2)
    return Camera(lens, look_at(np.asarray(position, float), np.asarray(target, float), (0.0, 0.0, 1.0)))


def sides_and_centres(octree: Octree) -> tuple[np.ndarray, np.ndarray]:
    """Of the nodes: (n_nodes,), (n_nodes, 3)."""
    starts = level_starts(octree.node_mask)
    side = octree.size / 2.0 ** np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return side, octree.origin + (place_nodes(octree.node_mask, starts) + 0.5) * side[:, None]


# ------------------------------------------------------------------ prefiltered nodes
@pytest.mark.parametrize("pixels", [0.0, 0.5, 2.0, 1e6])
def test_a_constant_cube_is_exp_minus_sigma_l_at_any_level_of_detail(pixels):
    octree = cube(4)
    octree.density, octree.sh = 0.4, np.array([0.5, -0.2, 0.1])[:, None] * (np.arange(4) == 0)
    camera = camera_at((2.9, 1.7, 1.1), 24)
    image = render_image(octree, camera, (0, 0, 0), 0.0, lod=pixels)
    origin, d = (a.astype(np.float64) for a in camera.rays())
    a, b = (-1 - origin) / d, (1 - origin) / d
    length = np.maximum(np.minimum(np.maximum(a, b).min(1), 1e9) - np.minimum(a, b).max(1), 0)
    opacity = 1 - np.exp(-float(explin(np.float32(0.4))) * length).reshape(24, 24)
    colour = 0.5 + 0.28209479177387814 * np.array([0.5, -0.2, 0.1])
    # Up to 40 segments: each moves an optical depth by some roundings of float32, an average by some more.
    np.testing.assert_allclose(image["opacity"], opacity, rtol=0, atol=2e-5)
    np.testing.assert_allclose(image["rgb"], opacity[..., None] * colour, rtol=0, atol=2e-5)


def test_inner_corners_of_nodes_carry_a_linear_field():
    """Thin: opacity is optical depth to 1e-4, and the weights are symmetric around a corner with all its nodes."""
    octree = cube(4, scale=1e-5)
    slope = np.array([1.0, -0.5, 0.25])
    octree.density = explin_inverse(4 + octree.vertex_positions() @ slope)
    octree.sh = (octree.vertex_positions() @ slope)[:, None, None] * np.ones((1, 3, 4))
    prefiltered = lod.prefiltered_nodes(octree)
    side, centre = sides_and_centres(octree)
    place = centre[:, None] + (OFFSETS - 0.5) * side[:, None, None]
    inner = (np.abs(place) < 0.99).all(-1)
    assert len(np.unique(np.repeat(side[:, None], 8, 1)[inner])) == 3  # levels 1 to 3
    sigma = explin(prefiltered.values[prefiltered.corners][..., DENSITY_SLOT])
    np.testing.assert_allclose(sigma[inner], (4 + place @ slope)[inner], rtol=1e-4)


def test_colour_is_weighted_by_opacity():
    """Opaque red below, clear green above: the root, over both, is red and never grey."""
    octree = cube(2, scale=100.0, degree=0)
    low = octree.vertex_positions()[:, 2] < 0
    octree.density = np.where(low, 3.0, -20.0)
    octree.sh = np.where(low[:, None], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0])[:, :, None]
    prefiltered = lod.prefiltered_nodes(octree)
    red = prefiltered.values[prefiltered.corners[0]][:, [0, 4, 8]]
    np.testing.assert_allclose(red, np.broadcast_to([1, -1, -1], red.shape), atol=1e-4)


def test_prefiltered_nodes_conserve_thin_matter():
    """Parallel rays on a symmetric grid see the mean optical depth, whatever the cells; second order in the depth."""
    octree = cube(3, scale=2e-3, degree=0)
    octree.density = np.random.default_rng(0).uniform(1, 3, octree.n_vertices)
    grid = (np.arange(64) + 0.5) / 32 - 1
    y, z = (g.ravel() for g in np.meshgrid(grid, grid))
    o = np.stack([np.full(4096, -50.0), y, z], 1).astype(np.float32)
    d = np.broadcast_to(np.float32([1, 0, 0]), o.shape).copy()
    depth = [
        -np.log1p(-ops.render_rays(octree, o, d, early_stop_eps=0.0, outputs=("opacity",), coarse=c)["opacity"]).mean()
        for c in (0.0, 0.011, 0.021, 1.0)  # nodes of level 2, 1, 1
    ]
    assert lod.lod_cut(octree, (-50, 0, 0), 0.011).sum() == 64
    assert not lod.lod_cut(octree, (-50, 0, 0), 1.0)[0]  # the root is always opened
    deepest = 3 * 2e-3 * 2
    np.testing.assert_allclose(depth, depth[0], rtol=deepest)
    assert depth[1] != depth[0]


def test_walls_stay_opaque_and_edges_where_they_are():
    """A wall one leaf thick over half of the cube, seen square on, in cells twice and four times the leaf's side."""
    octree = cube(5, scale=400.0, degree=0)
    wall = (octree.leaf_ijk[:, 0] == 15) & (octree.leaf_ijk[:, 1] < 16)
    octree, _ = octree.prune(wall)
    octree.density = 1.0  # an optical depth of 25
    y, z = (g.ravel() for g in np.meshgrid((np.arange(128) + 0.5) / 64 - 1, (np.arange(8) + 0.5) / 10))
    o = np.stack([np.full(y.shape, -100.0), y, z], 1).astype(np.float32)
    d = np.broadcast_to(np.float32([1, 0, 0]), o.shape).copy()
    for cells in (1, 2):
        side = 2 / 32 * 2**cells
        coarse = 1.02 * side / 100
        assert lod.lod_cut(octree, (-100, -0.5, 0), coarse).any()
        opacity = ops.render_rays(octree, o, d, early_stop_eps=0.0, outputs=("opacity",), coarse=coarse)["opacity"]
        # By the module's head: tau = 13.8 from one axis of three, the wall in one of two layers at its corners; means of
        # transmittance over points would give less than 0.9 and 0.65.
        assert opacity[y < 0].min() > (0.98, 0.88)[cells - 1]
        assert (opacity[y > 0] == 0).all()


def test_prefiltered_nodes_are_the_same_without_compiled_kernels(monkeypatch):
    octree = random_octree("mixed", 2, np.random.default_rng(4))
    if native.native() is None:
        pytest.skip("no compiled kernels")
    compiled = lod.prefiltered_nodes(octree)
    octree.prefiltered = None
    monkeypatch.setattr(lod, "native", lambda: None)
    plain = lod.prefiltered_nodes(octree)
    assert np.array_equal(plain.corners, compiled.corners)
    np.testing.assert_allclose(plain.values, compiled.values, rtol=0, atol=1e-5)  # sums of some 64 numbers of order 1


def test_prefiltered_nodes_are_kept_until_the_values_change():
    octree = random_octree("mixed", 1, np.random.default_rng(5))
    first = lod.prefiltered_nodes(octree)
    assert lod.prefiltered_nodes(octree) is first
    assert octree.subdivide(np.zeros(octree.n_leaves, bool))[0].prefiltered is None
    assert octree.prune(np.ones(octree.n_leaves, bool))[0].prefiltered is None
    assert octree.with_sh_degree(2).prefiltered is None
    for change in (
        lambda: setattr(octree, "values", octree.values),
        lambda: setattr(octree, "density", octree.density + 1),
        lambda: setattr(octree, "sh", octree.sh + 1),
        lambda: train_once(octree),
    ):
        lod.prefiltered_nodes(octree)
        change()
        assert octree.prefiltered is None


def train_once(octree: Octree) -> None:
    o, d = camera_tiles(octree, np.random.default_rng(0), 1)
    batch = ops.Batch(o, d, np.zeros((64, 3), np.float32), np.ones(64, np.float32))
    ops.train_step(octree, ops.TrainState(octree), batch, ops.LossOptions(), ops.Rates(0.1, 0.1, 0.1), 0.01)


# ------------------------------------------------------------------ pictures
@pytest.mark.parametrize("kind", ["mixed", "full", "sparse", "single"])
@pytest.mark.parametrize("coarse", [0.05, 0.15, 0.6])
def test_the_walk_draws_the_cut_octree(kind, coarse):
    """Bit by bit: a node that is not opened is a leaf. Some of the origins are inside the octree."""
    rng = np.random.default_rng(6)
    octree = random_octree(kind, 1, rng)
    origins, d = camera_tiles(octree, rng, 8)
    stood_in = 0
    for tile, origin in enumerate(origins):
        rays = origin[None], d[64 * tile : 64 * tile + 64]
        nodes = lod.lod_cut(octree, origin, coarse)
        stood_in += nodes.sum()
        image, expected = ops.render_rays(octree, *rays, coarse=coarse), ops.render_rays(lod.cut(octree, nodes), *rays)
        for name in OUTPUTS:
            assert np.array_equal(image[name], expected[name]), name
    assert stood_in > 0 or kind in ("single", "sparse") or coarse < 0.5


def test_the_reference_draws_the_same(monkeypatch):
    rng = np.random.default_rng(7)
    octree = random_octree("mixed", 2, rng)
    o, d = camera_tiles(octree, rng, 4)
    compiled = ops.render_rays(octree, o, d, early_stop_eps=0.0, coarse=0.15)
    assert not np.array_equal(compiled["rgb"], ops.render_rays(octree, o, d, early_stop_eps=0.0)["rgb"])
    monkeypatch.setattr(ops, "native", lambda: None)
    plain = ops.render_rays(octree, o, d, early_stop_eps=0.0, coarse=0.15)
    for name in OUTPUTS:  # sums over at most some 20 cells of values of order 3, places in small cells off by 1e-5
        np.testing.assert_allclose(compiled[name], plain[name], rtol=0, atol=2e-4, err_msg=name)


def test_any_number_of_threads_gives_the_same_bits():
    if native.native() is None:
        pytest.skip("no compiled kernels")
    octree = random_octree("mixed", 1, np.random.default_rng(8))
    camera, before = camera_at((2.5, 1.0, 0.7), 50), ops.get_threads()
    images, prefiltered = [], []
    for n in (1, 2, 3):
        ops.set_threads(n)
        octree.prefiltered = None
        images.append(render_image(octree, camera, lod=4.0)["rgb"])
        prefiltered.append(octree.prefiltered.values)
    ops.set_threads(before)
    for k in (1, 2):
        assert np.array_equal(images[0], images[k]) and np.array_equal(prefiltered[0], prefiltered[k])


def test_without_small_nodes_every_bit_is_that_of_the_leaves(sphere_octree):
    camera = camera_at((3.0, 0.4, 0.6), 32, focal=1.4)
    side, centre = sides_and_centres(sphere_octree)
    smallest = (side / np.linalg.norm(centre - camera.position, axis=1))[1:].min() * camera.intrinsics.fx
    exact = render_image(sphere_octree, camera, lod=0.0)
    assert lod.has_lod_cut(sphere_octree, camera.position, 0.999 * smallest / camera.intrinsics.fx)
    below, above = (render_image(sphere_octree, camera, lod=factor * smallest) for factor in (0.999, 1.2))
    for name in OUTPUTS:
        assert np.array_equal(below[name], exact[name]), name
    assert not np.array_equal(above["rgb"], exact["rgb"])


def test_a_small_picture_is_nearer_to_the_average_of_a_large_one():
    """A speckled opaque block, pixels of some 5x5 leaves: a ray through a leaf sees one speckle, a node their mean."""
    octree = cube(5, scale=100.0, degree=0)
    octree, _ = octree.prune(octree.leaf_ijk[:, 0] > 24)
    octree.density, octree.sh = 2.0, np.random.default_rng(1).uniform(-1.5, 1.5, (octree.n_vertices, 3, 1))
    small, large = (camera_at((9.0, 0.4, 0.6), size, focal=4.0) for size in (8, 128))
    truth = render_image(octree, large, lod=0.0)["rgb"].reshape(8, 16, 8, 16, 3).mean((1, 3))
    errors = [np.sqrt(((render_image(octree, small, lod=pixels)["rgb"] - truth) ** 2).mean()) for pixels in (0.0, 1.0)]
    assert errors[1] < 0.6 * errors[0], errors


def test_normals_of_coarse_cells_point_as_those_of_leaves(sphere_octree):
    camera = camera_at((3.0, 0.4, 0.6), 24, focal=1.4)
    exact, coarse = (render_image(sphere_octree, camera, early_stop_eps=0.0, lod=pixels) for pixels in (0.0, 2.0))
    solid = (exact["opacity"] > 0.99) & (coarse["opacity"] > 0.9)
    cosine = (exact["normal"] * coarse["normal"]).sum(-1) / np.maximum(
        np.linalg.norm(exact["normal"], axis=-1) * np.linalg.norm(coarse["normal"], axis=-1), 1e-9
    )
    assert solid.sum() > 50 and np.median(cosine[solid]) > 0.95
    near = np.abs(exact["median_depth"] - coarse["median_depth"])[solid]
    assert np.median(near) < 2 * sphere_octree.size / 2.0**sphere_octree.max_level


# ------------------------------------------------------------------ cuts and arguments
def test_an_octree_cut_off_at_a_level_covers_the_same_leaves():
    octree = random_octree("mixed", 1, np.random.default_rng(9))
    coarse = lod.at_level(octree, 3)
    coarse.validate()
    assert coarse.max_level == 3 and coarse.n_leaves < octree.n_leaves
    found = coarse.query(octree.leaf_centers())
    assert (found >= 0).all()  # nothing lost
    assert (np.bincount(found, minlength=coarse.n_leaves) > 0).all()  # nothing added
    same = lod.at_level(octree, 9)
    assert np.array_equal(same.leaf_ijk, octree.leaf_ijk) and np.array_equal(same.values, octree.values)


# ------------------------------------------------------------------ octrees that are simplified
@pytest.mark.parametrize("level", [2, 3, 4])
def test_a_simplified_octree_saves_and_loads(level, tmp_path):
    octree = random_octree("mixed", 2, np.random.default_rng(11))
    apart, simple = lod.at_level(octree, level), lod.simplified(octree, level)
    simple.validate()
    assert simple.max_level == level and np.array_equal(simple.leaf_ijk, apart.leaf_ijk)
    assert simple.n_vertices < apart.n_vertices
    with pytest.raises(InputError, match="do not share their vertices"):
        save_octree(tmp_path / "apart.safetensors", apart, {})
    assert not list(tmp_path.iterdir())
    save_octree(tmp_path / "simple.safetensors", simple, {})
    loaded, _ = load_octree(tmp_path / "simple.safetensors")
    assert np.array_equal(loaded.density, simple.density) and np.array_equal(loaded.sh, simple.sh)


def test_what_needs_no_mean_keeps_its_bits():
    octree = random_octree("mixed", 1, np.random.default_rng(12))
    same = lod.simplified(octree, octree.max_level)
    assert np.array_equal(same.corners, octree.corners) and np.array_equal(same.values, octree.values)
    assert lod.simplified(octree, 9).n_leaves == octree.n_leaves
    with pytest.raises(InputError, match="level 1 or finer"):
        lod.simplified(octree, 0)


def test_a_constant_field_stays_when_simplified():
    """Leaves of two levels that fill the cube; some touch nodes that become leaves."""
    octree, _ = cube(3, scale=2.0).subdivide(np.random.default_rng(13).random(8**3) < 0.4)
    octree.density, octree.sh = 0.4, np.array([0.5, -0.2, 0.1])[:, None] * [1, 0.3, -0.2, 0.1]
    for level in (1, 2, 3):
        simple = lod.simplified(octree, level)
        np.testing.assert_allclose(simple.density, 0.4, atol=1e-5)
        np.testing.assert_allclose(simple.sh, np.broadcast_to(octree.sh[:1], simple.sh.shape), atol=1e-6)


def test_vertices_between_cells_have_the_mean_by_opacity():
    """A leaf of level 1 next to a node that becomes one: on their common face each counts once."""
    octree = Octree.from_leaves([1] + [2] * 8, [[0, 0, 0], *(OFFSETS + [2, 0, 0])], (-1, -1, -1), 2.0, 0, 1.5)
    octree.density = np.where(octree.vertex_positions()[:, 0] < 0.25, 0.8, 2.5)
    octree.sh = np.where(octree.vertex_positions()[:, 0] < 0.25, -1.0, 1.0)[:, None, None] * np.ones((1, 3, 1))
    apart, simple = lod.at_level(octree, 1), lod.simplified(octree, 1)
    assert (apart.n_vertices, simple.n_vertices) == (16, 12)
    left, right = (apart.values[apart.corners[i]].astype(float) for i in (0, 1))
    for corner in range(4):  # of the right cell, its corners of x = 0; the left cell's are numbers 4 to 7
        rows = np.stack([left[4 + corner], right[corner]])
        opacity = 1 - np.exp(-1.5 * explin(rows[:, 12]))
        found = simple.values[simple.corners[1, corner]].astype(float)
        assert 1 - np.exp(-1.5 * explin(found[12])) == pytest.approx(opacity.mean(), rel=1e-5)
        assert found[0] == pytest.approx(opacity @ rows[:, 0] / opacity.sum(), abs=1e-5)


def test_a_simplified_picture_is_near_that_of_the_cells_apart(sphere_octree):
    camera = camera_at((3.0, 0.4, 0.6), 48, focal=1.4)
    level = sphere_octree.max_level - 1
    images = [
        render_image(tree, camera, early_stop_eps=0.0, lod=0.0)["rgb"]
        for tree in (sphere_octree, lod.at_level(sphere_octree, level), lod.simplified(sphere_octree, level))
    ]
    apart, simple = (np.sqrt(((image - images[0]) ** 2).mean()) for image in images[1:])
    between = np.sqrt(((images[2] - images[1]) ** 2).mean())
    assert between < 0.5 * apart and simple < 1.2 * apart, (between, apart, simple)


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_bad_levels_of_detail_are_refused(bad, sphere_octree):
    with pytest.raises(ValueError, match="lod must be"):
        render_image(sphere_octree, camera_at((3, 0, 0), 8), lod=bad)
    o, d = camera_tiles(sphere_octree, np.random.default_rng(0), 1)
    with pytest.raises(ValueError, match="coarse must be"):
        ops.render_rays(sphere_octree, o, d, coarse=bad)


@pytest.mark.parametrize("bad", ["-1", "nan", "inf", "two"])
def test_the_command_line_refuses_them_too(bad, command, tmp_path):
    code, _, error = command("render", tmp_path, "--orbit", 1, "--out", tmp_path, "--lod", bad)
    assert code == 2 and "lod" in error
