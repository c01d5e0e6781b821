"""Pictures rendered in parts have the bits of those rendered at once, however they were cut and whoever came first."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_synth import March, Path, parts, scenes
from data_synth.cli import main, render_task
from data_synth.parts import BLOCK, Part, blocks, cut, joined, tree_sum, whole
from tests.data_synth.test_dataset import _set

SPP = 7 * BLOCK + 3


@pytest.fixture(scope="module")
def scene():
    return scenes.make("sphere")


@pytest.fixture
def small(monkeypatch):
    """Even small pictures are cut."""
    for name, value in {"WHOLE_RAYS": 100, "PART_RAYS": 12 * 4 * BLOCK, "PART_PIXELS": 50}.items():
        monkeypatch.setattr(parts, name, value)


def by_definition(leaves, level, k):
    """Node k of a level of the tree over ``leaves``, as the module's head says it; None where it has no blocks."""
    if level == 0:
        return leaves[k] if k < len(leaves) else None
    left, right = by_definition(leaves, level - 1, 2 * k), by_definition(leaves, level - 1, 2 * k + 1)
    return left if right is None else left + right


@pytest.mark.parametrize("total", (1, 2, 3, 5, 8, 11, 16, 21))
def test_any_grouping_into_nodes_gives_the_sum_of_the_one_tree(total):
    leaves = list(np.random.default_rng(total).standard_normal((total, 50)) * 10.0 ** np.arange(total)[:, None])
    expected = by_definition(leaves, 5, 0)
    assert total < 4 or not np.array_equal(expected, sum(leaves))  # other orders round otherwise
    for group in (1, 2, 4, 8, 32):
        nodes = [tree_sum(leaves[first : first + group]) for first in range(0, total, group)]
        assert np.array_equal(tree_sum(nodes), expected)


@settings(deadline=None)
@given(st.integers(1, 3000), st.integers(1, 3000), st.integers(1, 5000), st.booleans())
def test_parts_have_every_row_and_block_once_and_stay_small(height, width, samples, splits):
    found = cut(height, width, samples, splits)
    if height * width * samples <= parts.WHOLE_RAYS:
        assert found == [whole(height, samples)]
        return
    at, block = 0, 0  # bands in order, and in each its blocks in order
    for part in found:
        assert (part.top, part.first) == (at, block) and part.bottom > at and part.last > block
        one_row = part.bottom - part.top == 1
        assert one_row or (part.bottom - part.top) * width <= parts.PART_PIXELS
        if splits:
            rays = (part.bottom - part.top) * width * (part.last - part.first) * BLOCK
            assert rays <= max(parts.PART_RAYS, width * BLOCK)
            group = found[0].last - found[0].first
            assert group & (group - 1) == 0 or len({part.top for part in found}) == len(found)
            assert part.first % group == 0
        block = part.last if part.last < blocks(samples) else 0
        at = at if block else part.bottom
    assert (at, block) == (height, 0)


@pytest.mark.parametrize("integrator", (Path(spp=SPP), Path(spp=SPP, jitter=False, max_depth=2), March(side=2)))
def test_the_sums_of_parts_are_those_of_the_whole(scene, small, integrator):
    camera = scene.viewpoints.camera(30.0, 20.0, 12, 10)
    expected = integrator.sums(scene, camera, 5, whole(10, SPP))
    found = integrator.parts(10, 12)
    assert len(found) > 2 and (not isinstance(integrator, Path) or len({part.first for part in found}) > 1)
    order = np.random.default_rng(0).permutation(len(found))  # whoever comes first
    sums = {k: integrator.sums(scene, camera, 5, found[k]) for k in order}
    assert np.array_equal(joined(found, iter([sums[k] for k in range(len(found))])), expected)
    alone = [Part(0, 10, block, block + 1) for block in range(8)] if isinstance(integrator, Path) else found
    assert np.array_equal(joined(alone, (integrator.sums(scene, camera, 5, part) for part in alone)), expected)
    picture = integrator.render(scene, camera, 5)
    assert np.array_equal(picture.rgb, integrator.picture(expected).rgb)


def test_blocks_are_streams_of_their_own(scene):
    """The means of blocks scatter as the variance says that the whole reports, chi-square over 63 degrees of freedom."""
    n = 64
    integrator = Path(spp=n * BLOCK)
    camera = scene.viewpoints.camera(30.0, 20.0, 6, 4)
    means = np.array([integrator.sums(scene, camera, 1, Part(0, 4, b, b + 1))[..., 1] / BLOCK for b in range(n)])
    picture = integrator.render(scene, camera, 1)
    assert picture.variance is not None
    lit = picture.variance[..., 1] > 0
    assert lit.sum() > 8
    assert np.median([len(set(pixel)) for pixel in means[:, lit].T]) > n / 2  # rays that miss are alike
    chi2 = ((means - means.mean(axis=0)) ** 2).sum(axis=0)[lit] / (n * picture.variance[..., 1][lit])
    # The mean of k chi-squares of 63 degrees: 63 +- sqrt(126 / k); 5 sigma.
    assert abs(chi2.mean() - (n - 1)) < 5 * np.sqrt(2 * (n - 1) / lit.sum())


def test_the_mean_and_its_variance_are_those_of_the_samples(scene):
    integrator = Path(spp=5)
    sums = np.zeros((1, 1, 8))
    values = np.array([1.0, 2.0, 4.0, 7.0, 11.0])
    sums[..., :3], sums[..., 3], sums[..., 4], sums[..., 5:] = values.sum(), 2.5, 10.0, (values**2).sum()
    picture = integrator.picture(sums)
    assert picture.rgb[0, 0, 0] == values.mean() and picture.alpha[0, 0] == 0.5 and picture.distance[0, 0] == 2.0
    assert picture.variance is not None
    assert picture.variance[0, 0, 0] == pytest.approx(values.var(ddof=1) / 5, rel=1e-14)


def elsewhere(argv, log):
    """Renders pieces as a worker does, and notes which."""

    def each(pieces):
        log.extend(pieces)
        return [render_task({"argv": argv}, {}, piece) for piece in pieces]

    return each


@pytest.mark.parametrize("more", (("--integrator", "path", "--spp", "40"), ("--integrator", "emission"), ()))
def test_a_set_and_a_portrait_in_pieces_are_the_bytes_of_the_whole(tmp_path, small, more):
    argv, log = ["sphere", "--views", "2", "--size", "12x10", "--exr", "--seed", "3", *more], []
    assert main([*argv, "--out", str(tmp_path / "whole")]) == 0
    assert main([*argv, "--out", str(tmp_path / "pieces")], elsewhere(argv, log)) == 0
    assert len(log) > 5 and all(piece.part is not None for piece in log)
    assert _set(tmp_path / "pieces") == _set(tmp_path / "whole")
    assert main([*argv, "--picture", str(tmp_path / "whole.png")]) == 0
    assert main([*argv, "--picture", str(tmp_path / "pieces.png")], elsewhere(argv, log)) == 0
    assert (tmp_path / "pieces.png").read_bytes() == (tmp_path / "whole.png").read_bytes()


def test_what_cannot_be_cut_goes_as_whole_views(tmp_path, small):
    argv, log = ["cloud", "--views", "1", "--size", "12x10", "--integrator", "deep", "--set", "resolution=16"], []
    assert main([*argv, "--out", str(tmp_path)], elsewhere(argv, log)) == 0
    assert [piece.part for piece in log] == [None] * 4
