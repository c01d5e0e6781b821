"""The torch reference itself: its derivatives, its traversal against brute force, closed forms, the early stop."""

import math

import numpy as np
import pytest
import torch

from nerfvol.kernels import ops, reference
from nerfvol.octree.rows import explin_inverse
from nerfvol.octree.tree import Octree
from tests.fixtures.random_octrees import ODD, camera_tiles, lattice_rays, random_octree, scattered_rays, unit


def rays64(o, d) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.as_tensor(np.asarray(o)).double(), torch.as_tensor(np.asarray(d)).double()


def brute_force(octree: Octree, o: np.ndarray, d: np.ndarray):
    """Every ray against every leaf: {(ray, leaf): (near, far)}, half-open at upper faces."""
    low = octree.origin + octree.leaf_ijk * octree.leaf_sizes()[:, None]
    high = low + octree.leaf_sizes()[:, None]
    found = {}
    for ray in range(len(o)):
        near, far, meets = np.zeros(len(low)), np.full(len(low), np.inf), np.ones(len(low), bool)
        for k in range(3):
            if d[ray, k] == 0:
                meets &= (o[ray, k] >= low[:, k]) & (o[ray, k] < high[:, k])
                continue
            a, b = (low[:, k] - o[ray, k]) / d[ray, k], (high[:, k] - o[ray, k]) / d[ray, k]
            near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
        found |= {(ray, int(i)): (near[i], far[i]) for i in np.flatnonzero(meets & (far > near))}
    return found


@pytest.mark.parametrize("rays", ["camera", "scattered", "lattice"])
@pytest.mark.parametrize("kind", ["mixed", "full", "single", "sparse"])
def test_crossings_agree_with_brute_force(kind, rays):
    rng = np.random.default_rng(len(kind))
    octree = random_octree(kind, 0, rng)
    if rays == "camera":
        o, d = camera_tiles(octree, rng, 4)
        o = o.repeat(64, 0)
    else:
        o, d = scattered_rays(octree, rng, 64) if rays == "scattered" else lattice_rays(octree, rng, 128, 4)
    o, d = o.astype(np.float64), d.astype(np.float64)
    seg = reference.intersect(octree, *rays64(o, d))
    found = brute_force(octree, o, d)
    pairs = list(zip(seg.ray.tolist(), seg.leaf.tolist(), strict=True))
    # Slivers below 1e-14 may come and go with the order of operations; nothing else may.
    solid = {pair for pair, (near, far) in found.items() if far - near > 1e-14}
    assert solid <= set(pairs) and len(set(pairs)) == len(pairs) and len(solid) > 0
    for pair, near, far in zip(pairs, seg.t_near.tolist(), seg.t_far.tolist(), strict=True):
        if pair in found:
            assert (near, far) == pytest.approx(found[pair], abs=1e-12)
        else:
            assert far - near <= 1e-14
    # Front to back, without gaps in the order: the next segment starts no earlier than this one ends.
    same = seg.ray[1:] == seg.ray[:-1]
    assert (seg.ray[1:] >= seg.ray[:-1]).all()
    assert (seg.t_near[1:] >= seg.t_far[:-1] - 1e-12)[same].all()


@pytest.mark.parametrize("degree", range(4))
def test_gradcheck_of_the_images(degree):
    rng = np.random.default_rng(degree)
    octree = random_octree("single", degree, rng, ODD)
    octree = octree.subdivide([True])[0].prune(rng.random(8) < 0.6)[0]
    octree.density = rng.uniform(-1.0, 2.5, octree.n_vertices)  # both sides of explin's joint, no vertex on it
    octree.sh = rng.standard_normal(octree.sh.shape)
    o, d = rays64(*scattered_rays(octree, rng, 5))
    d = torch.nn.functional.normalize(torch.from_numpy(octree.leaf_centers()[:5][[0, 1, 1, 0, 0]]) - o)
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    values = torch.from_numpy(octree.values).double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v: reference.render(octree, v, o, d, background, 0.0), (values,), eps=1e-6, atol=1e-6, fast_mode=True
    )


