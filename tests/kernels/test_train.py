"""The training step: gradient of the loss, optimiser, statistics of the leaves, against the float64 reference."""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from nerfvol.kernels import on_torch, ops, reference
from nerfvol.kernels.tree import kernel_options
from nerfvol.native import native
from nerfvol.octree.rows import sh_slots
from nerfvol.octree.tree import Octree
from tests.fixtures.random_octrees import unit
from tests.kernels import rounding
from tests.kernels.test_ops import Case, assert_within, build, per_ray, traced

U = rounding.U
BACKGROUND = (1.0, 0.8, 0.3)
LOSSES = {
    "plain": ops.LossOptions(BACKGROUND, early_stop_eps=0.0),
    "colour": ops.LossOptions(BACKGROUND, colour=0.3, early_stop_eps=0.0),
    "distortion": ops.LossOptions(BACKGROUND, distortion=0.5, early_stop_eps=0.0),
    "sparse": ops.LossOptions(BACKGROUND, sparsity=0.05, early_stop_eps=0.0),
    "smooth": ops.LossOptions(BACKGROUND, tv_sh=0.1, early_stop_eps=0.0),
    "all": ops.LossOptions(
        BACKGROUND, colour=0.1, distortion=0.2, sparsity=0.01, tv_density=0.003, tv_sh=0.02, early_stop_eps=0.0
    ),
}
PIXEL_ANGLE = 0.01


@functools.cache
def batch_of(case: Case) -> ops.Batch:
    """Random targets and weights, among them rays of weight 0 (padding)."""
    _, o, d = build(case)
    rng = np.random.default_rng(case.seed + 7)
    weight = rng.uniform(0.2, 1.0, len(d)) * (rng.random(len(d)) < 0.9) / len(d)
    return ops.Batch(o, d, rng.random((len(d), 3)).astype(np.float32), weight.astype(np.float32))


@functools.cache
def true_loss_gradient(case: Case, loss: str) -> np.ndarray:
    octree = build(case)[0]
    return on_torch.loss_gradient(
        octree, torch.from_numpy(octree.values).double(), batch_of(case), LOSSES[loss]
    ).numpy()


def loss_bound(case: Case, loss: str) -> np.ndarray:
    """rounding.gradient_bounds with the loss's own cotangents: g = 2 weight (C - target) and the terms of q."""
    octree, options, batch, t = build(case)[0], LOSSES[loss], batch_of(case), traced(case)
    target, weight = batch.target.astype(np.float64), batch.weight.astype(np.float64)
    n = len(weight)
    final = np.exp(-rounding.per_ray(t, t.tau))
    image = rounding.per_ray(t, t.weight[:, None] * t.colour) + final[:, None] * BACKGROUND
    d_image = rounding.image_bounds(t, octree, BACKGROUND)["rgb"]
    g, d_g = 2 * weight[:, None] * np.abs(image - target), 2 * weight[:, None] * d_image
    away = np.abs(t.colour - target[t.ray])
    pull = options.colour * weight[t.ray, None]
    g_hit, d_g_hit = g[t.ray] + 2 * pull * away, d_g[t.ray] + 2 * pull * t.d_colour + 8 * U * g[t.ray]
    middle = t.middle / octree.size
    farthest = np.zeros(n)
    np.maximum.at(farthest, t.ray, (t.far - t.near) / octree.size + middle)
    spread = options.distortion * weight * 2 * farthest  # |dL/dw| of the distortion loss: every m - m' is below this
    share = (g[t.ray] * np.abs(t.colour) + pull * away**2).sum(1) + spread[t.ray]
    d_share = (d_g[t.ray] * np.abs(t.colour) + g[t.ray] * t.d_colour + 2 * pull * away * t.d_colour).sum(1)
    # The moments in front and behind are sums and differences of up to `hits` numbers no larger than `farthest`.
    moments = 4 * (t.d_total + (t.hits + 4) * 4 * U)
    d_share += spread[t.ray] * moments[t.ray] + options.distortion * weight[t.ray] * 4 * t.d_middle / octree.size
    # dL/dw of the sparsity falls as w grows.
    falling = options.sparsity * weight[t.ray] / (reference.SPARSE_KNEE + t.weight)
    share += falling
    d_share += falling * (rounding.weight_bounds(t) / (reference.SPARSE_KNEE + t.weight) + 4 * U)
    q = np.abs(g @ np.array(BACKGROUND)) + options.colour * weight * ((BACKGROUND - target) ** 2).sum(1)
    d_q = 8 * U * q + d_g @ np.abs(BACKGROUND)
    np.maximum.at(q, t.ray, share)
    np.maximum.at(d_q, t.ray, d_share)
    smooth = rounding.roughness_bounds(t, octree, weight, options.tv_density, options.tv_sh)
    return rounding.gradient_bounds(t, octree, g_hit, q, d_g_hit, d_q) + smooth


