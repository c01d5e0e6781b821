"""Stages that suit the steps: none is left out where they suffice, and however few there are the full pictures are reached."""

import dataclasses
import itertools
import json

import numpy as np
import pytest

from nerfvol.config.octree import OctreeConfig
from nerfvol.datasets.load import load_dataset
from nerfvol.files import run_folder
from nerfvol.training import finishing, octree_trainer, session
from nerfvol.training.octree_schedule import (
    ENOUGH_TILES,
    ENOUGH_TILES_OF_PHOTOGRAPHS,
    FEWEST_PRUNE_STEPS,
    FULL_BY,
    enough_tiles,
    is_worth_it,
    prune_steps,
    stages_for,
)
from nerfvol.training.octree_trainer import OctreeTrainer
from tests.fixtures.runs import log_of, settings, start

STEPS = [1, 10, 57, 58, 100, 229, 230, 400, 1000, 3298, 5232, 20_000, 10**6]
SIDES = [24, 72, 200, 400, 800, 4000]


def plans(side: int, views: int = 100):
    """(settings, foreground tiles of each stage, steps, stages) of objects and photographs of ``side`` pixels."""
    config = OctreeConfig().for_pictures(side)
    tiles = [0.5 * views * (side / downscale / 8) ** 2 for downscale in config.downscales]
    for steps, unbounded in itertools.product(STEPS, (False, True)):
        yield config, tiles, steps, unbounded, stages_for(config, 0, steps, tiles, unbounded)


@pytest.mark.parametrize("side", SIDES)
def test_the_full_pictures_come_in_the_first_third(side):
    """Whatever the pictures, once there are twenty steps for each of the fewest prunings; the first stage is always there."""
    for config, tiles, steps, unbounded, stages in plans(side):
        if unbounded:
            continue
        full = config.downscales.index(1)
        before = [stage for stage in stages.kept if stage < full]
        assert stages.kept[: len(before) + 1] == (*before, full) and stages.kept[-1] == len(config.levels) - 1
        assert before[:1] == [0][: len(before)] and (not before) == (full == 0)
        waits = [max(prune_steps(config, steps), enough_tiles(n, unbounded) / batch)
                 for n, batch in zip(tiles, config.tiles, strict=True)]  # fmt: skip
        takes = sum((stages.prunes[stage] + 1) * min(waits[stage], stages.wait) for stage in before)
        if FULL_BY * steps >= 2 * FEWEST_PRUNE_STEPS:
            assert takes <= FULL_BY * steps * (1 + 1e-12), (side, steps, unbounded)


@pytest.mark.parametrize("side", SIDES)
def test_a_run_of_many_steps_is_the_one_that_was_set(side):
    """Also before there is a pace, and where no stage comes before the full pictures."""
    for steps in (10**6, float("inf")):
        for config, tiles, _, unbounded, _ in plans(side):
            stages = stages_for(config, 0, steps, tiles, unbounded)
            assert stages.kept == tuple(range(len(config.levels))) and stages.prunes == tuple(config.prunes)
            assert stages.wait == float("inf")
    late = stages_for(OctreeConfig(), 4, 10.0, [1e6] * 7, False)
    assert late.kept == (4, 5, 6) and late.prunes == tuple(OctreeConfig().prunes)


@pytest.mark.parametrize("side", SIDES)
def test_photographs_are_pruned_as_often_as_was_set(side):
    """However slow the pace: it is slow because of what was not pruned."""
    for config, _, _, unbounded, stages in plans(side):
        if unbounded:
            assert stages.kept == tuple(range(len(config.levels))) and stages.prunes == tuple(config.prunes)
            assert stages.wait == float("inf")


def test_more_steps_never_leave_out_more():
    for side in SIDES:
        for unbounded in (False, True):
            of = [stages for *_, seen, stages in plans(side) if seen == unbounded]
            for a, b in itertools.pairwise(of):
                assert set(a.kept) <= set(b.kept) and all(x <= y for x, y in zip(a.prunes, b.prunes, strict=True))


def test_what_tells_what_no_ray_needs():
    assert enough_tiles(1000, False) == enough_tiles(1000, True) == 500
    assert enough_tiles(1e9, False) == ENOUGH_TILES and enough_tiles(1e9, True) == ENOUGH_TILES_OF_PHOTOGRAPHS
    config = OctreeConfig()
    assert [prune_steps(config, n) for n in (0, 200, 300, 1e9)] == [10, 10, 15, 20]


def test_a_fine_stage_needs_steps():
    """800 of them at level 9, 2,500 beyond; a coarse one as many as its prunings wait."""
    config = OctreeConfig()
    assert config.levels[4:] == [8, 9, 10]
    assert not is_worth_it(config, 5, 1230, 0.35) and is_worth_it(config, 5, 1240, 0.35)
    assert not is_worth_it(config, 6, 6200, 0.6) and is_worth_it(config, 6, 6300, 0.6)
    assert is_worth_it(config, 4, 400, 0.8) and not is_worth_it(config, 4, 400, 0.95)