@pytest.mark.parametrize(
    "terms",
    [{}, {"colour": 0.4}, {"distortion": 0.7}, {"sparsity": 0.2}, {"tv_density": 0.3}, {"tv_sh": 0.3}],
    ids=lambda terms: next(iter(terms), "plain"),
)
def test_gradcheck_of_the_loss(terms):
    rng = np.random.default_rng(8)
    torch.manual_seed(8)
    octree = random_octree("full", 0, rng)
    octree = octree.prune(np.arange(octree.n_leaves) % 5 == 0)[0]
    octree.density = rng.uniform(-1.0, 2.5, octree.n_vertices)
    o, d = rays64(*scattered_rays(octree, rng, 4))
    options = ops.LossOptions(**terms, early_stop_eps=0.0)
    target, weight = torch.rand(4, 3, dtype=torch.float64), torch.rand(4, dtype=torch.float64)
    values = torch.from_numpy(octree.values).double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v: reference.loss(octree, v, o, d, target, weight, options)[0],
        (values,),
        eps=1e-6,
        atol=1e-6,
        fast_mode=True,
    )


@pytest.mark.parametrize("density, colour", [(0.7, 0.0), (0.0, 0.3), (0.2, 0.5)])
def test_roughness_of_a_ramp(density, colour):
    """Raw density and red rise along x by the same in each of four leaves: four of twelve edges differ, in each leaf that
    the ray crosses whole. Another ray crosses one leaf from corner to corner: the way counts in sides of the leaf."""
    grid = np.argwhere(np.ones((4, 4, 4)))
    octree = Octree.from_leaves(np.full(64, 2), grid, (0, 0, 0), 2.0, 0, 0.01)
    x = octree.vertex_positions()[:, 0]
    octree.density, red = 5.0 * x, np.zeros((len(x), 3, 1))
    red[:, 0, 0] = 0.3 * x
    octree.sh = red
    d_raw, d_red = 5.0 * 0.5, 0.3 * 0.5
    edges = 4 * (density * (d_raw - math.log(1 + d_raw)) + colour * (d_red - 0.1 * math.log(1 + d_red / 0.1)))
    o, d = rays64([[-1, 0.3, 0.3], [2.5, 2.5, 2.5]], [[1, 0, 0], -np.ones(3) / math.sqrt(3)])
    values, target = torch.from_numpy(octree.values).double(), torch.zeros(2, 3, dtype=torch.float64)
    weight = torch.tensor([0.5, 2.0], dtype=torch.float64)
    smooth, plain = (
        reference.loss(octree, values, o, d, target, weight, ops.LossOptions(**terms, early_stop_eps=0.0))[0].item()
        for terms in ({"tv_density": density, "tv_sh": colour}, {})
    )
    assert smooth - plain == pytest.approx((0.5 * 4 + 2.0 * 4 * math.sqrt(3)) * edges, rel=1e-6)


def test_a_homogeneous_slab_is_exp_minus_sigma_l_however_it_is_cut():
    """Leaves of three levels, one density: the segments of a ray add up to the slab, so T = exp(-sigma L) exactly."""
    octree = Octree.from_leaves(np.ones(8, int), np.argwhere(np.ones((2, 2, 2))), (0, 0, 0), 2.0, 0, 0.7)
    octree = octree.subdivide([True, False] * 4)[0]
    octree = octree.subdivide(np.arange(octree.n_leaves) % 3 == 0)[0]
    sigma = 1.3
    octree.density = explin_inverse(np.array(sigma / 0.7))
    sigma = 0.7 * float(reference.explin(torch.from_numpy(octree.density.astype(np.float64)))[0])
    rng = np.random.default_rng(0)
    through, entry = rng.uniform(0.05, 0.95, (2, 50, 3)) * 2
    entry[:, 0] = 0
    through[:, 0] = 2
    d = (through - entry) / np.linalg.norm(through - entry, axis=1, keepdims=True)
    o = entry - 0.8 * d
    values = torch.from_numpy(octree.values).double()
    rgb, trans, depth = reference.render(octree, values, *rays64(o, d), torch.ones(3, dtype=torch.float64), 0.0)
    length = np.linalg.norm(through - entry, axis=1)
    assert np.abs(trans.numpy() - np.exp(-sigma * length)).max() < 1e-14
    assert np.abs(rgb.numpy() - (0.5 + 0.5 * np.exp(-sigma * length))[:, None]).max() < 1e-14
    samples = reference.sample(octree, values, *rays64(o, d))
    median = reference.median_depth(octree, samples, 50).numpy()
    expected = np.where(sigma * length > math.log(2), 0.8 + math.log(2) / sigma, 0)
    assert np.abs(median - expected).max() < 1e-13
    assert (expected > 0).any() and depth.max() < 4


