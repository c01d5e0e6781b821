"""The octree: what it refuses, where its rows begin in memory, what ``validate`` sees."""

import numpy as np
import pytest
from hypothesis import strategies as st

import nerfvol.octree.topology as module
from nerfvol.errors import InputError
from nerfvol.native import aligned_empty
from nerfvol.octree.topology import MAX_LEVEL
from nerfvol.octree.tree import Octree
from tests.fixtures.octrees import ORIGIN, SIZE, given, octrees


# ------------------------------------------------------------------ refusals
@pytest.mark.parametrize(
    "level, ijk, words",
    [
        ([], np.empty((0, 3)), "at least one leaf"),
        ([1, 1], [[0, 0, 0], [0, 0, 0]], "overlap"),
        ([1, 2], [[0, 0, 0], [1, 1, 1]], "overlap"),
        ([1, 4], [[1, 0, 1], [8, 7, 15]], "overlap"),
        ([1], [[2, 0, 0]], "lie in"),
        ([3], [[0, -1, 0]], "lie in"),
        ([0], [[0, 0, 0]], "levels"),
        ([MAX_LEVEL + 1], [[0, 0, 0]], "levels"),
        ([1, 2], [[0, 0, 0]], "2 leaves but ijk has 1"),
    ],
)
def test_leaf_sets_that_make_no_octree_are_refused(level, ijk, words):
    with pytest.raises(InputError, match=words):
        Octree.from_leaves(level, ijk, ORIGIN, SIZE)


def from_masks(node_mask, leaf_mask, **change):
    frame = dict(origin=ORIGIN, size=SIZE, sh_degree=1, density_scale=1.0) | change
    return Octree(np.array(node_mask, np.uint8), np.array(leaf_mask, np.uint8), **frame)


@pytest.mark.parametrize(
    "node_mask, leaf_mask, words",
    [
        ([1, 0], [1, 1], "both as"),
        ([1], [2], "1 nodes but 1 links"),
        ([0, 0], [1, 1], "2 nodes but 0 links"),
        ([0, 2, 2], [1, 0, 1], "hang on the root"),  # nodes 1 and 2 link to nodes, but the root does not
        ([1, 0, 1, 1], [2, 1, 0, 0], "hang on the root"),  # two nodes that keep each other alive
        ([1] * (MAX_LEVEL + 1) + [0], [0] * (MAX_LEVEL + 1) + [1], "deeper than"),
        ([0], [0], "no leaves"),
        ([], [], "non-empty"),
        ([1, 0], [0, 1, 1], "two equal"),
        ([[0]], [[1]], "vectors"),
    ],
)
def test_masks_that_make_no_octree_are_refused(node_mask, leaf_mask, words):
    with pytest.raises(InputError, match=words):
        from_masks(node_mask, leaf_mask)


@pytest.mark.parametrize(
    "change",
    [
        {"size": 0.0},
        {"size": -1.0},
        {"size": np.nan},
        {"size": np.inf},
        {"origin": (0, np.nan, 0)},
        {"sh_degree": 4},
        {"sh_degree": -1},
        {"density_scale": 0.0},
        {"density_scale": np.inf},
        {"density_scale": np.nan},
    ],
)
def test_frames_that_make_no_sense_are_refused(change):
    with pytest.raises(InputError):
        from_masks([0], [1], **change)


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), min_size=1, max_size=12), examples=300)
def test_random_masks_are_refused_or_sound(pairs):
    node_mask, leaf_mask = np.array(pairs).T
    for nodes in (node_mask, node_mask & ~leaf_mask, np.where(np.arange(len(pairs)) < len(pairs) - 1, 1, 0)):
        try:
            octree = from_masks(nodes, leaf_mask & ~nodes if nodes is not node_mask else leaf_mask)
        except InputError:
            continue
        octree.validate()
        assert np.array_equal(octree.query(octree.leaf_centers()), np.arange(octree.n_leaves))


@given(octrees())
def test_masks_of_changes_must_fit_the_leaves(octree):
    for length in (0, octree.n_leaves - 1, octree.n_leaves + 1):
        with pytest.raises(InputError, match="one entry per leaf"):
            octree.prune(np.ones(length, bool))
        with pytest.raises(InputError, match="one entry per leaf"):
            octree.subdivide(np.ones(length, bool))
    with pytest.raises(InputError, match="without leaves"):
        octree.prune(np.zeros(octree.n_leaves, bool))


def test_the_deepest_leaves_are_not_subdivided():
    octree = Octree.from_leaves([MAX_LEVEL, 1], [[0, 0, 0], [1, 1, 1]], ORIGIN, SIZE)
    with pytest.raises(InputError, match="subdivide below"):
        octree.subdivide([False, True])  # breadth first: the deep leaf is the second
    octree.subdivide([True, False])


