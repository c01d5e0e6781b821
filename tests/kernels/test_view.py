"""Pictures go by squares of 16x16 pixels, rays by tiles of 64: a pixel does not depend on who came along."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Intrinsics, look_at
from nerfvol.kernels import ops
from nerfvol.kernels.state import from_squares, in_squares
from nerfvol.octree.tree import Octree
from nerfvol.sh import eval_basis
from tests.fixtures.random_octrees import DYADIC, ODD, random_octree


def view_of(octree, rng, width, height, focal, away):
    """A view along an axis of the octree from ``away`` times its size, and the same rays one by one.

    Axes are only exchanged, which is exact: both have the same directions to the last bit.
    """
    axes = rng.permutation(3)
    rotation = np.zeros((3, 3))
    rotation[axes, range(3)] = rng.choice([-1.0, 1.0], 3)
    center = octree.origin + octree.size * rng.uniform(0.3, 0.7, 3)
    c2w = np.column_stack([rotation, center + away * octree.size * rotation[:, 2]])  # a camera looks along its -z
    lens = Intrinsics(width, height, focal, focal, 0.47 * width, 0.52 * height)
    directions = lens.directions()
    turned = directions.reshape(-1, 3) @ rotation.T.astype(np.float32)
    view = ops.View(in_squares(directions), c2w, height, width)
    return view, np.broadcast_to(c2w[:, 3].astype(np.float32), turned.shape).copy(), turned


def test_squares_hold_each_pixel_where_the_kernels_look_for_it():
    """Strips of four rows; in a strip patches of 2x2 pixels, row by row; in a patch two above two."""
    rows, columns = np.meshgrid(np.arange(37), np.arange(21), indexing="ij")
    squares = in_squares(np.stack([rows, columns], -1))
    assert squares.shape == (3, 2, 4, 2, 64)
    for at, place in [((0, 0, 0, 1), (0, 1)), ((0, 0, 0, 2), (1, 0)), ((0, 0, 0, 4), (0, 2)), ((0, 0, 0, 32), (2, 0)),
                      ((1, 0, 3, 63), (31, 15)), ((2, 1, 1, 0), (36, 16))]:  # fmt: skip
        assert tuple(squares[(*at[:3], slice(None), at[3])]) == place
    assert np.array_equal(from_squares(squares, 37, 21), np.stack([rows, columns], -1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("kind", ["mixed", "full", "single", "sparse"])
def test_views_agree_with_rays(isa, kind, degree):
    """Far and near, from inside, through wide lenses, with patches narrower and wider than leaves; every output."""
    rng = np.random.default_rng(degree)
    for frame in (DYADIC, ODD):
        octree = random_octree(kind, degree, rng, frame)
        for away, focal in [(2.0, 300.0), (2.0, 60.0), (0.9, 30.0), (0.2, 12.0), (30.0, 300.0)]:
            view, o, d = view_of(octree, rng, 45, 35, focal, away)
            for eps in (0.0, 0.3):
                picture = ops.render_view(octree, view, (0.1, 0.5, 0.9), eps)
                rays = ops.render_rays(octree, o, d, (0.1, 0.5, 0.9), eps)
                for name, value in picture.items():
                    # The same operations, contracted to fused ones as each function's compilation has it: some 60 of
                    # them on numbers up to 60 (distances) and up to 3 (all else).
                    unit = 60 if "depth" in name else 3
                    want = rays[name].reshape(value.shape)
                    np.testing.assert_allclose(value, want, rtol=0, atol=60 * unit * 2**-24, err_msg=name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_small_cell_is_shaded_along_the_ray_to_its_middle(isa, degree):
    """A colour moves by what the harmonics do over sqrt(3)/2 of 1/64, the most between a
    ray and the one to the middle of a cell 64 sides away. The squares of the slopes of all harmonics of degree l add up to
    (2 l + 1) l (l + 1) / (4 pi) [addition theorem]. Cells that are nearer stay as they are, bit by bit."""
    rng = np.random.default_rng(degree)
    octree = random_octree("full", degree, rng)
    slope = np.concatenate(
        [np.full(2 * k + 1, np.sqrt((2 * k + 1) * k * (k + 1) / (4 * np.pi))) for k in range(degree + 1)]
    )
    bound = np.sqrt(3) / 2 / 64 * (np.abs(octree.sh) @ slope).max()
    for away, is_small in ((200.0, True), (0.9, False)):
        view, _, _ = view_of(octree, rng, 45, 35, 40.0 * away, away)
        exact, quick = (ops.render_view(octree, view, (0.1, 0.5, 0.9), 0.0, small=small) for small in (0.0, 1 / 64))
        moved = np.abs(quick["rgb"] - exact["rgb"])
        if not is_small:
            assert not moved.any()
            continue
        rounding = 60 * 3 * 2**-24
        assert moved.max() <= bound + rounding and (moved.max() > rounding) == (degree > 0)
        for name in ("opacity", "normal"):
            np.testing.assert_allclose(quick[name], exact[name], rtol=0, atol=rounding, err_msg=name)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_small_cell_has_the_colour_of_the_direction_to_its_middle(isa, degree):
    """One opaque cell, 70 sides away: all of it has one colour, that of the harmonics in float64; shaded ray by ray it has not.
    One of 60 sides away is not small."""
    rng = np.random.default_rng(degree)
    octree = Octree.from_leaves([6], [(41, 20, 33)], (-1.0, -1.0, -1.0), 2.0, degree, 100.0)
    octree.density = 50.0  # optical thickness 156 along a side
    octree.sh = np.broadcast_to(rng.normal(0, 0.3, (1, *octree.sh.shape[1:])), octree.sh.shape)
    middle, side = octree.leaf_centers()[0], octree.leaf_sizes()[0]
    for away in (70, 60):
        towards = np.array([0.48, -0.6, 0.64])
        pose = look_at(middle - away * side * towards, middle, (0.0, 0.0, 1.0))
        lens = Intrinsics(45, 35, 20.0 * away, 20.0 * away, 22.5, 17.5)
        view = ops.View(in_squares(lens.directions()), pose, 35, 45)
        exact, quick = (ops.render_view(octree, view, (0.1, 0.5, 0.9), 0.0, small=small) for small in (0.0, 1 / 64))
        solid = quick["opacity"] > 1 - 1e-6
        assert solid.sum() > 200
        want = 0.5 + octree.sh[0].astype(float) @ eval_basis(degree, towards)
        # 60 operations on numbers up to 3, as above, and the background through 1e-6; the harmonics move by more than 1e-3.
        tolerance = 60 * 3 * 2**-24 + 1e-6
        assert (np.abs(exact["rgb"] - want)[solid].max() > 1e-3) and (
            (np.abs(quick["rgb"] - want)[solid].max() < tolerance) == (away > 64)
        )


@pytest.mark.parametrize("degree", [0, 3])
def test_a_ray_that_ends_ends_no_other(isa, degree):
    """Two cells of nine of a board stand before a haze: pixels that see the haze share patches with pixels that end."""
    cells = [(x, y, z) for x in range(64) for y in range(64) for z in (10, 40) if z == 10 or (x * y) % 3 == 1]
    octree = Octree.from_leaves(np.full(len(cells), 6), np.array(cells), (-1.0, -1.0, -1.0), 2.0, degree, 100.0)
    board = octree.vertex_positions()[:, 2] > 0
    octree.density = np.where(board, 50.0, 0.2)
    lens = Intrinsics(64, 64, 90.0, 90.0, 32, 32)
    c2w = np.column_stack([np.eye(3), [0.0, 0.0, 3.0]])
    d = lens.directions()
    seen = ops.render_view(octree, ops.View(in_squares(d), c2w, 64, 64), (1, 1, 1), 1e-2, ("opacity",))["opacity"]
    o = np.broadcast_to(np.float32([0, 0, 3]), (64 * 64, 3)).copy()
    want = ops.render_rays(octree, o, d.reshape(-1, 3), (1, 1, 1), 1e-2, ("opacity",))["opacity"].reshape(64, 64)
    np.testing.assert_allclose(seen, want, rtol=0, atol=60 * 2**-24)
    assert 0.1 < (seen > 0.99).mean() and 0.1 < ((seen > 0.1) & (seen < 0.9)).mean()