def test_the_normal_points_out_of_dense_matter():
    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), (-1, -1, -1), 2.0, 0, 5.0)
    outward = np.array([2.0, -1.0, 2.0]) / 3
    octree.density = 2 - 2 * octree.vertex_positions() @ outward
    o, d = np.array([[0.1, -0.2, 0.3]]) + 4 * outward, -outward[None]
    values = torch.from_numpy(octree.values).double()
    normal = reference.normals(octree, values, *rays64(o, d), 0.0)
    _, trans, _ = reference.render(octree, values, *rays64(o, d), torch.ones(3, dtype=torch.float64), 0.0)
    assert np.abs(normal.numpy() - (1 - trans.numpy()) * outward).max() < 1e-6  # values are float32


def test_a_ray_that_starts_inside_sees_only_what_lies_ahead():
    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), (-1, -1, -1), 2.0, 0, 1.0)
    octree.density = 1.0  # sigma = 1
    o, d = np.array([[0.25, 0.1, -0.2]] * 2), np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    values = torch.from_numpy(octree.values).double()
    _, trans, _ = reference.render(octree, values, *rays64(o, d), torch.ones(3, dtype=torch.float64), 0.0)
    assert trans.tolist() == pytest.approx([math.exp(-0.75), math.exp(-1.25)], abs=1e-14)


@pytest.mark.parametrize("eps", [1e-3, 0.05, 0.5])
def test_early_stop_moves_a_colour_by_less_than_eps(eps):
    rng = np.random.default_rng(1)
    octree = random_octree("mixed", 0, rng, strength=20.0)
    octree.sh = rng.uniform(-1, 1, octree.sh.shape) * 0.5 / 0.2821  # colours in [0, 1]: their range is 1
    o, d = camera_tiles(octree, rng, 4)
    o, d = rays64(o.repeat(64, 0), d)
    values, white = torch.from_numpy(octree.values).double(), torch.ones(3, dtype=torch.float64)
    exact, stopped = (reference.render(octree, values, o, d, white, e) for e in (0.0, eps))
    change = (exact[0] - stopped[0]).abs().max(1).values
    assert 0 < change.max() < eps
    shortened = stopped[1] > exact[1] + 1e-12
    assert shortened.sum() > 20
    assert (stopped[1][shortened] < eps).all()  # the segment in which T fell below eps is kept


def test_distortion_is_the_double_sum():
    w, m = torch.tensor([0.2, 0.5, 0.1, 1.0]), torch.tensor([1.0, 2.0, 4.0, 3.0])
    length, ray = torch.tensor([0.3, 0.6, 0.9, 1.5]), torch.tensor([0, 0, 0, 2])
    first = 2 * (0.2 * 0.5 * 1 + 0.2 * 0.1 * 3 + 0.5 * 0.1 * 2) + (0.04 * 0.3 + 0.25 * 0.6 + 0.01 * 0.9) / 3
    expected = [first, 0.0, 0.5]
    assert reference.distortion(w, m, length, ray, 3).tolist() == pytest.approx(expected, rel=1e-6)


def test_directions_are_taken_as_they_are():
    """Unit length is the caller's duty: a direction of length 2 halves every distance and so the optical depth."""
    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), (-1, -1, -1), 2.0, 0, 1.0)
    octree.density = 1.0
    o, d = np.array([[-2, 0.3, 0.3]] * 2, np.float32), np.concatenate([unit([[1, 0, 0]]), [[2, 0, 0]]])
    opacity = ops.render_rays(octree, o, d.astype(np.float32), early_stop_eps=0.0)["opacity"]
    assert opacity.tolist() == pytest.approx([1 - math.exp(-2), 1 - math.exp(-1)], rel=1e-6)