def kernel_loss_gradient(case: Case, options: ops.LossOptions) -> np.ndarray:
    octree = build(case)[0]
    return on_torch.loss_gradient(octree, torch.from_numpy(octree.values), batch_of(case), options).numpy()


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradient_of_the_loss(isa, degree, loss):
    case = Case("mixed", degree, 200 + degree, "odd" if degree % 2 else "dyadic", n=3, distance=(0.8, 1.3))
    ours, theirs = kernel_loss_gradient(case, LOSSES[loss]), true_loss_gradient(case, loss)
    bound = loss_bound(case, loss)
    assert_within("gradient", ours, theirs, bound)
    assert np.linalg.norm(bound) < 0.1 * np.linalg.norm(theirs)


@pytest.mark.parametrize("term", ["colour", "distortion", "sparse", "smooth"])
def test_each_term_of_the_loss_has_a_gradient_that_the_bounds_would_miss_if_it_were_lost(term):
    case = Case("mixed", 1, 201, "odd", n=3, distance=(0.8, 1.3))
    lost = np.abs(true_loss_gradient(case, term) - true_loss_gradient(case, "plain"))
    assert (lost > 4 * loss_bound(case, term)).sum() > 50


def test_rays_of_weight_zero_are_not_there(isa):
    case = Case("mixed", 1, 203, n=2)
    octree, batch = build(case)[0], batch_of(case)
    blind = batch.weight == 0
    assert 5 < blind.sum() < len(blind) - 5
    elsewhere = np.where(blind[:, None], 77.0, batch.target).astype(np.float32)
    other = ops.Batch(batch.rays_o, batch.rays_d, elsewhere, batch.weight)
    values = torch.from_numpy(octree.values)
    a, b = (on_torch.loss_gradient(octree, values, x, LOSSES["all"]) for x in (batch, other))
    assert torch.equal(a, b)
    nothing = ops.Batch(batch.rays_o, batch.rays_d, batch.target, np.zeros_like(batch.weight))
    assert not on_torch.loss_gradient(octree, values, nothing, LOSSES["all"]).any()


# ------------------------------------------------------------------ the optimiser
RATES = ops.Rates(density=0.1, dc=0.03, sh=0.004, beta=0.9, eps=1e-8)


def copy_of(octree: Octree) -> Octree:
    twin = octree.with_sh_degree(octree.sh_degree)
    twin.values = octree.values.copy()
    return twin


