"""A splat trainer alone: epochs, pruning, growth to the plan, rates, and photographs that are released."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.config.splats import SplatConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.kernels import splat_ops
from nerfvol.native import native
from nerfvol.region import SceneBounds
from nerfvol.splats.splats import Splats
from nerfvol.training.splat_schedule import Schedule
from nerfvol.training.splat_trainer import NEAR_SHARE, SplatTrainer

pytestmark = pytest.mark.skipif(native() is None, reason="the reference path takes minutes; it has a test of its own")


LENS = Intrinsics(32, 32, 40.0, 40.0, 16.0, 16.0)


def around(n: int) -> list[Camera]:
    """Cameras in the middle that look outwards; with 5 or more of LENS no two see the same place."""
    angles = 2 * np.pi * np.arange(n) / n
    return [Camera(LENS, look_at((0, 0, 0), (np.cos(a), np.sin(a), 0))) for a in angles]


def shell(cameras: list[Camera], each: int, lost: int = 0, seed: int = 0) -> Splats:
    """``each`` splats before every camera, 3 away, and ``lost`` straight above, which no camera sees."""
    rng = np.random.default_rng(seed)
    means = [3 * c.forward + rng.uniform(-0.6, 0.6, (each, 3)) for c in cameras]
    means = np.concatenate([*means, (0, 0, 9) + rng.normal(0, 0.1, (lost, 3))])
    n = len(means)
    quats = np.tile((1.0, 0, 0, 0), (n, 1))
    return Splats(means, np.full((n, 3), np.log(0.1)), quats, np.zeros(n), np.zeros((n, 3, 1)), np.zeros(3))


GROWN = 0.03001
"""Of a trainer that never grows."""


def trainer_of(
    cameras: list[Camera], splats: Splats, most=10**6, grown=0.6, seed=0, background=(0.2, 0.4, 0.6), **settings
) -> SplatTrainer:
    images = [np.random.default_rng(i).integers(0, 255, (32, 32, 3)).astype(np.uint8) for i in range(len(cameras))]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    data = Dataset(cameras, images, [str(i) for i in range(len(cameras))], SceneBounds(box, 16 * box, False), "x.json")
    config = SplatConfig(**settings).for_scene(data.scene)
    trainer = SplatTrainer(
        Photographs(data), splats, config, Schedule((1,), (1.0,), most, grown), 3.0, background, seed
    )
    trainer.growing = grown > GROWN
    return trainer


STILL = {f"rate_{name}": 0.0 for name in ("means", "scales", "quats", "logits", "dc", "sh")}


def test_each_photograph_is_seen_once_an_epoch(monkeypatch):
    trainer = trainer_of(around(7), shell(around(7), 5), grow_every=4)
    seen, view = [], Photographs.view
    monkeypatch.setattr(Photographs, "view", lambda self, i, *how: seen.append(i) or view(self, i, *how))
    for k in range(28):
        trainer.step(k / 28)
    epochs = [tuple(seen[k : k + 7]) for k in (0, 7, 14, 21)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs) and len(set(epochs)) > 1
    other = trainer_of(around(7), shell(around(7), 5), seed=1)
    assert [other._next_view() for other.steps_done in range(28)] != seen


@pytest.mark.parametrize("every", [2, 3, 5, 7, 11])
def test_what_is_in_no_photograph_goes_once_all_were_asked(every):
    """Each camera sees splats of its own, and rounds begin anywhere in an epoch: only what none of five sees is removed, at
    the first round after five steps."""
    cameras = around(5)
    for seed in range(3):
        splats = shell(cameras, 6, lost=4)
        trainer = trainer_of(cameras, splats, grown=GROWN, seed=seed, grow_every=every, prune_opacity=0.0, **STILL)
        for step in range(40):
            trainer.step(step / 40)
            asked = (step // every) * every >= 5  # at a round that has been
            assert trainer.state.n == (30 if asked else 34), f"after step {step}, every {every}"


def test_what_leaves_all_photographs_goes_an_epoch_later():
    """What was seen once does not count for ever."""
    trainer = trainer_of(around(5), shell(around(5), 6), grown=GROWN, grow_every=5, prune_opacity=0.0, **STILL)
    for step in range(6):
        trainer.step(step / 40)
    assert trainer.state.n == 30
    trainer.state.params[0, 2, :3] += 50  # three of them, upwards
    counts = [trainer.state.n for step in range(6, 16) if trainer.step(step / 40)]
    assert counts[0] == 30 and counts[-1] == 27


def test_a_state_says_where_in_an_epoch_it_was_taken():
    """Continued in another trainer, the same splats are removed at the same round."""
    cameras = around(7)

    def begin() -> SplatTrainer:
        return trainer_of(cameras, shell(cameras, 6, lost=4), grown=GROWN, grow_every=3, prune_opacity=0.0, **STILL)

    for at in range(1, 20):
        straight, cut = begin(), begin()
        for step in range(at):
            straight.step(step / 40)
            cut.step(step / 40)
        again = begin()
        again.load_state_dict(cut.state_dict())
        for trainer in (straight, again):
            trainer.state.params[0, 2, :3] += 50
        for step in range(at, 30):
            straight.step(step / 40)
            again.step(step / 40)
            assert straight.state.n == again.state.n, (at, step)


def test_each_round_draws_anew():
    chosen = set()
    for steps_done in (5, 10, 15):
        splats = shell(around(5), 6)
        trainer = trainer_of(around(5), splats, most=34, prune_opacity=0.0)
        trainer.steps_done = steps_done
        trainer.state.per_splat("error")[:] = 1.0
        trainer.grow(0.59)
        halves = trainer.state.splats().log_scales.min(axis=1) < np.log(0.1) - 0.1
        apart = np.linalg.norm(trainer.state.splats().means[halves][:, None] - splats.means[None], axis=2)
        chosen.add(tuple(sorted(set(apart.argmin(axis=1).tolist()))))
    assert len(chosen) == 3


def test_the_transparent_go_and_the_others_stay():
    cameras = around(5)
    splats = shell(cameras, 10)
    opacity = np.linspace(0.001, 0.9, 50)
    splats.logits[:] = np.log(opacity / (1 - opacity))
    trainer = trainer_of(cameras, splats, most=1, prune_opacity=0.3)
    trainer.grow(0.1)
    kept = 1 / (1 + np.exp(-trainer.state.splats().logits.astype(float)))
    np.testing.assert_allclose(np.sort(kept), opacity[opacity >= 0.3], rtol=1e-5)


def test_the_model_is_what_is_not_transparent():
    splats = shell(around(5), 2)
    splats.logits[:4] = -6
    model = trainer_of(around(5), splats).take_model({"background": [0, 0, 0]})
    assert model.packed.n == 6 and model.metadata == {"background": [0, 0, 0], "near": NEAR_SHARE * 3.0}
    splats.logits[:] = -6
    assert trainer_of(around(5), splats).take_model({}).packed.n == 10  # a model of nothing could not be drawn


def test_growth_follows_the_plan_up_to_the_most():
    trainer = trainer_of(around(5), shell(around(5), 8), most=150, grown=0.6, grow_every=5, prune_opacity=0.0)
    counts = []
    for step in range(100):
        trainer.step(step / 100)
        counts.append(trainer.state.n)
        done = (step // 5) * 5 / 100  # of the last round
        if step >= 5 and done < 0.6:
            assert trainer.state.n == trainer.schedule.planned(40, done), step
        assert trainer.state.n <= 150
    assert counts == sorted(counts)
    assert counts[59] < counts[60] == counts[-1] == 150  # the first round at 0.6 completes it


@pytest.mark.parametrize("cut", [3, 9, 16])
def test_growth_is_completed_once_by_a_resumed_run_as_well(cut):
    """However few rounds there are, here at 0.35, 0.7 and 1; what goes later does not come back."""
    trainer = trainer_of(around(5), shell(around(5), 8), most=150, grown=0.5, grow_every=7, prune_opacity=0.0)
    for step in range(22):
        if step == cut:
            state = trainer.state_dict()
            trainer = trainer_of(around(5), shell(around(5), 8), grow_every=7, prune_opacity=0.0)
            trainer.load_state_dict(state)
        if step == 17:
            assert trainer.state.n == 150
            trainer.state.prune(np.arange(150) < 100)
        trainer.step(min(step / 20, 1.0))
    assert trainer.state.n == 100


def test_a_start_above_the_most_does_not_grow():
    trainer = trainer_of(around(5), shell(around(5), 8), most=30, grow_every=5, prune_opacity=0.0)
    for step in range(30):
        trainer.step(step / 30)
    assert trainer.state.n == 40


def test_what_holds_the_error_is_split():
    """Never one without error; those with much of it more often than those with little, as the 0.7th power."""
    cameras, splits = around(5), np.zeros(3)
    for seed in range(60):
        splats = shell(cameras, 6)
        trainer = trainer_of(cameras, splats, most=33, seed=seed, prune_opacity=0.0)
        error = trainer.state.per_splat("error")
        error[:10], error[10:20], error[20:] = 100.0, 1.0, 0.0
        trainer.grow(0.59)
        assert trainer.state.n == 32
        halves = trainer.state.splats().log_scales.min(axis=1) < np.log(0.1) - 0.1
        assert halves.sum() == 4
        means = trainer.state.splats().means[halves]
        whose = np.argmin(np.linalg.norm(means[:, None] - splats.means[None], axis=2), axis=1)
        splits += np.histogram(whose // 10, [0, 1, 2, 3])[0] / 2
        assert trainer.state.error.sum() == pytest.approx(0.3 * (1010 + 100 * np.sum(whose < 10) / 2 + np.sum(
            (whose >= 10) & (whose < 20)) / 2), rel=0.01)  # fmt: skip
    assert splits[2] == 0 and splits.sum() == 120
    share = 1 / (1 + 100**0.7)  # of a draw; the second of two is a little likelier to be a small one
    assert 0 < splits[1] < 120 * (2.5 * share) + 6


def test_rates_fade_and_the_loss_knows_the_scene(monkeypatch):
    calls = []

    def record(state, view, image, options, rates, motion=None):
        calls.append((view, options, rates))
        return splat_ops.SplatReport(0.0, 0.25, 1, 1, 8)

    monkeypatch.setattr(splat_ops, "train_step", record)
    trainer = trainer_of(around(5), shell(around(5), 4), rate_means=0.3, rate_scales=0.11, beta2=0.97,
                         rate_decay=0.2, rate_decay_means=0.05, ssim=0.7, scale=6.0)  # fmt: skip
    for progress in (0.0, 0.5, 1.0):
        report = trainer.step(progress)
    assert report.squared_error == 0.25 and report.samples == 16 * 8 / 32**2
    c = trainer.config
    for (view, options, rates), fade, means in zip(calls, (1, 0.2**0.5, 0.2), (1, 0.05**0.5, 0.05), strict=True):
        assert view.near == NEAR_SHARE * 3.0
        assert options.background == (0.2, 0.4, 0.6) and options.ssim == 0.7 and options.scale == 6.0 / 3.0
        assert options.squared == 1 and options.l1 == 0 and options.early_stop_eps == c.early_stop_eps
        found = (rates.means, rates.log_scales, rates.quats, rates.logits, rates.dc, rates.sh, rates.beta2)
        wanted = (c.rate_scales, c.rate_quats, c.rate_logits, c.rate_dc, c.rate_sh)
        np.testing.assert_allclose(found, (c.rate_means * means, *(fade * w for w in wanted), c.beta2))


def test_photographs_of_a_size_that_is_over_are_let_go():
    """The full size only serves the smaller ones until its stage; what a resumed run needs is made anew."""
    trainer = trainer_of(around(5), shell(around(5), 4))
    trainer.schedule = Schedule((4, 2, 1), (0.3, 0.6, 1.0), 10, 0.5)
    held = []
    for step in range(30):
        trainer.step(step / 30)
        held.append((trainer.stage, trainer.stages_left, frozenset(trainer.photographs.held)))
    assert held == [(0, 2, {4})] * 9 + [(1, 1, {2})] * 9 + [(2, 0, {1})] * 12