@pytest.mark.parametrize("wrong", [[256], [-1], [1.5], [np.nan]])
def test_masks_that_uint8_would_change_are_refused(wrong):
    for node_mask, leaf_mask in ((wrong, [1]), ([0], wrong)):
        with pytest.raises(InputError, match=r"_mask must hold whole numbers in 0\.\.255"):
            Octree(node_mask, leaf_mask, origin=ORIGIN, size=SIZE, sh_degree=0, density_scale=1)
    assert Octree([0], [255.0], origin=ORIGIN, size=SIZE, sh_degree=0, density_scale=1).n_leaves == 8


@pytest.mark.parametrize("wrong", [1.5, np.nan])
def test_fractional_leaves_are_refused(wrong):
    with pytest.raises(InputError, match="leaf levels must be whole numbers"):
        Octree.from_leaves([wrong], [[0, 0, 0]], ORIGIN, SIZE)
    with pytest.raises(InputError, match="leaf positions must be whole numbers"):
        Octree.from_leaves([1], [[0, wrong, 0]], ORIGIN, SIZE)


def begins_on_a_line(array: np.ndarray) -> bool:
    return array.ctypes.data % 64 == 0 and array.flags.c_contiguous


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("use_reference", [False, True])
def test_rows_begin_on_cache_lines(degree, use_reference, monkeypatch):
    """Large arrays too, which numpy itself places 16 bytes past a line."""
    if use_reference:
        monkeypatch.setattr(module, "native", lambda: None)
    cells = np.stack(np.meshgrid(*[np.arange(16)] * 3, indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(len(cells), 4), cells, ORIGIN, SIZE, degree)
    split, transfer = octree.subdivide(np.arange(octree.n_leaves) % 2 == 0)
    pruned, _ = split.prune(np.arange(split.n_leaves) % 3 > 0)
    for t in (octree, split, pruned, octree.with_sh_degree(3)):
        assert begins_on_a_line(t.corners) and begins_on_a_line(t.values)
    assert begins_on_a_line(transfer.vertices(np.ones_like(octree.values)))


def test_values_are_kept_or_copied_to_a_cache_line():
    octree = Octree.from_leaves([1], [[0, 0, 0]], ORIGIN, SIZE)
    fitting = aligned_empty((8, 16), np.float32)
    octree.values = fitting
    assert octree.values is fitting
    memory = np.arange(8 * 16 + 16, dtype=np.float32)
    start = -memory.ctypes.data % 64 // 4
    for rows in (memory[start + 4 :][:128], memory[start:][:128].astype(np.float64), memory[start:][:128][::-1]):
        octree.values = rows.reshape(8, 16)
        assert begins_on_a_line(octree.values) and octree.values.dtype == np.float32
        assert np.array_equal(octree.values, rows.reshape(8, 16)) and not np.shares_memory(octree.values, rows)


def set_nan(octree):
    octree.values[0, 0] = np.nan


TAMPERINGS = {
    "corners": lambda t: setattr(t, "corners", np.where(t.corners == 0, t.n_vertices, t.corners)),
    "corners below zero": lambda t: setattr(t, "corners", t.corners - 1),
    "corners of too few leaves": lambda t: setattr(t, "corners", t.corners[:-1]),
    "values of too few vertices": lambda t: setattr(t, "values", t.values[:-1]),
    "values of another degree": lambda t: setattr(t, "values", np.zeros((t.n_vertices, 16), np.float32)),
    "values not finite": set_nan,
    "first_node": lambda t: setattr(t, "first_node", t.first_node + 1),
    "first_leaf": lambda t: setattr(t, "first_leaf", t.first_leaf + 1),
    "leaf_level": lambda t: setattr(t, "leaf_level", t.leaf_level + 1),
    "leaf_ijk": lambda t: setattr(t, "leaf_ijk", t.leaf_ijk[::-1]),
    "node_mask": lambda t: setattr(t, "node_mask", t.node_mask | 128),
    "leaf_mask": lambda t: setattr(t, "leaf_mask", np.roll(t.leaf_mask, 1)),
    "size": lambda t: setattr(t, "size", -1.0),
}


@pytest.mark.parametrize("what", TAMPERINGS)
def test_validate_sees_tampering(what):
    octree = Octree.from_leaves([1, 2, 2], [[0, 0, 0], [2, 2, 2], [3, 3, 2]], ORIGIN, SIZE, 2)
    octree.validate()
    TAMPERINGS[what](octree)
    with pytest.raises(InputError):
        octree.validate()
