"""Steps of the compiled field: Adam, the same bits for any number of threads and rays of any number, extremes."""

import copy
import dataclasses

import numpy as np
import pytest

from nerfvol.kernels import field_ops, field_reference, ops
from nerfvol.kernels.field_ops import FieldLoss, FieldRates, FieldState
from tests.kernels import fields

RATES = FieldRates(0.01, table_decay=1e-2, network_decay=1e-3)


def assert_same_bits(a: FieldState, b: FieldState) -> None:
    for name in (*FieldState.ARRAYS, "updates"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def trained(n_rays: int = 700, steps: int = 4, resume_at: int | None = None) -> tuple[FieldState, list]:
    """Enough rays for several chunks a group; levels move in turns, small gradients play roulette."""
    state, reports = fields.field(fields.SHAPES["default"]), []
    march = fields.scattered(share=0.2)
    for k in range(steps):
        if k == resume_at:
            saved = copy.deepcopy(state.arrays())
            state = FieldState(state.domain, state.shape, seed=9)
            state.load_arrays(saved)
        moves = [level < 3 or k % 2 == 1 for level in range(state.n_levels)]
        state.use_levels(5 if k == 0 else state.n_levels)
        terms = dataclasses.replace(fields.ALL_TERMS, negligible=0.5)
        reports.append(field_ops.train_step(state, fields.rays(n_rays, seed=k), march, terms, RATES, moves))
    return state, reports


def test_the_same_bits_for_any_number_of_threads(isa, threads):
    """More threads than levels too: then levels are cut into slices."""
    runs = []
    for n in (1, 2, 3, 20):
        threads(n)
        assert ops.get_threads() == n
        runs.append(trained())
    runs.append(trained(resume_at=3))
    for other in runs[1:]:
        assert_same_bits(runs[0][0], other[0])
        assert runs[0][1] == other[1]


@pytest.mark.parametrize("name", ["default", "degree 2", "frequencies"])
def test_steps_are_the_twins(isa, name):
    """Three steps from moments that are not zero: values, moments and counts, what was touched and what was not."""
    ours = fields.field(fields.SHAPES[name])
    rng = np.random.default_rng(7)
    for which in ("table", "network"):
        getattr(ours, which + "_first")[...] = rng.normal(size=getattr(ours, which).shape) * 1e-3
        getattr(ours, which + "_second")[...] = rng.random(getattr(ours, which).shape) * 1e-4
    ours.updates[...] = 5
    twin = FieldState(ours.domain, ours.shape)
    twin.load_arrays(ours.arrays())
    march, before = fields.scattered(share=0.05), ours.table.copy()
    rates = dataclasses.replace(RATES, eps=1e-6)
    for k in range(3):
        moves = [level % 2 == k % 2 for level in range(ours.n_levels)]
        for operators, state in ((field_ops, ours), (field_reference, twin)):
            operators.train_step(state, fields.rays(20, seed=k), march, fields.ALL_TERMS, rates, moves)
    assert np.array_equal(ours.updates, twin.updates)
    for name in FieldState.ARRAYS:
        if name == "network_gradient":
            continue
        a, b = getattr(ours, name), getattr(twin, name)
        # A step is at most a rate's size however small the gradient; gradients agree to 1e-4 of the largest.
        assert np.abs(a - b).max(initial=0) <= 1e-4 * max(np.abs(b).max(initial=0), 1e-12), name
    if ours.n_levels:
        untouched = (ours.table == before).mean()
        assert 0.01 < untouched < 0.999


@pytest.mark.parametrize("n_rays", [1, 2, 15, 16, 17, 31, 32, 33, 63, 64, 65, 127, 129, 2049])
def test_rays_of_any_number(isa, n_rays):
    """A step's gradient is the mean over its rays, however they fall into chunks, packets and blocks."""
    state, batch, march = fields.field(fields.HASHED), fields.rays(n_rays), fields.everywhere(n_steps=8)
    options = dataclasses.replace(fields.ALL_TERMS, early_stop_eps=0.0)
    table, network, report = field_ops.loss_gradient(state, batch, march, options)
    halves = [slice(0, n_rays // 2), slice(n_rays // 2, n_rays)]
    sums = [np.zeros_like(table, dtype=float), np.zeros_like(network, dtype=float), 0.0]
    for half in halves:
        part = field_ops.FieldBatch(*(getattr(batch, f.name)[half] for f in dataclasses.fields(batch)))
        if not len(part.jitter):
            continue
        share = len(part.jitter) / n_rays
        for i, g in enumerate(field_ops.loss_gradient(state, part, march, options)):
            sums[i] = sums[i] + share * (g.loss if i == 2 else g)
    for mine, both in ((table, sums[0]), (network, sums[1])):
        assert np.isfinite(mine).all()
        assert np.abs(mine - both).max() <= 1e-5 * np.abs(both).max()
    assert report.loss == pytest.approx(sums[2], rel=1e-5)


@pytest.mark.parametrize("n_samples", range(1, 33))
def test_samples_of_any_number(compiled, n_samples):
    """One ray with so many samples: what fills the last packets has no part in anything (padding, stale rows)."""
    state, march = fields.field(fields.HASHED), fields.everywhere(n_steps=120)
    options = dataclasses.replace(fields.ALL_TERMS, early_stop_eps=0.0)
    # A ray that cuts an edge of the cube, so far in that it has this many steps of 1/120 diagonal.
    length = n_samples * 2 * np.sqrt(3) * state.domain.half / 120
    d = np.array([[1, 1, 0]]) / np.sqrt(2)
    corner = np.asarray(state.domain.center) + state.domain.half * np.array([1, -1, 0.123])
    o = corner + np.array([[-1, 1, 0]]) / np.sqrt(2) * length / 2 - 5 * d
    batch = field_ops.FieldBatch(*(a.astype(np.float32) for a in (o, d, np.full((1, 3), 0.3), np.full(1, 0.5))))
    assert field_ops.march_rays(state, batch, march).sum() == n_samples
    trash = fields.rays(300, seed=8)
    field_ops.loss_gradient(state, trash, march, options)  # leaves its numbers in memory that is used again
    table, network, report = field_ops.loss_gradient(state, batch, march, options)
    twin = field_reference.loss_gradient(state, batch, march, options)
    for mine, theirs in ((table, twin[0].numpy()), (network, twin[1].numpy())):
        assert np.abs(mine - theirs).max() <= 1e-4 * np.abs(theirs).max()


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-6, 1.0, 1e2, 1e6, 1e15])
@pytest.mark.parametrize("density", ["exp", "softplus"])
def test_numbers_stay_finite(isa, scale, density):
    """Raw densities and colours of any magnitude: the loss, the gradients and what a step makes of them are finite."""
    state = fields.field(dataclasses.replace(fields.HASHED, density=density))
    state.table *= scale
    options = dataclasses.replace(fields.ALL_TERMS, colour=0.0, distortion=0.1)
    march = fields.everywhere(n_steps=48)
    table, network, report = field_ops.loss_gradient(state, fields.rays(40), march, options)
    if scale <= 1e2:
        assert np.isfinite(report.loss)
    finite = np.isfinite(table).all() and np.isfinite(network).all()
    assert finite or scale > 1e6
    out = field_ops.render_rays(state, fields.rays(40).rays_o, fields.rays(40).rays_d, march, (1, 1, 1))
    assert np.isfinite(out["opacity"]).all() and (out["opacity"] >= 0).all() and (out["opacity"] <= 1).all()


def test_the_roulette_expects_the_gradient(compiled):
    """The mean of many draws, which differ, is the gradient. The draws are by the jitter of each range's first ray, which here
    meets nothing."""
    state, march = fields.field(fields.HASHED), fields.everywhere()
    batch = fields.rays(80, seed=1)
    batch.rays_o[::5] += 1000
    exact = np.concatenate([g.ravel() for g in field_ops.loss_gradient(state, batch, march, fields.ALL_TERMS)[:2]])
    terms, draws = dataclasses.replace(fields.ALL_TERMS, negligible=1.0), []
    rng = np.random.default_rng(5)
    for _ in range(100):
        batch.jitter[::5] = rng.random(16)
        table, network, _ = field_ops.loss_gradient(state, batch, march, terms)
        draws.append(np.concatenate([table.ravel(), network.ravel()]))
    error, spread = np.mean(draws, 0) - exact, np.std(draws, 0) / np.sqrt(len(draws))
    # The network's sums over all samples are nearly normal, entries that few draws reach are not: those are judged together.
    n = state.network.size
    assert (np.abs(error[-n:]) <= 5 * spread[-n:] + 1e-6 * np.abs(exact[-n:]).max()).all()
    assert np.linalg.norm(error) < 3 * np.linalg.norm(spread)
    assert np.linalg.norm(spread) > 1e-3 * np.linalg.norm(exact)  # rounding alone: 1e-7


@pytest.mark.parametrize("levels", [0, 1, 3])
def test_levels_that_are_not_in_use(isa, levels):
    """As if their entries were zero, but they keep their values, moments and counts."""
    state = fields.field(fields.SHAPES["default"])
    march, batch = fields.everywhere(), fields.rays(50)
    zeroed = FieldState(state.domain, state.shape)
    zeroed.load_arrays(state.arrays())
    assert state.levels is not None
    zeroed.table[state.levels.starts[levels] :] = 0
    state.use_levels(levels)
    points = batch.rays_o + batch.rays_d
    for mine, theirs in zip(field_ops.evaluate(state, points), field_ops.evaluate(zeroed, points), strict=True):
        assert np.array_equal(mine, theirs)
    before = state.table.copy()
    reports = [field_ops.train_step(s, batch, march, fields.ALL_TERMS, RATES) for s in (state, zeroed)]
    assert reports[0] == reports[1]
    split = state.levels.starts[levels]
    assert np.array_equal(state.network, zeroed.network) and np.array_equal(state.table[:split], zeroed.table[:split])
    assert np.array_equal(state.table[split:], before[split:]) and not state.table_second[split:].any()
    assert (state.updates[:-1] == (np.arange(state.n_levels) < levels)).all() and state.updates[-1] == 1
    with pytest.raises(ValueError, match="more levels"):
        state.use_levels(state.n_levels + 1)


def test_moments_of_the_untouched_stay(compiled):
    """An entry without a gradient keeps value and moments, whatever its decay; one with a gradient decays."""
    state, march = fields.field(fields.HASHED), fields.scattered(share=0.02)
    state.table_first[...], state.table_second[...] = 0.5, 0.25
    table, _, _ = field_ops.loss_gradient(state, fields.rays(5), march, fields.ALL_TERMS)
    before = {name: getattr(state, name).copy() for name in ("table", "table_first", "table_second")}
    field_ops.train_step(state, fields.rays(5), march, fields.ALL_TERMS, RATES)
    touched = table != 0
    assert 0 < touched.mean() < 0.9
    for name, old in before.items():
        assert np.array_equal((getattr(state, name) != old), touched), name


@pytest.mark.parametrize(
    "change,message",
    [({"loss": FieldLoss(colour=-1)}, "not negative"), ({"loss": FieldLoss(background=(1, 1))}, "background"),
     ({"rates": FieldRates(rate=float("nan"))}, "finite"), ({"rates": FieldRates(beta2=1.0)}, "beta2"),
     ({"moves": [True]}, "moves"), ({"loss": FieldLoss(early_stop_eps=1.0)}, "early_stop_eps")],
)  # fmt: skip
def test_refuses_what_does_not_fit(compiled, change, message):
    state = fields.field(fields.HASHED)
    given = {"batch": fields.rays(4), "march": fields.everywhere(), "loss": FieldLoss(), "rates": FieldRates()} | change
    with pytest.raises(ValueError, match=message):
        field_ops.train_step(state, **given)


def test_refuses_arrays_of_another_field(compiled):
    state, other = fields.field(fields.HASHED), fields.field(fields.SHAPES["wide"])
    with pytest.raises(ValueError, match="network must be"):
        state.load_arrays(other.arrays())
    with pytest.raises(ValueError, match="rays_d must be"):
        field_ops.render_rays(state, np.zeros((3, 3)), np.zeros((2, 3)), fields.everywhere(), (1, 1, 1))
    with pytest.raises(ValueError, match="viewdirs"):
        field_ops.evaluate(fields.field(fields.SHAPES["rgb"]), np.zeros((3, 3)))
