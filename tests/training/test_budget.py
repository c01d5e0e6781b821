"""Time budgets: every stage gets its share, scoring is paid for, earlier sessions count."""

import dataclasses
import json
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cli.command import set_threads
from nerfvol.config.field import FieldConfig
from nerfvol.datasets.dataset import evenly
from nerfvol.datasets.load import load_dataset
from nerfvol.files import run_folder
from nerfvol.octree.io import load_octree
from nerfvol.training import clock, field_phase, field_trainer, finishing, prepare, previews, session, splat_start
from nerfvol.training.field_trainer import FieldTrainer
from nerfvol.training.memory.base import gib
from nerfvol.training.memory.octree import OctreePlan, octree_bytes
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.scoring import affordable_scores
from nerfvol.training.session import Run
from tests.fixtures.runs import Pretended, log_of, run_of, settings, start


@pytest.mark.parametrize("init", ["direct", "mlp", "splats"])
def test_a_budget_ends_every_stage(tmp_path, tiny_scene, init, monkeypatch):
    """More steps than fit: by a clock that goes on 20 ms at every look, each phase gets its share and is finished."""
    looks = iter(range(10**9))
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 0.02 * next(looks))
    monkeypatch.setattr(finishing, "EXPECTED_SECONDS_TO_WRITE", 100.0)
    monkeypatch.setattr(OctreeTrainer, "seconds_to_write", lambda self: 2.0)
    monkeypatch.setattr(finishing, "seconds_of_picture", lambda phase, camera: 0.0)
    config = settings(tiny_scene, tmp_path, init=init, time_budget=10.0, checkpoint_every=1000)
    config.octree.steps = config.field.steps = config.splats.steps = 10**9
    start(config)
    metrics = json.loads((tmp_path / run_folder.METRICS).read_text())
    log = log_of(tmp_path)
    assert metrics["psnr"] > 12 and metrics["time_budget"] == 10
    assert log[-1]["phase"] == "octree" and log[-1]["progress"] >= 1 and log[-1]["stage"] == 2
    # All of the time but what is kept to finish: 2 seconds here, of writing.
    assert log[-1]["seconds"] == pytest.approx(8, abs=0.1)
    if init == "mlp":
        left = 10 - field_phase.SECONDS_TO_DISTILL
        assert metrics["results"]["field"]["seconds"] == pytest.approx(field_trainer.FIELD_SHARE * left, abs=0.1)
    if init == "splats":
        left = 10 - splat_start.SECONDS_TO_CONVERT
        assert metrics["results"]["splats"]["seconds"] == pytest.approx(splat_start.START_SHARE * left, abs=0.1)


def test_shares_of_a_budget(tmp_path, tiny_scene, monkeypatch):
    """100 seconds, 20 of them for the end; a phase that begins at 10 has 70 left, of which it takes its share."""
    monkeypatch.setattr(session.Run, "_time_to_finish", lambda self, phase=None: 20.0)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 13.5)
    run = run_of(settings(tiny_scene, tmp_path, time_budget=100.0))
    run.phase_started = 10.0
    for share in (1.0, 0.3):
        assert run.progress(Pretended("octree", share)) == pytest.approx(3.5 / (share * 70))


def test_a_field_leaves_most_of_the_time_to_the_octree(tiny_scene):
    """At most its own bound, and never so much that nothing is left."""
    field = FieldTrainer(load_dataset(tiny_scene), FieldConfig(time_budget=7.0))
    assert field.share_of(1000.0) == 7.0 and 0 < field.share_of(10.0) < 5.0


@pytest.mark.parametrize("left, level", [(None, 8), (100.0, 8), (12.6, 8), (12.4, 7), (3.2, 7), (3.0, 6), (0.0, 6)])
def test_a_field_is_distilled_as_fine_as_there_is_time_for(left, level):
    """5 s at level 8 and a quarter at each coarser one, in 0.4 of what is left; never coarser than 6, nor finer than asked."""
    assert field_phase.level_in_time(8, left) == level
    assert field_phase.level_in_time(5, left) == 5