def rates_of(octree: Octree) -> np.ndarray:
    row = np.zeros(octree.values.shape[1])
    slots = sh_slots(octree.sh_degree)
    row[slots] = RATES.sh
    row[slots[:, 0]] = RATES.dc
    row[12] = RATES.density
    return row


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_steps_of_the_optimiser(isa, degree):
    """value -= rate g / (sqrt(m) + eps), m = beta m + (1 - beta) g^2 or g^2 at first, at touched vertices alone.

    The gradient is the kernel's own (its sums are the same, bit by bit), so only the update's handful of float32
    operations remains: 8 u of each result's terms.
    """
    case = Case("mixed", degree, 210 + degree, n=3)
    octree, batch = copy_of(build(case)[0]), batch_of(case)
    state = ops.TrainState(octree)
    rate = rates_of(octree)
    touched = np.zeros(octree.n_vertices, bool)
    touched[octree.corners[traced(case).leaf[batch.weight[traced(case).ray] > 0]]] = True
    for _ in range(3):
        values = torch.from_numpy(octree.values.copy())
        g = on_torch.loss_gradient(octree, values, batch, LOSSES["all"]).numpy().astype(float)
        before, moments = octree.values.astype(float), state.moments.astype(float)
        ops.train_step(octree, state, batch, LOSSES["all"], RATES, PIXEL_ANGLE)
        m = np.where(moments > 0, RATES.beta * moments + (1 - RATES.beta) * g * g, g * g)
        change = rate * g / (np.sqrt(m) + RATES.eps)
        moved = np.abs(g) > 1e-15  # g^2 below that is no normal float32
        assert (np.abs(state.moments - m)[moved] <= 8 * U * m[moved]).all()
        error = np.abs(octree.values - (before - change))
        assert (error <= 8 * U * (np.abs(before) + np.abs(change)))[moved].all()
        assert np.array_equal(octree.values[~touched], before[~touched].astype(np.float32))
        assert (np.abs(change)[moved] > 0).sum() > 1000
    assert (state.slots == -1).all()


def test_a_step_against_the_reference_step(isa, monkeypatch):
    """Both implementations of the whole step. The first step of RMSprop moves by rate x sign(g): only entries whose
    gradient exceeds the bound on its error have a sign to compare."""
    case = Case("mixed", 1, 221, n=3, distance=(0.8, 1.3))
    ours, theirs, batch = copy_of(build(case)[0]), copy_of(build(case)[0]), batch_of(case)
    a, b = ops.TrainState(ours), ops.TrainState(theirs)
    report_a = ops.train_step(ours, a, batch, LOSSES["all"], RATES, PIXEL_ANGLE)
    monkeypatch.setattr(ops, "native", lambda: None)
    report_b = ops.train_step(theirs, b, batch, LOSSES["all"], RATES, PIXEL_ANGLE)
    monkeypatch.undo()
    certain = np.abs(true_loss_gradient(case, "all")) > 4 * loss_bound(case, "all")
    assert certain.sum() > 500
    assert np.abs(ours.values - theirs.values)[certain].max() < 1e-4 * RATES.density
    assert report_a.squared_error == pytest.approx(report_b.squared_error, rel=1e-5)
    assert report_a.samples == pytest.approx(report_b.samples, rel=1e-3)  # a segment of no length may be missed
    t = traced(case)
    slack = 10 * np.median(t.d_total)
    assert np.abs(a.max_weight - b.max_weight).max() < slack
    assert np.abs(a.error - b.error).max() < slack * b.error.max()
    seen = b.max_weight > 1e-4
    assert seen.sum() > 50 and np.abs(a.footprint / np.maximum(b.footprint, 1e-9) - 1)[seen].max() < 1e-3


def test_statistics_of_the_leaves(isa):
    """Largest weight, sum of weight x squared error, largest size in pixels of each leaf, from the float64 segments."""
    case = Case("mixed", 1, 230, n=3)
    octree, batch, t = copy_of(build(case)[0]), batch_of(case), traced(case)
    state = ops.LeafStatistics(octree)
    for _ in range(2):  # the maxima stay, the errors add up
        report = ops.leaf_statistics(octree, batch, LOSSES["plain"], PIXEL_ANGLE, state)
    live = batch.weight[t.ray] > 0
    ray, leaf, w = t.ray[live], t.leaf[live], t.weight[live]
    n = octree.n_leaves
    rgb = rounding.per_ray(t, t.weight[:, None] * t.colour) + np.exp(-rounding.per_ray(t, t.tau))[:, None] * BACKGROUND
    squared = batch.weight * ((rgb - batch.target) ** 2).sum(1)
    largest, size = np.zeros(n), np.zeros(n)
    np.maximum.at(largest, leaf, w)
    np.maximum.at(size, leaf, octree.leaf_sizes()[leaf] / (t.middle[live] * PIXEL_ANGLE))
    error = np.bincount(leaf, w * squared[ray], n)
    slack = 10 * np.median(t.d_total)
    assert np.abs(state.max_weight - largest).max() < slack
    assert np.abs(state.error - 2 * error).max() < slack * error.max()
    seen = largest > 1e-4
    assert np.abs(state.footprint / np.maximum(size, 1e-9) - 1)[seen].max() < 1e-3
    assert not state.max_weight[np.setdiff1d(np.arange(n), np.concatenate([leaf, t.ghost_leaf]))].any()
    assert report.squared_error == pytest.approx(squared.sum() / (3 * batch.weight.sum()), rel=1e-5)
    assert report.samples == pytest.approx(len(ray) / len(batch.weight), rel=1e-3)
    state.reset_statistics(n)
    assert not state.error.any() and not state.max_weight.any() and not state.footprint.any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("compiled", [True, False])
