"""Time budgets: every stage gets its share, scoring is paid for, earlier sessions count."""

import json
import re
import time

import pytest

from nerfvol.cli import main
from nerfvol.files import run_folder
from nerfvol.octree.io import load_octree
from nerfvol.training import session, train
from nerfvol.training.memory import estimate_training, octree_bytes
from nerfvol.training.train import OctreePhase
from tests.fixtures.runs import TINY, Pretended, log_of, settings, start


@pytest.mark.parametrize("init", ["direct", "mlp"])
def test_a_budget_ends_every_stage(tmp_path, tiny_scene, init, monkeypatch):
    """More steps than fit: by a clock that goes on 20 ms at every look, each phase gets its share and is finished."""
    looks = iter(range(10**9))
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 0.02 * next(looks))
    monkeypatch.setattr(session, "FINISH_SECONDS", 100.0)
    config = settings(tiny_scene, tmp_path, init=init, time_budget=10.0, checkpoint_every=1000)
    config.octree.steps = config.field.steps = 10**9
    start(config)
    metrics = json.loads((tmp_path / run_folder.METRICS).read_text())
    log = log_of(tmp_path)
    assert metrics["psnr"] > 12 and metrics["time_budget"] == 10
    assert log[-1]["phase"] == "octree" and log[-1]["progress"] >= 1 and log[-1]["stage"] == 2
    # All of the time but what is kept to finish: 2 seconds here, by the bound on its share.
    assert log[-1]["seconds"] == pytest.approx(8, abs=0.1)
    if init == "mlp":
        assert metrics["stages"]["field"]["seconds"] == pytest.approx(session.FIELD_SHARE * 8, abs=0.1)


def test_shares_of_a_budget(tmp_path, tiny_scene, monkeypatch):
    """100 seconds, 20 of them for the end; a phase that begins at 10 has 70 left, of which the field gets 30 percent."""
    monkeypatch.setattr(session.Run, "_time_to_finish", lambda self, phase=None: 20.0)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 13.5)
    for most, share in ((75.0, 21.0), (7.0, 7.0)):
        field = {**TINY["field"], "time_budget": most}
        config = settings(tiny_scene, tmp_path, init="mlp", time_budget=100.0, field=field)
        run = session.Run(config, session.Clock(0.0, 0.0), None)
        run.phase_started = 10.0
        assert run.progress(Pretended("field")) == pytest.approx(3.5 / share)
        assert run.progress(Pretended("octree")) == pytest.approx(3.5 / 70)


def test_a_budget_ends_early_where_more_steps_would_overfit(tmp_path, tiny_scene, monkeypatch):
    """Progress is the share of the time or of the most steps, whichever is further."""
    monkeypatch.setattr(session.Run, "_time_to_finish", lambda self, phase=None: 0.0)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 30.0)
    run = session.Run(settings(tiny_scene, tmp_path, time_budget=100.0), session.Clock(0.0, 0.0), None)
    octree = Pretended("octree")
    for steps, progress in [(0, 0.3), (299, 0.3), (500, 0.5), (1000, 1.0)]:
        octree.steps_done = steps
        assert run.progress(octree) == pytest.approx(progress)


def test_time_is_kept_to_score_every_view(tmp_path, tiny_scene, monkeypatch):
    """By a clock that goes on a second at every look, with a picture that takes 10 more, on one thread.

    Reading took one second. A view takes one second to score, and to render a guess of 0.1 microseconds a pixel before there
    is a picture and 11 seconds then. Two views are held out; a tenth is added for what else they need.
    """
    seconds = [0.0]

    def look() -> float:
        seconds[0] += 1
        return seconds[0]

    def picture(camera):
        seconds[0] += 10

    monkeypatch.setattr(session, "HELD_OUT_KEPT", 0)
    monkeypatch.setattr(session.time, "perf_counter", look)
    main.set_threads(1)
    run = session.Run(settings(tiny_scene, tmp_path, time_budget=1000.0), session.Clock(0.0, 0.0), None)
    assert "images" not in vars(run.held_out) and len(run.comparison_views) == 2
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 100.0)
    writing = session.FINISH_SECONDS + session.FINISH_SECONDS_PER_LEAF * 1_000_000
    octree = Pretended("octree")
    assert 100 / run.progress(octree) == pytest.approx(1000 - writing - 1 - 2.2 * (1 + 1600e-7))
    octree.picture, octree.stage, octree.trainer, octree.n_leaves = picture, 0, Pretended("trainer"), 3_000_000
    octree.n_vertices = 4_000_000
    octree.trainer.bank = None
    run.enter_stage(octree)
    writing = session.FINISH_SECONDS + session.FINISH_SECONDS_PER_LEAF * 3_000_000
    assert 100 / run.progress(octree) == pytest.approx(1000 - writing - 1 - 2.2 * (1 + 11))