@pytest.mark.parametrize("budget, level", [(40.0, 8), (10.0, 7)])
def test_a_short_run_distils_coarser(tmp_path, tiny_scene, monkeypatch, budget, level):
    """By a clock that stands still between two looks of 20 ms: after the field 24 and 6 s are left for all else."""
    looks, asked = iter(range(10**9)), []

    class Distilled(Exception):
        pass

    def distill(field, domain, dataset, background, config, *more):
        asked.append(config.level)
        raise Distilled

    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 0.02 * next(looks))
    monkeypatch.setattr("nerfvol.starts.field.distill", distill)
    config = settings(tiny_scene, tmp_path, init="mlp", time_budget=budget, checkpoint_every=1000)
    config.octree.levels, config.distill.level = (4, 5, 8), None
    config.field.steps = 10**9
    with pytest.raises(Distilled):
        start(config)
    assert asked == [level]


def test_a_budget_ends_early_where_more_steps_would_overfit(tmp_path, tiny_scene, monkeypatch):
    """Progress is the share of the time or of the most steps, whichever is further."""
    monkeypatch.setattr(session.Run, "_time_to_finish", lambda self, phase=None: 0.0)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 30.0)
    run = run_of(settings(tiny_scene, tmp_path, time_budget=100.0))
    octree = Pretended("octree")
    for steps, progress in [(0, 0.3), (299, 0.3), (500, 0.5), (1000, 1.0)]:
        octree.steps_done = steps
        assert run.progress(octree) == pytest.approx(progress)


def test_time_is_kept_to_score_every_view(tmp_path, tiny_scene, monkeypatch):
    """By a clock that goes on a second at every look, with a picture that takes 10 more, on one thread.

    A phase that says how long writing takes and draws slowly leaves that much less for training: each held-out view is
    drawn and scored once, and read again where it was released.
    """
    seconds = [0.0]

    def look() -> float:
        seconds[0] += 1
        return seconds[0]

    def picture(camera):
        seconds[0] += 10

    monkeypatch.setattr(session.time, "perf_counter", look)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 100.0)
    set_threads(1)

    def time_left(kept: int, writing: float) -> float:
        monkeypatch.setattr(prepare, "HELD_OUT_KEPT", kept)
        run = run_of(settings(tiny_scene, tmp_path, time_budget=1000.0))
        assert len(run.data.held_out) == 2
        phase = Pretended("octree", writing=writing)
        phase.picture = picture
        run.enter_stage(phase)
        return 100 / run.progress(phase)

    plain = time_left(1 << 30, 0.0)
    assert plain < 1000 - 2 * (10 + 1)  # two views to draw and score
    assert time_left(1 << 30, 5.0) == pytest.approx(plain - 5)
    assert time_left(0, 0.0) == pytest.approx(plain - 1)  # to read them again


def test_memory_is_announced_again_where_the_octree_outgrows_the_estimate(tmp_path, tiny_scene, capsys):
    """With the vertices that it has; once for each larger octree, and not for one that is as large as was said."""
    run = run_of(settings(tiny_scene, tmp_path))
    plan = OctreePlan(run.config, run.data.training, 0)
    said = int(re.search(r"up to ([\d,]+) leaves", plan.sentence())[1].replace(",", ""))
    octree = SimpleNamespace(n_leaves=said, n_vertices=1)
    assert plan.outgrown(octree) is None
    for leaves, vertices in [(said + 1, 10**6), (10**6, 2 * 10**6)]:
        octree.n_leaves, octree.n_vertices = leaves, vertices
        sentence = plan.outgrown(octree)
        assert sentence.startswith("memory: the octree outgrew the estimate; now ") and f"{leaves:,} leaves" in sentence
        assert gib(octree_bytes(leaves, 1, vertices)) in sentence
        assert plan.outgrown(octree) is None
    phase = Pretended("octree", sentence="memory: more")
    phase.picture = lambda camera: None
    capsys.readouterr()
    run.enter_stage(phase)
    assert capsys.readouterr().out == "memory: more\n"