def test_statistics_alone_are_those_of_a_step(isa, degree, compiled, monkeypatch):
    """Bit by bit, and the query moves nothing: neither values nor what a state keeps besides its statistics."""
    case = Case("mixed", degree, 233, n=3)
    octree, batch = copy_of(build(case)[0]), batch_of(case)
    octree.prefiltered = kept = object()
    if not compiled:
        monkeypatch.setattr(ops, "native", lambda: None)
    alone, state = ops.TrainState(octree), ops.TrainState(octree)
    alone.moments[:] = 0.5
    values = octree.values.copy()
    first = ops.leaf_statistics(octree, batch, LOSSES["all"], PIXEL_ANGLE, alone)
    assert np.array_equal(octree.values, values) and octree.prefiltered is kept
    assert (alone.moments == 0.5).all() and (alone.slots == -1).all()
    assert first == ops.train_step(octree, state, batch, LOSSES["all"], RATES, PIXEL_ANGLE)
    for name in ("max_weight", "error", "footprint"):
        assert np.array_equal(getattr(alone, name), getattr(state, name)) and getattr(alone, name).any(), name


def test_options_reach_the_kernels_by_their_names():
    """Every field of the Python classes, with a number of its own, and none that the kernels have besides them."""
    if (compiled := native()) is None:
        pytest.skip("no compiled kernels")
    options = ops.LossOptions((0.5, 0.25, 0.125), *(np.arange(1, 5) / 8), early_stop_eps=0.75)
    rates = ops.Rates(*(np.arange(1, 6) / 8))
    for given, kind in ((options, compiled.LossOptions), (rates, compiled.Rates)):
        there = kernel_options(given)
        names = {name for name in dir(kind) if not name.startswith("_")}
        assert type(there) is kind and names == {field.name for field in dataclasses.fields(given)}
        for name in names:
            assert np.array_equal(getattr(there, name), getattr(given, name)), name


def test_memory_between_steps_does_not_grow_with_the_degrees_seen(threads):
    """One arena for each thread, whatever the degree: after small rows, large rows take what they take alone."""
    if native() is None:
        pytest.skip("no compiled kernels")
    threads(1)

    def step(degree: int) -> int:
        octree, o, d = build(Case("mixed", degree, 260, n=40))
        octree = copy_of(octree)
        batch = ops.Batch(o, d, np.zeros((len(d), 3), np.float32), np.ones(len(d), np.float32))
        ops.train_step(octree, ops.TrainState(octree), batch, LOSSES["all"], RATES, PIXEL_ANGLE)
        return ops.arena_bytes()

    ops.release_arenas()
    assert ops.arena_bytes() == 0
    alone = step(3)
    ops.release_arenas()
    seen = [step(degree) for degree in (1, 2, 3, 1, 3)]
    assert 0 < seen[0] <= seen[1] <= seen[2] == seen[3] == seen[4] == alone


