"""The training step: Adam, statistics, masks, edges, the path without compiled kernels."""

import dataclasses

import numpy as np
import pytest

from nerfvol.kernels import splat_on_torch, splat_ops, splat_reference, splat_state
from nerfvol.kernels.splat_reference import Parameters
from nerfvol.splats import packing
from tests.splats.scenes import BACKGROUND, random_image, random_splats, straight_view, view_of_cube

OPTIONS = splat_ops.SplatOptions(BACKGROUND, 0.5, 0.7, 0.3, 0.02, 0.03)
RATES = splat_ops.SplatRates()


def copy_of(state: splat_ops.SplatState) -> splat_ops.SplatState:
    return splat_ops.SplatState.from_arrays({name: np.copy(a) for name, a in state.arrays().items()})


def assert_same_bits(a, b) -> None:
    for name in splat_ops.SplatState.ARRAYS:
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_adam(isa):
    """Three steps on views that hit different splats: the kernel's update is Adam on the kernel's own gradient."""
    state = splat_ops.SplatState(random_splats(50, 4, 3))
    views = [view_of_cube(), view_of_cube(32, 16), view_of_cube(16, 48)]
    for k, view in enumerate(views):
        image, expected = random_image(view, k, 0.1), copy_of(state)
        gradient, _ = splat_ops.loss_gradient(state, view, image, OPTIONS)
        hit = packing.from_blocks(gradient, state.n).any(1)
        assert 0 < hit.sum() <= state.n
        splat_on_torch.adam_step(expected, packing.from_blocks(gradient, state.n), hit, RATES)
        splat_ops.train_step(state, view, image, OPTIONS, RATES)
        assert np.array_equal(state.updates, expected.updates)
        for name in ("params", "first", "second"):
            ours, theirs = getattr(state, name), getattr(expected, name)
            assert np.abs(ours - theirs).max() <= 3e-6 * max(np.abs(theirs[:3]).max(), 1e-3), name
        untouched = ~hit
        rows = packing.from_blocks(state.params, state.n)[untouched]
        assert np.array_equal(rows, packing.from_blocks(expected.params, state.n)[untouched])
    assert (state.updates.reshape(-1)[:50].max() == 3) and (state.per_splat("updates").min() < 3)


def test_a_first_step_goes_by_the_rate(isa):
    """Whatever the gradient, the first step of Adam is the rate (of means: times the size)."""
    state = splat_ops.SplatState(random_splats(30, 4, 5))
    before = state.splats()
    splat_ops.train_step(state, view_of_cube(), random_image(view_of_cube(), 0), OPTIONS, RATES)
    after, hit = state.splats(), state.per_splat("updates") > 0
    size = np.exp(before.log_scales.mean(1))[:, None]
    assert np.allclose((np.abs(after.means - before.means) / size)[hit], RATES.means, rtol=1e-3)
    assert np.allclose(np.abs(after.log_scales - before.log_scales)[hit], RATES.log_scales, rtol=1e-3)
    assert np.allclose(np.abs(after.logits - before.logits)[hit], RATES.logits, rtol=1e-3)


def test_statistics(isa):
    splats, view = random_splats(40, 4, 6), view_of_cube()
    image, state = random_image(view, 4, 0.1), splat_ops.SplatState(splats)
    report = splat_ops.train_step(state, view, image, OPTIONS, splat_ops.SplatRates(*[0.0] * 6))
    parts = splat_reference.loss(Parameters.of(splats), view, image, OPTIONS)
    assert np.allclose(state.per_splat("error"), parts.error, rtol=1e-4, atol=1e-6)
    assert np.allclose(state.per_splat("max_weight"), parts.max_weight, atol=1e-6)
    assert np.array_equal(state.per_splat("updates") > 0, parts.hit.numpy())
    assert report.visible == state.seen.sum() and report.entries > report.visible and report.blocks > report.entries
    splat_ops.train_step(state, view, image, OPTIONS, splat_ops.SplatRates(*[0.0] * 6))
    assert np.allclose(state.per_splat("error"), 2 * parts.error.numpy(), rtol=1e-4, atol=1e-6)
    state.reset_statistics()
    assert not (state.error.any() or state.max_weight.any() or state.seen.any())


def test_what_a_masked_pixel_shows_does_not_matter(isa):
    view = view_of_cube(70, 45)
    image = random_image(view, 8, 0.3)
    other = image.copy()
    other[other[..., 3] == 0] = (9, 200, 31, 0)
    states = [splat_ops.SplatState(random_splats(40, 4, 9)) for _ in range(2)]
    reports = [splat_ops.train_step(s, view, i, OPTIONS, RATES) for s, i in zip(states, (image, other), strict=True)]
    assert reports[0] == reports[1]
    assert_same_bits(*states)
    nothing = image.copy()
    nothing[..., 3] = 0
    before = copy_of(states[0])
    report = splat_ops.train_step(states[0], view, nothing, OPTIONS, RATES)
    assert report.loss == report.squared_error == 0
    assert np.array_equal(before.params, states[0].params)


def test_splats_behind_the_camera_and_scenes_without_any(isa):
    view = straight_view(40, 30)
    behind = random_splats(20, 1, 1)
    behind.means[:, 2] = -np.abs(behind.means[:, 2]) - 0.1
    for splats in (behind, behind.select([])):
        out = splat_ops.render_splats(splats, view, BACKGROUND, outputs=splat_ops.OUTPUTS)
        assert np.array_equal(out["rgb"], np.broadcast_to(np.float32(BACKGROUND), (30, 40, 3)))
        assert not any(out[name].any() for name in ("opacity", "depth", "median_depth", "normal"))
        state = splat_ops.SplatState(splats)
        report = splat_ops.train_step(state, view, random_image(view, 0), OPTIONS, RATES)
        assert report.visible == report.entries == 0 and report.loss > 0
        assert not state.updates.any()