def test_a_budget_is_kept(tmp_path, tiny_scene):
    """On the real clock; a step of this scene takes milliseconds."""
    config = settings(tiny_scene, tmp_path, time_budget=3.0, checkpoint_every=1000)
    config.octree.steps = config.octree.most_epochs = 10**9
    started = time.perf_counter()
    start(config, started=started)
    log = log_of(tmp_path)
    assert log[-1]["progress"] >= 1 and log[-1]["seconds"] >= 1.5  # no upper bound: a busy machine may freeze it


@pytest.mark.parametrize("budget, steps", [(1.0, {"octree": 0}), (20.0, {"splats": 0, "octree": 0})])
def test_a_budget_that_is_over_before_the_start(tmp_path, tiny_scene, budget, steps):
    start(settings(tiny_scene, tmp_path, time_budget=budget), started=time.perf_counter() - 100)
    assert json.loads((tmp_path / run_folder.METRICS).read_text())["steps"] == steps
    assert load_octree(tmp_path / run_folder.OCTREE)[0].n_leaves > 0


@pytest.mark.parametrize(
    "steps, start", [({"field": 7}, "mlp"), ({"field": 9, "octree": 3}, "mlp"), ({"octree": 3}, "auto")]
)
def test_another_budget_changes_no_start_of_a_resumed_run(tmp_path, tiny_scene, compiled, steps, start):
    """Of few views: at 8 seconds none begins as a field, at 100 each does; a field that was begun is not thrown away."""
    results = {"distilled": {}} if len(steps) > 1 else {}
    saved = {"phase": list(steps)[-1], "log_bytes": 0, "results": results, "steps": steps}
    data = run_of(settings(tiny_scene, tmp_path)).data
    for budget in (8.0, 100.0):
        config = settings(tiny_scene, tmp_path, time_budget=budget, representation="octree", field={"few_views": 16})
        assert Run(config, data, clock.Clock(None, 0.0), saved).config.init == start
    assert Run(config, data, clock.Clock(None, 0.0), None).config.init == "mlp"


def test_the_time_of_earlier_sessions_counts(monkeypatch):
    """Also what passed before a process came so far as to make a clock."""
    monkeypatch.setattr(session.time, "perf_counter", lambda: 100.0)
    monkeypatch.setattr(clock, "process_seconds", lambda: 7.0)
    assert clock.Clock(98.0, 30.0).elapsed() == pytest.approx(32)
    assert clock.Clock(None, 30.0).elapsed() == pytest.approx(37)


def test_the_most_steps_draw_each_tile_so_often(tmp_path, tiny_scene):
    """12 pictures of 25 tiles, of which those that show the sphere count."""
    run = run_of(settings(tiny_scene, tmp_path, time_budget=100.0))
    plan = OctreePlan(run.config, run.data.training, 0)
    assert 100 < plan.foreground_tiles <= 300
    octree = run.config.octree

    def most_steps(epochs: float) -> float:
        return OctreeTrainer(
            run.data.training, (1, 1, 1), dataclasses.replace(octree, most_epochs=epochs), plan=plan
        ).most_steps

    drawn = octree.tiles[-1] * octree.foreground_share
    assert most_steps(1e4) == pytest.approx(1e4 * plan.foreground_tiles / drawn)
    assert most_steps(1.0) == most_steps(0.5) > 0  # however few the tiles