@pytest.mark.parametrize("downscale, left", [(1, [1, 0]), (4, [0, 0])])
def test_what_pictures_cannot_show_is_no_stage_that_is_missing(tiny_scene, downscale, left):
    """Pictures of 40 pixels show leaves of level 6, of 10 pixels of level 4."""
    config = OctreeConfig(
        levels=[5, 6, 9], downscales=[1, 1, 1], stage_ends=[0.1, 0.2, 1.0], tiles=[8] * 3, prunes=[0] * 3
    )
    trainer = OctreeTrainer(load_dataset(tiny_scene, "train", downscale), (1, 1, 1), config, 0, None)
    assert trainer.stages_left == left[0]
    trainer.stage = 1
    assert trainer.stages_left == left[1]
    trainer.config = dataclasses.replace(config, downscales=[4, 2, 1])
    assert trainer.stages_left == left[1] + 1


MANY = {"levels": [3, 4, 4, 5, 5], "downscales": [4, 4, 2, 2, 1], "stage_ends": [0.01, 0.02, 0.05, 0.1, 1.0],
        "tiles": [8, 8, 8, 8, 8], "prunes": [3, 3, 2, 2, 1], "prune_steps": 20}  # fmt: skip


@pytest.mark.parametrize("seconds_a_step, visits", [(0.14, [0, 4]), (0.07, [0, 2, 4]), (0.02, [0, 1, 2, 3, 4])])
def test_a_slow_clock_reaches_the_finest_stage(tmp_path, tiny_scene, monkeypatch, seconds_a_step, visits):
    """8 s for steps, by a clock that goes on so much a step: 57, 114 and 400 of them. The slow ones pass through fewer stages,
    and end in the finest; the fast one in all of them."""
    steps = []
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: seconds_a_step * (steps[-1] if steps else 0))
    monkeypatch.setattr(finishing, "EXPECTED_SECONDS_TO_WRITE", 100.0)
    monkeypatch.setattr(OctreeTrainer, "seconds_to_write", lambda self: 2.0)
    monkeypatch.setattr(session.Run, "claim", claim_and_count(session.Run.claim, steps))
    config = settings(tiny_scene, tmp_path, time_budget=10.0, init="direct", checkpoint_every=1000)
    config.octree = dataclasses.replace(OctreeConfig(), **MANY, most_epochs=10**9)
    seen = []
    start(config, watch=lambda run, phase, began: seen.append(phase.stage))
    assert [stage for stage, _ in itertools.groupby(seen)] == [stage for stage in visits if stage in seen]
    assert sorted(set(seen)) == visits and len(seen) == pytest.approx(8 / seconds_a_step, abs=2)
    assert seen.index(4) <= (FULL_BY + 0.1) * len(seen)
    assert json.loads((tmp_path / run_folder.METRICS).read_text())["psnr"] > 12
    assert log_of(tmp_path)[-1]["progress"] >= 1


def claim_and_count(claim, steps):
    """Run.claim, which is called after each step, and what it notes: the steps that were made."""

    def counted(self, phase):
        if phase is not None:
            steps.append(phase.steps_done)
        claim(self, phase)

    return counted


def test_a_shortened_run_is_resumed_exactly(tiny_scene):
    """In the middle of a stage that is passed through quickly: the same stages, the same bits."""
    dataset = load_dataset(tiny_scene, "train")
    config = dataclasses.replace(OctreeConfig(), **MANY)
    whole = OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
    parts, stages = OctreeTrainer(dataset, (1, 1, 1), config, 0, None), []
    for step in range(120):
        whole.step(step / 120)
        if step in (7, 25, 60):
            state, parts = parts.state_dict(), OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
            parts.load_state_dict(state)
        parts.step(step / 120)
        stages.append((whole.stage, parts.stage))
    assert all(a == b for a, b in stages) and stages[-1][0] == 4 and len({a for a, _ in stages}) == 3
    assert np.array_equal(whole.octree.values, parts.octree.values)


def test_prunings_of_the_run_tell_what_the_last_one_takes(tiny_scene, monkeypatch):
    """By a clock that goes on a second between two looks, of a pruning that leaves half: three for as many leaves each. And of
    a step of 16 tiles: what is left is drawn four times to be judged, at half of a step's time."""
    config = OctreeConfig(levels=[4], downscales=[1], stage_ends=[1.0], tiles=[16], prunes=[0])
    trainer = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config)
    monkeypatch.setattr(octree_trainer, "seconds_to_write", lambda octree: 1.0)
    assert trainer.seconds_to_write() == 1.0  # nothing is known yet
    looks = itertools.count()
    monkeypatch.setattr(octree_trainer.time, "perf_counter", lambda: float(next(looks)))
    trainer.state.max_weight[::2] = 1.0
    before = trainer.octree.n_leaves
    trainer.prune()
    assert trainer.octree.n_leaves == before / 2
    assert trainer.seconds_to_write() == pytest.approx(1.0 + 3 * 0.5)
    trainer.step(0.5)
    judging = 4 * octree_trainer.FINAL_TILES * octree_trainer.DRAWN_SHARE / 16
    assert trainer.seconds_to_write() == pytest.approx(1.0 + 3 * 0.5 + judging)
