"""The same bits whatever the number of threads, the order of the tiles, or the run; builds agree within rounding."""

import numpy as np
import pytest
import torch

from nerfvol.kernels import on_torch, ops
from nerfvol.octree.tree import Octree
from tests.fixtures.random_octrees import camera_tiles, random_octree
from tests.kernels import rounding
from tests.kernels.test_ops import BACKGROUND, Case, build, traced

RATES = ops.Rates(density=0.1, dc=0.03, sh=0.01)


def trained(seed: int, degree: int, steps: int = 4) -> tuple[Octree, ops.TrainState, list[float]]:
    """A few steps on many tiles (more than there are threads, several per vertex), everything from the seed."""
    rng = np.random.default_rng(seed)
    octree = random_octree("mixed", degree, rng)
    state = ops.TrainState(octree)
    options = ops.LossOptions(BACKGROUND, colour=0.1, distortion=0.1, sparsity=0.01, tv_density=0.01, tv_sh=0.01)
    errors = []
    for _ in range(steps):
        o, d = camera_tiles(octree, rng, 24)
        target, weight = rng.random((len(d), 3)).astype(np.float32), np.full(len(d), 1 / len(d), np.float32)
        errors.append(
            ops.train_step(octree, state, ops.Batch(o, d, target, weight), options, RATES, 0.01).squared_error
        )
    return octree, state, errors


def assert_same_bits(a, b) -> None:
    assert np.array_equal(a[0].values, b[0].values)
    for name in ("moments", "max_weight", "error", "footprint"):
        assert np.array_equal(getattr(a[1], name), getattr(b[1], name)), name
    assert a[2] == b[2]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_training_gives_the_same_bits_for_any_number_of_threads(isa, threads, degree):
    runs = []
    for n in (1, 2, 3):
        threads(n)
        assert ops.get_threads() == n
        runs.append(trained(5, degree))
    assert_same_bits(runs[0], runs[1])
    assert_same_bits(runs[0], runs[2])


def test_one_seed_one_result_and_another_seed_another(isa):
    first = trained(6, 1)
    assert_same_bits(first, trained(6, 1))
    assert not np.array_equal(first[0].values[:50], trained(7, 1)[0].values[:50])


def test_gradients_give_the_same_bits_for_any_number_of_threads(isa, threads):
    octree, o, d = build(Case("mixed", 2, 50, n=20))
    rng = np.random.default_rng(0)
    cotangents = [torch.from_numpy(rng.standard_normal(s).astype(np.float32)) for s in ((len(d), 3), len(d), len(d))]
    found = []
    for n in (1, 3, 2, 1):
        threads(n)
        values = torch.from_numpy(octree.values).requires_grad_()
        found.append(
            torch.autograd.grad(on_torch.render_values(octree, values, o, d, BACKGROUND), values, cotangents)[0]
        )
    assert all(torch.equal(found[0], g) for g in found[1:])


def test_permuted_tiles_give_permuted_images(isa, threads):
    octree, o, d = build(Case("mixed", 2, 51, n=40))
    order = np.random.default_rng(1).permutation(len(o))
    rays = (order[:, None] * 64 + np.arange(64)).ravel()
    threads(1)
    plain = ops.render_rays(octree, o, d, BACKGROUND)
    for n in (1, 2, 3):
        threads(n)
        permuted = ops.render_rays(octree, o[order], d[rays], BACKGROUND)
        for name, image in plain.items():
            assert np.array_equal(image[rays], permuted[name]), name


def test_the_builds_agree_within_rounding():
    """Each is within the bound of the reference, so two are within twice the bound of each other."""
    case = Case("mixed", 3, 52, n=8)
    octree, o, d = build(case)
    bounds = rounding.image_bounds(traced(case), octree, BACKGROUND)
    images = {}
    for name in ops.available_isas():
        if name == "reference":
            pytest.skip("no compiled kernels")
        ops.set_isa(name)
        assert ops.isa() == name
        images[name] = ops.render_rays(octree, o, d, BACKGROUND, 0.0)
    ops.set_isa("auto")
    assert ops.isa() == ops.available_isas()[0]
    for image in images.values():
        for name in ("rgb", "depth", "normal"):
            difference = np.abs(image[name] - images["baseline"][name])
            assert (difference <= 2 * bounds[name]).all(), name