def test_memory_is_announced_anew_where_the_octree_outgrows_the_estimate(tmp_path, tiny_scene, capsys):
    """With the vertices that it has; once for each larger octree, and not for one that is as large as was said."""
    run = session.Run(settings(tiny_scene, tmp_path), session.Clock(0.0, 0.0), None)
    said = int(re.search(r"up to ([\d,]+) leaves", capsys.readouterr().out)[1].replace(",", ""))
    octree = Pretended("octree")
    octree.stage, octree.trainer = 0, Pretended("trainer")
    octree.trainer.bank = None
    for leaves, vertices, reckoned in [(said, 1, None), (said + 1, 10**6, said + 1), (said + 1, 10**6, None),
                                       (10**6, 2 * 10**6, 10**6)]:  # fmt: skip
        octree.n_leaves, octree.n_vertices = leaves, vertices
        run.enter_stage(octree)
        printed = capsys.readouterr().out
        if reckoned is None:
            assert printed == ""
        else:
            estimate = estimate_training(run.dataset, reckoned, 1, run._beside, vertices)
            assert printed == f"memory: the octree is larger than was reckoned with; now {estimate.sentence()}\n"
            assert estimate.octree == octree_bytes(leaves, 1, vertices)


def test_a_budget_is_kept(tmp_path, tiny_scene):
    """On the real clock; a step of this scene takes milliseconds."""
    config = settings(tiny_scene, tmp_path, time_budget=3.0, checkpoint_every=1000)
    config.octree.steps = config.octree.most_epochs = 10**9
    started = time.perf_counter()
    start(config, started=started)
    log = log_of(tmp_path)
    assert log[-1]["progress"] >= 1 and log[-1]["seconds"] > 1.5  # no upper bound: a busy machine may freeze it


def test_a_budget_that_is_over_before_the_start(tmp_path, tiny_scene):
    start(settings(tiny_scene, tmp_path, time_budget=1.0), started=time.perf_counter() - 10)
    assert json.loads((tmp_path / run_folder.METRICS).read_text())["steps"] == {"octree": 0}
    assert load_octree(tmp_path / run_folder.OCTREE)[0].n_leaves > 0


def test_the_time_of_earlier_sessions_counts(tmp_path, tiny_scene):
    clock = session.Clock(time.perf_counter() - 2, 30.0)
    assert clock.elapsed() == pytest.approx(32, abs=0.5)
    assert 0 < session.Clock(None, 0.0).elapsed() < 3600


def test_the_most_steps_draw_each_tile_so_often(tmp_path, tiny_scene):
    """12 pictures of 25 tiles, of which those that show the sphere count."""
    run = session.Run(settings(tiny_scene, tmp_path, time_budget=100.0), session.Clock(0.0, 0.0), None)
    assert run.rich_tiles == pytest.approx(300 * run._beside.rich_share) and 100 < run.rich_tiles <= 300
    drawn = run.config.octree.tiles[-1] * run.config.octree.rich_share
    for epochs, steps in [(1e4, 1e4 * run.rich_tiles / drawn), (1.0, train.FEWEST_STEPS)]:
        run.config.octree.most_epochs = epochs
        assert OctreePhase(run, None).most_steps == pytest.approx(steps)
