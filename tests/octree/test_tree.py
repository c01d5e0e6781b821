"""The octree: what building, pruning, subdividing and querying must keep, on leaf sets that hypothesis invents."""

import numpy as np
import pytest
from hypothesis import strategies as st

import nerfvol.octree.topology as module
from nerfvol.native import native
from nerfvol.octree.rows import BLOCKS, DENSITY_SLOT, EMPTY_DENSITY, explin, explin_inverse, sh_slots
from nerfvol.octree.topology import MAX_LEVEL, OFFSETS, demorton, morton
from nerfvol.octree.tree import Octree
from tests.fixtures.octrees import ORIGIN, SIZE, given, indices, leaf_sets, octrees

UNIT_ROUNDOFF = 2.0**-24  # float32


def masks_for(octree: Octree, seed: int) -> np.ndarray:
    mask = np.random.default_rng(seed).random(octree.n_leaves) < 0.5
    mask[seed % octree.n_leaves] = True
    return mask


def lower_corners(octree: Octree) -> np.ndarray:
    return np.array(ORIGIN) + octree.leaf_ijk * octree.leaf_sizes()[:, None]


def field(octree: Octree, leaf: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The rows at points (n, 3) inside the leaves (n,): the definition, in float64."""
    place = (points - lower_corners(octree)[leaf]) / octree.leaf_sizes()[leaf, None]
    weights = np.where(OFFSETS == 1, place[:, None], 1 - place[:, None]).prod(-1)
    return (weights[:, :, None] * octree.values[octree.corners[leaf]].astype(np.float64)).sum(1)


def same_octree(a: Octree, b: Octree) -> None:
    for name in ("node_mask", "leaf_mask", "first_node", "first_leaf", "leaf_level", "leaf_ijk", "corners", "values"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert np.array_equal(a.vertex_positions(), b.vertex_positions())


# ------------------------------------------------------------------ building
@given(leaf_sets(), st.integers(0, 3))
def test_from_leaves_holds_just_these_leaves_breadth_first(leaves, degree):
    level, ijk = leaves
    octree = Octree.from_leaves(level, ijk, ORIGIN, SIZE, degree, 3.0)
    octree.validate()
    order = np.lexsort((morton(ijk), level))
    assert np.array_equal(octree.leaf_level, level[order])
    assert np.array_equal(octree.leaf_ijk, ijk[order])
    assert np.array_equal(octree.leaf_sizes(), SIZE / 2.0 ** level[order])
    assert np.array_equal(octree.leaf_centers(), lower_corners(octree) + octree.leaf_sizes()[:, None] / 2)
    assert octree.values.shape == (octree.n_vertices, 16 * BLOCKS[degree]) and octree.values.dtype == np.float32
    assert (octree.density == EMPTY_DENSITY).all() and not octree.sh.any()


@given(leaf_sets())
def test_vertices_are_the_distinct_corners_in_the_order_leaves_name_them(leaves):
    octree = Octree.from_leaves(*leaves, ORIGIN, SIZE)
    positions = octree.vertex_positions()
    expected = lower_corners(octree)[:, None] + OFFSETS * octree.leaf_sizes()[:, None, None]
    assert np.array_equal(positions[octree.corners], expected)
    assert len(np.unique(positions, axis=0)) == octree.n_vertices
    _, first = np.unique(octree.corners.ravel(), return_index=True)
    assert (np.diff(first) > 0).all() and len(first) == octree.n_vertices


@given(leaf_sets(), indices)
def test_from_leaves_does_not_depend_on_the_order_of_the_leaves(leaves, seed):
    level, ijk = leaves
    shuffled = np.random.default_rng(seed).permutation(len(level))
    a = Octree.from_leaves(level, ijk, ORIGIN, SIZE)
    same_octree(a, Octree.from_leaves(level[shuffled], ijk[shuffled], ORIGIN, SIZE))


@given(leaf_sets())
def test_masks_alone_rebuild_the_octree(leaves):
    a = Octree.from_leaves(*leaves, ORIGIN, SIZE, 2, 3.0)
    same_octree(a, Octree(a.node_mask, a.leaf_mask, origin=ORIGIN, size=SIZE, sh_degree=2, density_scale=3.0))


def test_the_deepest_level_is_exact():
    last = (1 << MAX_LEVEL) - 1
    ijk = np.array([[last] * 3, [0, last, 0], [last - 1, last, last]])
    octree = Octree.from_leaves([MAX_LEVEL] * 3, ijk, (0, 0, 0), 1.0)
    octree.validate()
    assert octree.n_vertices == 8 + 8 + 4
    assert np.array_equal(octree.query(octree.leaf_centers()), np.arange(3))
    assert octree.vertex_positions().max() == 1.0


@given(st.lists(st.tuples(*[st.integers(0, (1 << 20) - 1)] * 3), min_size=1, max_size=20))
def test_morton_codes_interleave_the_bits_and_come_back(positions):
    ijk = np.array(positions, dtype=np.int64)
    expected = [
        sum(((int(p[axis]) >> bit & 1) << (3 * bit + 2 - axis)) for bit in range(20) for axis in range(3)) for p in ijk
    ]
    assert morton(ijk).tolist() == expected
    assert np.array_equal(demorton(morton(ijk)), ijk)


# ------------------------------------------------------------------ query
@given(octrees(), indices)
def test_query_agrees_with_brute_force_on_half_open_boxes(octree, seed):
    rng = np.random.default_rng(seed)
    spacing = SIZE / 2.0 ** (octree.max_level + 1)  # half a finest leaf: every other lattice point lies on faces
    reach = int(SIZE / spacing)
    on_lattice = np.array(ORIGIN) + rng.integers(-1, reach + 2, (200, 3)) * spacing
    corners = octree.vertex_positions()[rng.integers(0, octree.n_vertices, 100)]
    anywhere = np.array(ORIGIN) + SIZE * rng.uniform(-0.1, 1.1, (200, 3))
    points = np.concatenate([on_lattice, corners, anywhere])
    low = lower_corners(octree)[None]
    high = low + octree.leaf_sizes()[None, :, None]
    inside = ((points[:, None] >= low) & (points[:, None] < high)).all(-1)
    assert inside.sum(1).max() <= 1
    assert np.array_equal(octree.query(points), np.where(inside.any(1), inside.argmax(1), -1))


def test_query_of_no_points_and_of_points_that_are_nowhere():
    octree = Octree.from_leaves([1], [[0, 0, 0]], ORIGIN, SIZE)
    assert octree.query(np.empty((0, 3))).shape == (0,)
    nowhere = np.array([[np.nan, 0, 0], [np.inf, 1, -3], [-np.inf, 1, -3], [1e300, 1e300, 1e300]])
    assert (octree.query(nowhere) == -1).all()


# ------------------------------------------------------------------ prune
@given(octrees(), indices)
def test_prune_changes_no_bit_inside_the_leaves_it_keeps(octree, seed):
    keep = masks_for(octree, seed)
    pruned, transfer = octree.prune(keep)
    pruned.validate()
    kept = np.flatnonzero(keep)
    assert np.array_equal(np.sort(transfer.parent), kept)
    assert np.array_equal(pruned.leaf_level, octree.leaf_level[transfer.parent])
    assert np.array_equal(pruned.leaf_ijk, octree.leaf_ijk[transfer.parent])
    assert np.array_equal(pruned.values[pruned.corners], octree.values[octree.corners[transfer.parent]])
    assert (pruned.sh_degree, pruned.density_scale, pruned.size) == (octree.sh_degree, 3.0, SIZE)
    moments = np.random.default_rng(seed).random((octree.n_vertices, 3))
    moved = transfer.vertices(moments)
    assert moved.dtype == moments.dtype
    assert np.array_equal(moved[pruned.corners], moments[octree.corners[transfer.parent]])


@given(octrees())
def test_prune_of_nothing_is_the_same_octree(octree):
    pruned, transfer = octree.prune(np.ones(octree.n_leaves, bool))
    same_octree(pruned, octree)
    assert np.array_equal(transfer.parent, np.arange(octree.n_leaves))


# ------------------------------------------------------------------ subdivide
@given(octrees(), indices)
def test_subdivide_makes_the_eight_children_and_leaves_the_rest(octree, seed):
    mask = masks_for(octree, seed)
    finer, transfer = octree.subdivide(mask)
    finer.validate()
    assert finer.n_leaves == octree.n_leaves + 7 * mask.sum()
    parent = transfer.parent
    shift = finer.leaf_level - octree.leaf_level[parent]
    assert np.array_equal(shift, mask[parent].astype(int))
    assert np.array_equal(finer.leaf_ijk >> shift[:, None], octree.leaf_ijk[parent])
    assert np.array_equal(np.bincount(parent, minlength=octree.n_leaves), np.where(mask, 8, 1))
    whole = ~mask[parent]
    assert np.array_equal(finer.values[finer.corners[whole]], octree.values[octree.corners[parent[whole]]])


@given(octrees(), indices)
def test_subdivide_keeps_the_field_save_at_vertices_of_finer_neighbours(octree, seed):
    """The bound, stated.

    Where a new corner is no vertex of the old octree, its value is the old field's to rounding: eight products by
    powers of two, exact, and seven additions, 7 u max|v|. Where it is one, the vertex keeps its value bit by bit. A
    leaf's field is a convex combination of its corners, so inside a new leaf it differs from the old field by no more
    than the largest difference at the leaf's corners: nothing, unless a finer neighbour owned one of them.
    """
    finer, transfer = octree.subdivide(masks_for(octree, seed))
    old_vertex = {tuple(p): i for i, p in enumerate(octree.vertex_positions())}
    new_positions = finer.vertex_positions()
    owner = np.array([old_vertex.get(tuple(p), -1) for p in new_positions])
    assert np.array_equal(finer.values[owner >= 0], octree.values[owner[owner >= 0]])

    largest = np.abs(octree.values[octree.corners[transfer.parent]]).max((1, 2))
    rounding = 7 * UNIT_ROUNDOFF * largest
    parent8 = transfer.parent.repeat(8)
    at_corners = field(octree, parent8, new_positions[finer.corners].reshape(-1, 3)).reshape(finer.n_leaves, 8, -1)
    change = np.abs(finer.values[finer.corners] - at_corners)
    is_new = owner[finer.corners] < 0
    assert (change[is_new] <= rounding.repeat(8).reshape(-1, 8)[is_new][:, None]).all()
    # Corners of the parent are old vertices that cannot have changed, so any larger change is at a finer neighbour's.
    of_parent = (octree.corners[transfer.parent][:, None] == owner[finer.corners][:, :, None]).any(-1)
    assert (change[of_parent] == 0).all()

    rng = np.random.default_rng(seed)
    leaf = rng.integers(0, finer.n_leaves, 64)
    points = lower_corners(finer)[leaf] + rng.random((64, 3)) * finer.leaf_sizes()[leaf, None]
    difference = np.abs(field(finer, leaf, points) - field(octree, transfer.parent[leaf], points))
    assert (difference <= change[leaf].max(1) + 1e-12).all()  # 1e-12: the float64 arithmetic of this test


@given(octrees(), indices)
def test_transfer_interpolates_rows_of_any_kind(octree, seed):
    """The rows of the optimiser follow like the values, in their own precision."""
    finer, transfer = octree.subdivide(masks_for(octree, seed))
    assert np.array_equal(transfer.vertices(octree.values), finer.values)
    wide = octree.values[:, :5].astype(np.float64)
    moved = transfer.vertices(wide)
    assert moved.dtype == np.float64 and moved.shape == (finer.n_vertices, 5)
    bound = 7 * UNIT_ROUNDOFF * np.abs(wide).max()
    assert np.abs(moved - finer.values[:, :5]).max() <= bound


@given(leaf_sets(), indices)
def test_linear_fields_survive_every_change_exactly(leaves, seed):
    """Slopes and positions are multiples of 2**-8 below 2**8: all sums of eight eighths are exact in float32."""
    octree = Octree.from_leaves(*leaves, ORIGIN, SIZE)
    slope = np.random.default_rng(seed).integers(-4, 5, (4, octree.values.shape[1]))

    def linear(t: Octree) -> np.ndarray:
        return np.column_stack([t.vertex_positions(), np.ones(t.n_vertices)]) @ slope

    octree.values[:] = linear(octree)
    for change in ("subdivide", "prune", "subdivide"):
        octree, _ = getattr(octree, change)(masks_for(octree, seed))
        assert np.array_equal(octree.values, linear(octree))


# ------------------------------------------------------------------ compiled and plain agree
@pytest.mark.skipif(native() is None, reason="no compiled kernels")
@given(octrees(), indices, examples=30)
def test_compiled_and_numpy_topology_agree(octree, seed):
    mask = masks_for(octree, seed)

    def all_changes():
        fresh = Octree.from_leaves(octree.leaf_level, octree.leaf_ijk, ORIGIN, SIZE, octree.sh_degree, 3.0)
        fresh.values[:] = octree.values
        rows = np.random.default_rng(seed).random((octree.n_vertices, 4), dtype=np.float32)
        pruned, finer = fresh.prune(mask), fresh.subdivide(mask)
        return (
            [fresh, pruned[0], finer[0]],
            [a for _, t in (pruned, finer) for a in (t.parent, t.vertices(rows), t.vertices(rows.astype(np.float64)))],
        )

    trees, arrays = all_changes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "native", lambda: None)
        plain_trees, plain_arrays = all_changes()
    for a, b in zip(trees, plain_trees, strict=True):
        same_octree(a, b)
    for a, b in zip(arrays, plain_arrays, strict=True):
        assert a.dtype == b.dtype and np.array_equal(a, b)


# ------------------------------------------------------------------ values
@pytest.mark.parametrize("degree", range(4))
def test_coefficients_and_density_have_places_of_their_own(degree):
    slots = sh_slots(degree)
    assert slots.shape == (3, (degree + 1) ** 2)
    used = [*slots.ravel(), DENSITY_SLOT]
    assert len(set(used)) == len(used) and max(used) < 16 * BLOCKS[degree]
    octree = Octree.from_leaves([1, 1], [[0, 0, 0], [1, 1, 1]], ORIGIN, SIZE, degree)
    rng = np.random.default_rng(degree)
    sh, raw = rng.random(octree.sh.shape).astype(np.float32), rng.random(octree.n_vertices).astype(np.float32)
    octree.sh, octree.density = sh, raw
    assert np.array_equal(octree.sh, sh) and np.array_equal(octree.density, raw)
    for other in range(4):
        converted = octree.with_sh_degree(other)
        converted.validate()
        k = (min(degree, other) + 1) ** 2
        assert np.array_equal(converted.sh[:, :, :k], sh[:, :, :k]) and not converted.sh[:, :, k:].any()
        assert np.array_equal(converted.density, raw)
    assert octree.sh_degree == degree and np.array_equal(octree.sh, sh)


@given(st.floats(-80, 1e6))
def test_explin_is_positive_and_inverts(raw):
    value = explin(np.array(raw))
    assert value > 0
    assert np.isclose(explin_inverse(value), raw, rtol=1e-12, atol=1e-12)


@pytest.mark.skipif(native() is None, reason="no compiled kernels")
@given(
    indices,
    st.sampled_from([1, 127, 128, 129, 5000, 9000]),
    st.lists(st.integers(0, MAX_LEVEL), min_size=1, max_size=5),
    examples=12,
)
def test_corners_of_many_leaves_are_numbered_as_numpy_does(seed, n, levels):
    """Of levels that do not occur between others, in any order: siblings in a row, some named across the ends of batches, and
    leaves far from each other, which name up to eight vertices each, so that the table grows."""
    rng = np.random.default_rng(seed)
    level = rng.choice(np.array(levels, np.int8), n)
    ijk = (rng.random((n, 3)) * 2.0 ** level[:, None]).astype(np.int32)
    blocks = rng.random((n + 7) // 8) < 0.5  # eights that are siblings, but for the last
    eight, octant = np.divmod(np.arange(n), 8)
    family = blocks[eight] & (level[8 * eight] > 0)
    level = np.where(family, level[8 * eight], level)
    ijk = np.where(family[:, None], ijk[8 * eight] & ~1 | OFFSETS[octant], ijk).astype(np.int32)
    start = rng.integers(min(n, 8))  # so that a batch ends among siblings
    level, ijk = np.ascontiguousarray(level[start:]), np.ascontiguousarray(ijk[start:])
    corners, vertices = module.number_corners(level, ijk)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "native", lambda: None)
        plain, plain_vertices = module.number_corners(level, ijk)
    assert vertices == plain_vertices and np.array_equal(corners, plain)