@pytest.mark.parametrize("left, scored", [(9, 3), (11, 4), (12, 5), (24, 5), (-1, 2)])
def test_slow_views_are_scored_as_the_budget_allows(tmp_path, tiny_scene, monkeypatch, left, scored):
    """By a clock that only pictures put on: 2 seconds each, 4 the first one, which makes what all share (prefiltered nodes).

    No view is drawn twice. Of 9 seconds 3 are left after the first and the last one: another of the five; of 24 after the first
    20, enough for all.
    """
    said, pictures = [], []
    run = run_of(settings(tiny_scene, tmp_path, time_budget=100.0))
    run.say = said.append
    held_out = run.data.training.evenly(5)

    def seconds() -> float:
        return 2.0 * len(pictures) + 2.0 * bool(pictures)

    def render(camera, background, outputs, early_stop_eps, lod):
        pictures.append(np.zeros((camera.intrinsics.height, camera.intrinsics.width, 3), np.float32))
        return {"rgb": pictures[-1]}

    monkeypatch.setattr(session.time, "perf_counter", seconds)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 100.0 - left + seconds())
    rows = affordable_scores(run, SimpleNamespace(kind="octree", render=render), held_out)["rows"]
    assert len(rows) == len(pictures) == scored
    names = [row["name"] for row in rows]
    assert names == [held_out.names[i] for i in evenly(5, scored)]
    assert (scored < 5) == any(f"{scored} of the 5 held-out views are scored" in line for line in said)


def test_a_representation_that_grew_is_asked_anew(tmp_path, tiny_scene, monkeypatch):
    """What finishing takes: once it has another size, and not again before a share of the budget is over."""
    now, asked = [0.0], []
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: now[0])
    monkeypatch.setattr(session.Run, "_time_to_finish", lambda self, phase=None: asked.append(now[0]) or 1.0)
    run = run_of(settings(tiny_scene, tmp_path, time_budget=100.0))
    phase, size = Pretended("octree"), [0]
    phase.size = lambda: f"{size[0]} leaves"
    phase.picture = lambda camera: None
    run.enter_stage(phase)
    asked.clear()
    for now[0], size[0] in [(5, 0), (6, 1), (9, 1), (10, 1), (12, 2), (17, 2), (30, 2)]:
        run.keep_time(phase)
    assert asked == [9, 17]


