"""Merging leaves: nothing changes where the field is trilinear, little elsewhere, and a step stays."""

import numpy as np
import pytest

from nerfvol.octree.merge import _merge_errors, merge_smooth
from nerfvol.starts.values import write_values
from tests.fixtures.fields import Blob, full_octree, interpolate, random_points


def test_merging_changes_nothing_where_the_field_is_trilinear() -> None:
    """A field that is linear in space merges to the coarsest leaves allowed, with the same values everywhere."""

    class Linear(Blob):
        def density(self, positions: np.ndarray) -> np.ndarray:
            return 300 + 100 * positions[:, 0] - 50 * positions[:, 1]

    octree = full_octree(4)
    write_values(octree, Linear(), 0)
    merged = merge_smooth(octree, 2, 1e-4)
    merged.validate()
    assert merged.n_leaves == 64 and (merged.leaf_level == 2).all()
    points = random_points(500, 0.99)
    for mine, other in zip(interpolate(merged, points)[1:], interpolate(octree, points)[1:], strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-5, atol=1e-5)


def test_merging_keeps_within_its_tolerance() -> None:
    octree = full_octree(5)
    write_values(octree, Blob(), 0)
    sizes = []
    for tolerance in (0.003, 0.03):
        merged = merge_smooth(octree, 2, tolerance)
        merged.validate()
        sizes.append(merged.n_leaves)
        points = random_points(4000, 0.99)
        _, sigma, _ = interpolate(merged, points)
        _, before, _ = interpolate(octree, points)
        edge = 2 / 2**4  # of the siblings of the second merge, whose tolerance adds to that of the first
        assert np.abs(np.exp(-sigma * edge / 2) - np.exp(-before * edge / 2)).max() < 3 * tolerance
    assert sizes[1] < sizes[0] < octree.n_leaves
    assert merge_smooth(octree, 2, 0.0) is octree


@pytest.mark.parametrize("what", ["density", "red", "view dependence"])
def test_a_step_is_not_merged(what: str) -> None:
    """One differing vertex in the middle of eight siblings keeps them apart; their parents' neighbours still merge."""
    octree = full_octree(3)
    octree.density = np.full(octree.n_vertices, -3.0)  # an opacity of 0.37 a leaf
    middle = np.argmin(np.abs(octree.vertex_positions() - octree.origin - 0.25).sum(1))
    raw, coefficients = octree.density.copy(), octree.sh
    raw[middle] += 0.1 * (what == "density")
    coefficients[middle, 0, 0] += 0.1 * (what == "red")
    coefficients[middle, 2, 3] += 0.1 * (what == "view dependence")
    octree.density, octree.sh = raw, coefficients
    merged = merge_smooth(octree, 2, 1e-3)
    assert merged.n_leaves == 63 + 8 and (merged.leaf_level == 3).sum() == 8
    np.testing.assert_array_equal(merged.leaf_ijk[merged.leaf_level == 3].max(0), [1, 1, 1])


@pytest.mark.parametrize(("densest", "colours"), [(1.5, 0.2), (-4.0, 2.0)], ids=["by opacity", "by colour"])
def test_the_compiled_error_is_the_one_in_numpy(
    monkeypatch: pytest.MonkeyPatch, densest: float, colours: float
) -> None:
    """Eight leaves with random values; the rounding of 13 numbers, eight products each, is below 1e-5 of the largest.

    Where leaves are faint and colourful it is their colours that decide, each times what is seen of it.
    """
    octree = full_octree(2)
    random = np.random.default_rng(0)
    octree.density = random.uniform(densest - 7.5, densest, octree.n_vertices)
    octree.sh = random.normal(0, colours, octree.sh.shape)
    first = np.arange(0, 64, 8)
    fast = _merge_errors(octree, octree.corners, first, octree.size / 4)
    monkeypatch.setattr("nerfvol.octree.merge.native", lambda: None)
    slow = _merge_errors(octree, octree.corners, first, octree.size / 4)
    assert slow.min() > 0.05
    np.testing.assert_allclose(fast, slow, atol=1e-5 * max(1, slow.max()))
    octree.sh = np.zeros(octree.sh.shape)
    by_opacity = _merge_errors(octree, octree.corners, first, octree.size / 4)
    assert np.all(slow > by_opacity) if colours > 1 else np.all(slow == by_opacity)


def test_leaves_of_several_sizes_merge_with_their_values() -> None:
    """Every value that is left stands where it stood, with leaves of three sizes to begin with."""
    octree = full_octree(3)
    octree = octree.subdivide(octree.leaf_ijk[:, 0] < 2)[0]
    write_values(octree, Blob(), 0)
    merged = merge_smooth(octree, 2, 0.02)
    merged.validate()
    assert len(np.unique(merged.leaf_level)) >= 3
    places = {tuple(p): row for p, row in zip(np.round(octree.vertex_positions(), 6), octree.values, strict=True)}
    for place, row in zip(np.round(merged.vertex_positions(), 6), merged.values, strict=True):
        np.testing.assert_array_equal(places[tuple(place)], row)