@pytest.mark.parametrize("origin, way, first_cell, crossed", [
    ((-1, -1, -1), (1, 1, 1), (0, 0, 0), 4),  # the cube's diagonal, through vertices
    ((2, 2, 2), (-1, -1, -1), (1, 1, 1), 2),  # the same from its middle
    ((-1, 5, 1.5), (1, -1, 0), (0, 3, 1), 4),  # a face's diagonal, through edges
])  # fmt: skip
def test_a_box_touched_in_a_point_or_an_edge_is_not_hit(isa, origin, way, first_cell, crossed):
    """A diagonal of 4 x 4 x 4 cells crosses some and touches their neighbours.

    Everything is dyadic, so the distances of the planes that meet there are equal numbers and a touch has no length: it
    counts as no sample, and the second moments at the touched cells' own vertices do not decay.
    """
    octree = Octree.from_leaves(np.full(64, 2), np.argwhere(np.ones((4, 4, 4))), (0, 0, 0), 4.0, 0, 1.0)
    state = ops.TrainState(octree)
    state.moments[:] = 1
    ray = np.array([origin], np.float32), unit([way])
    batch = ops.Batch(*ray, np.zeros((1, 3), np.float32), np.ones(1, np.float32))
    report = ops.train_step(octree, state, batch, LOSSES["plain"], ops.Rates(0, 0, 0), PIXEL_ANGLE)
    leaves = octree.query([np.array(first_cell) + 0.5 + k * np.array(way) for k in range(crossed)])
    assert report.samples == crossed
    assert np.array_equal(np.flatnonzero((state.moments != 1).any(1)), np.unique(octree.corners[leaves]))


def test_training_descends(isa):
    """Sixty steps towards the pictures of another octree of the same shape: the error falls to a tenth."""
    case = Case("mixed", 1, 240, strength=6.0, n=12)
    goal, o, d = build(case)
    octree = copy_of(goal)
    octree.density, octree.sh = -1.0, 0.0
    target = ops.render_rays(goal, o, d, BACKGROUND, 0.0)["rgb"]
    batch = ops.Batch(o, d, target, np.full(len(d), 1 / len(d), np.float32))
    state, options = ops.TrainState(octree), ops.LossOptions(BACKGROUND)
    errors = [ops.train_step(octree, state, batch, options, RATES, PIXEL_ANGLE).squared_error for _ in range(60)]
    assert errors[-1] < 0.1 * errors[0]


def test_the_loss_is_what_it_says():
    """reference.loss term by term against the formulas, ray by ray in numpy."""
    case = Case("mixed", 1, 250, n=1)
    octree, o, d = build(case)
    batch, options = batch_of(case), LOSSES["all"]
    as64 = lambda a: torch.from_numpy(a).double()  # noqa: E731
    o = per_ray(o, len(d))
    total, _ = reference.loss(
        octree, as64(octree.values), as64(o), as64(d), as64(batch.target), as64(batch.weight), options
    )
    t, expected = traced(case), 0.0
    corners = octree.values.astype(float)[octree.corners[t.leaf]]
    slots = sh_slots(octree.sh_degree).flatten()
    edges = [(a, b) for a in range(8) for b in range(a) if (a ^ b) in (1, 2, 4)]
    sides = (t.far - t.near) / octree.leaf_sizes()[t.leaf]
    for ray in range(len(d)):
        mine = t.ray == ray
        w, c, m = t.weight[mine], t.colour[mine], t.middle[mine] / octree.size
        length, final = (t.far - t.near)[mine] / octree.size, np.exp(-t.tau[mine].sum())
        target = batch.target[ray].astype(float)
        term = ((w @ c + final * np.array(BACKGROUND) - target) ** 2).sum()
        term += options.colour * (w @ ((c - target) ** 2).sum(1) + final * ((BACKGROUND - target) ** 2).sum())
        pairs = sum(w[i] * w[j] * abs(m[i] - m[j]) for i in range(len(w)) for j in range(len(w)))
        term += options.distortion * (pairs + (w * w * length).sum() / 3)
        term += options.sparsity * np.log(1 + w / 0.02).sum()
        for i in np.flatnonzero(mine):
            for a, b in edges:
                away = np.abs(corners[i, a] - corners[i, b])
                term += options.tv_density * sides[i] * (away[12] - np.log(1 + away[12]))
                term += options.tv_sh * sides[i] * (away[slots] - 0.1 * np.log(1 + away[slots] / 0.1)).sum()
        expected += batch.weight[ray] * term
    assert float(total) == pytest.approx(expected, rel=1e-12)