def test_a_field_tells_what_a_picture_takes_by_a_small_one(tmp_path, tiny_scene, monkeypatch):
    """By a clock that goes on a millisecond a pixel: the time kept is that of whole pictures, and none was drawn."""
    now, drawn = [0.0], []

    def picture(camera):
        drawn.append(camera.intrinsics.width * camera.intrinsics.height)
        now[0] += 1e-3 * drawn[-1]

    monkeypatch.setattr(session.time, "perf_counter", lambda: now[0])
    run = run_of(settings(tiny_scene, tmp_path, time_budget=1e4))
    lens, views = run.data.held_out.cameras[0].intrinsics, len(run.data.held_out)
    for timed_at in (1, 8):
        phase = Pretended("field", timed_at=timed_at)
        phase.picture = picture
        drawn.clear()
        kept = run._time_to_finish(phase)
        assert drawn == [lens.width * lens.height // timed_at**2]
        assert kept == pytest.approx(run.data.reading + 1.1e-3 * views * lens.width * lens.height, rel=1e-3)


@pytest.mark.parametrize("seconds, writing, kept", [
    (0.01, 0.0, 0.02 * 1.1), (0.01, 100.0, 5.0), (1.5, 0.0, 3.0), (1.5, 0.75, 3.75), (100.0, 0.0, 5.0), (0.01, 1.98, 2.0),
])  # fmt: skip
def test_what_comes_in_any_case_has_its_time(tmp_path, tiny_scene, monkeypatch, seconds, writing, kept):
    """By a clock that goes on so many seconds a picture, 10 s in all: a tenth, or writing and two views, or half."""
    now = [0.0]
    phase = Pretended("octree", writing=writing)
    monkeypatch.setattr(session.time, "perf_counter", lambda: now[0])
    phase.picture = lambda camera: now.__setitem__(0, now[0] + seconds)
    run = run_of(settings(tiny_scene, tmp_path, time_budget=10.0))
    assert run._time_to_finish(phase) == pytest.approx(kept, rel=0.02)
    assert run._time_to_finish() == pytest.approx(1.0)  # nothing is known of its pictures


def test_photographs_that_were_released_are_read_again(tmp_path, tiny_scene, monkeypatch):
    """... for the table of photographs; and large ones take longer in it."""
    monkeypatch.setattr(session.time, "perf_counter", lambda: 0.0)
    run = run_of(settings(tiny_scene, tmp_path, time_budget=1000.0))
    box = run.data.training.scene.aabb
    bounds = dataclasses.replace(run.data.training.scene, background_cube=4 * box)
    training = dataclasses.replace(run.data.training, scene=bounds)
    phase = Pretended("octree")
    phase.picture = lambda camera: None

    def kept(released: bool, pixels: int) -> float:
        phase.needs_images = lambda: not released
        first = dataclasses.replace(run.data.first, images=[np.zeros((pixels // 100, 100, 3), np.uint8)])
        data = dataclasses.replace(run.data, training=training, loading=7.0, first=first)
        return finishing.seconds_to_finish(run.config, data, 0.0, phase)

    rows = len(training)
    assert kept(False, 10_000) == pytest.approx(finishing.TABLE_SECONDS * rows)
    assert kept(True, 10_000) == pytest.approx(finishing.TABLE_SECONDS * rows + 7)
    assert kept(False, 8 * finishing.TABLE_PIXELS) == pytest.approx(8 * finishing.TABLE_SECONDS * rows)


@pytest.mark.parametrize("size, bands", [((1024, 1024), 1), ((4096, 3072), 8), ((40_000, 30), 1), ((500, 90_000), 65)])
def test_bands_tell_what_a_large_picture_takes(size, bands):
    """By a clock that goes on a microsecond a pixel: the whole picture's time, for a megapixel of it at most, from all of its
    height."""
    width, height = size
    camera = Camera(Intrinsics(width, height, 100.0, 100.0, width / 2, height / 2), np.eye(4))
    now, drawn = [0.0], []

    def picture(band):
        drawn.append(band.intrinsics)
        now[0] += 1e-6 * band.intrinsics.width * band.intrinsics.height

    phase = Pretended("octree")
    phase.picture = picture
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finishing.time, "perf_counter", lambda: now[0])
        assert finishing.seconds_of_picture(phase, camera) == pytest.approx(1e-6 * width * height)
    assert len(drawn) == bands and sum(lens.width * lens.height for lens in drawn) <= max(
        finishing.BAND_PIXELS, 32 * width
    )
    middles = [(height / 2 - lens.cy + lens.height / 2) / height for lens in drawn]
    np.testing.assert_allclose(middles, (np.arange(bands) + 0.5) / bands, atol=1 / height)


def test_previews_take_a_hundredth_of_a_budget_at_most(tmp_path, tiny_scene, monkeypatch):
    """By a clock that goes on 0.3 s a preview: one before it is known what they take, none that would exceed the share."""

    class Drawn(Pretended):
        preview_width = 400

        def picture(self, camera):
            now[0] += 0.3
            return np.zeros((camera.intrinsics.height, camera.intrinsics.width, 3), np.float32)

    now = [0.0]
    written = []
    monkeypatch.setattr(previews.pictures, "write_png", lambda path, image: written.append(path.name))
    for budget, moments in ((7.0, 0), (20.0, 1), (100.0, 3), (None, 5)):
        run = run_of(settings(tiny_scene, tmp_path, time_budget=budget))
        written.clear()
        with monkeypatch.context() as patch:
            patch.setattr(previews.time, "perf_counter", lambda: now[0])
            for moment in (0.03, 0.1, 0.3, 0.6, 1.0):
                run.preview(Drawn("octree"), moment)
        assert len(written) == moments