def test_one_splat_over_everything(isa):
    view = straight_view(50, 35)
    splats = random_splats(1, 1, 0)
    splats.means[:], splats.log_scales[:], splats.logits[:] = (0, 0, 1), np.log(30.0), 20.0
    splats.sh[:] = ((0.3 - 0.5) / 0.28209479) * np.ones((1, 3, 1))
    out = splat_ops.render_splats(splats, view, (0, 0, 0), outputs=("rgb", "opacity"))
    assert np.allclose(out["opacity"], 0.99, atol=1e-5) and np.allclose(out["rgb"], 0.297, atol=1e-4)
    report = splat_ops.train_step(splat_ops.SplatState(splats), view, random_image(view, 0), OPTIONS, RATES)
    assert report.entries == 4 * 3 and report.blocks == 13 * 9


def test_extreme_numbers_stay_finite(isa):
    """Scales from nothing to a whole world, splats that touch the near plane, needles, opaque piles."""
    splats = random_splats(400, 4, 2)
    rng = np.random.default_rng(5)
    splats.log_scales[:] = rng.uniform(-40, 20, (400, 3))
    splats.logits[:] = rng.uniform(-90, 90, 400)
    splats.means[:50, 2] = 0.0500001
    splats.means[50:60] = 1e18
    splats.quats[:100] *= 1e-6
    view = straight_view(64, 48)
    out = splat_ops.render_splats(splats, view, outputs=splat_ops.OUTPUTS)
    assert all(np.isfinite(a).all() for a in out.values())
    state = splat_ops.SplatState(splats)
    for k in range(3):
        splat_ops.train_step(state, view, random_image(view, k), OPTIONS, RATES)
    state.splats().validate()


def test_without_compiled_kernels(compiled, monkeypatch):
    splats, view = random_splats(30, 4, 12), view_of_cube(40, 30)
    image = random_image(view, 5, 0.1)

    def everything():
        state = splat_ops.SplatState(splats)
        picture = splat_ops.render_splats(state.packed, view, BACKGROUND, outputs=splat_ops.OUTPUTS)
        gradient, _ = splat_ops.loss_gradient(state, view, image, OPTIONS)
        report = splat_ops.train_step(state, view, image, OPTIONS, RATES)
        state.split([1, 4])
        state.reorder()
        return picture, gradient, report, state

    fast = everything()
    monkeypatch.setattr(splat_ops, "native", lambda: None)
    monkeypatch.setattr(splat_state, "native", lambda: None)
    slow = everything()
    for name in splat_ops.OUTPUTS:
        assert np.abs(fast[0][name] - slow[0][name]).max() < 1e-4, name
    assert np.abs(fast[1] - slow[1]).max() < 1e-4 * np.abs(slow[1]).max()
    assert fast[2].loss == pytest.approx(slow[2].loss, rel=1e-4)
    assert np.abs(fast[3].params - slow[3].params).max() < 2e-3


@pytest.mark.parametrize("wrong", ["image", "dtype", "rate", "eps", "output", "background", "state"])
def test_what_is_refused(wrong):
    state, view = splat_ops.SplatState(random_splats(20, 1, 0)), view_of_cube(40, 30)
    image = random_image(view, 0)
    with pytest.raises(ValueError):
        if wrong == "image":
            splat_ops.train_step(state, view, image[:-1], OPTIONS, RATES)
        elif wrong == "dtype":
            splat_ops.train_step(state, view, image.astype(np.float32), OPTIONS, RATES)
        elif wrong == "rate":
            splat_ops.train_step(state, view, image, OPTIONS, splat_ops.SplatRates(means=np.nan))
        elif wrong == "eps":
            splat_ops.render_splats(state.packed, view, early_stop_eps=1.0)
        elif wrong == "output":
            splat_ops.render_splats(state.packed, view, outputs=("colour",))
        elif wrong == "background":
            splat_ops.render_splats(state.packed, view, (1, 2))
        else:
            state.first = state.first[:-1]
            splat_ops.train_step(state, view, image, OPTIONS, RATES)


def test_no_needles(isa):
    """After a step what was hit has no longest scale beyond the bound, as Adam's twin has it; the rest stays as it was."""
    rates = dataclasses.replace(RATES, log_scales=0.5, most_log_ratio=float(np.log(3.0)))
    state, view = splat_ops.SplatState(random_splats(60, 4, 7)), view_of_cube(32, 16)
    before = state.splats().log_scales
    for k in range(3):
        image, expected = random_image(view, k), copy_of(state)
        gradient, _ = splat_ops.loss_gradient(state, view, image, OPTIONS)
        hit = packing.from_blocks(gradient, state.n).any(1)
        splat_on_torch.adam_step(expected, packing.from_blocks(gradient, state.n), hit, rates)
        splat_ops.train_step(state, view, image, OPTIONS, rates)
        assert np.abs(state.splats().log_scales - expected.splats().log_scales).max() < 1e-4
    scales, touched = np.sort(state.splats().log_scales, axis=1), state.per_splat("updates") > 0
    assert (scales[touched, 2] - scales[touched, 1]).max() <= np.log(3.0) + 1e-6
    was = np.sort(before, axis=1)
    assert ((was[:, 2] - was[:, 1])[touched] > np.log(3.0)).any() and 0 < touched.sum() < 60
    assert np.array_equal(state.splats().log_scales[~touched], before[~touched])
