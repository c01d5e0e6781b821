"""What an octree begins with: which start a run takes, and splats as one (resuming and threads: test_resume.py)."""

import dataclasses
import time

import numpy as np
import pytest

from nerfvol.config.octree import PHOTOGRAPHS_FROM_SURFACES, OctreeConfig
from nerfvol.config.splats import SplatConfig
from nerfvol.config.training import SHORT_RUN, SPLATS_UNTIL, Config
from nerfvol.datasets.load import load_dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.native import native
from nerfvol.region import SceneBounds
from nerfvol.training import begin, convert, octree_start, train
from nerfvol.training.appearance import Appearance
from nerfvol.training.clock import Clock
from nerfvol.training.memory.base import gib
from nerfvol.training.memory.octree import OctreePlan
from nerfvol.training.memory.splats import LOOK_BYTES, splat_bytes, starting_splats_bytes
from nerfvol.training.prepare import is_simulated, load_data
from nerfvol.training.progress import progress_bar
from nerfvol.training.session import Run
from nerfvol.training.splat_schedule import make_schedule
from nerfvol.training.splat_start import START_SHARE, START_STEPS, make_schedule_of, settings_of
from tests.fixtures.runs import TINY, metrics_of, run_of, settings, start

pytestmark = pytest.mark.skipif(native() is None, reason="the reference path takes minutes")
BOX = np.array([[-1.0] * 3, [1.0] * 3])
PHOTOGRAPHS = SceneBounds(BOX, 16 * BOX, False)


# ---------------------------------------------------------------- which start
@pytest.mark.parametrize("views, given, expected", [
    (17, {"time_budget": SPLATS_UNTIL}, "splats"), (17, {"time_budget": SPLATS_UNTIL + 1}, "mlp"),
    (16, {"time_budget": SPLATS_UNTIL}, "mlp"), (17, {}, "auto"), (100, {"time_budget": SHORT_RUN}, "auto"),
    (100, {"time_budget": SHORT_RUN + 1}, "splats"),
    (17, {"time_budget": 20.0, "init": "direct"}, "direct"), (17, {"time_budget": 20.0, "init": "mlp"}, "mlp"),
    (17, {"time_budget": 20.0, "representation": "splats"}, "auto"),
    (17, {"time_budget": 20.0, "representation": "field"}, "auto"),
    (17, {"time_budget": 20.0, "representation": "octree"}, "splats"),
    (17, {"time_budget": 20.0, "light": "suns.json"}, "auto"),
    (16, {"init": "splats"}, "splats"),
])  # fmt: skip
def test_octrees_of_objects_begin_as_splats_where_time_is_short(views, given, expected):
    """... and views are many, and with a field where it is long or they are few; what somebody chose stays."""
    config, scene = Config(**given), SceneBounds(BOX, None, True)
    assert config.for_views(views, scene).init == expected
    kept = "auto" if config.init == "auto" and views > config.field.few_views else expected
    assert config.for_views(views, scene, is_simulated=True).init == kept  # what may be a medium has no surfaces


def test_large_pictures_begin_as_splats_for_longer():
    """Two minutes of 800x800; no shorter for small ones."""
    scene = SceneBounds(BOX, None, True)
    for side, until in ((40, SPLATS_UNTIL), (400, SPLATS_UNTIL), (800, 120.0)):
        starts = [Config(time_budget=budget).for_views(100, scene, side=side).init for budget in (until, until + 1)]
        assert starts == ["splats", "mlp"]


@pytest.mark.parametrize("given, expected", [
    ({"time_budget": 5.0, "representation": "octree"}, "splats"),
    ({"time_budget": 900.0, "representation": "octree"}, "splats"),
    ({"representation": "octree"}, "auto"), ({"time_budget": 60.0}, "auto"),
    ({"time_budget": 60.0, "representation": "octree", "init": "direct"}, "direct"),
    ({"time_budget": 60.0, "representation": "field"}, "auto"),
])  # fmt: skip
@pytest.mark.parametrize("views", [3, 100])
def test_octrees_of_photographs_begin_as_splats(given, expected, views):
    """... however few and however long, where a budget says that seconds count; not where they may show a medium."""
    config, scene = Config(**given), PHOTOGRAPHS
    settled = config.for_views(views, scene)
    assert settled.init == expected and settled.octree == config.octree
    kept = "auto" if (expected, config.init) == ("splats", "auto") else expected
    assert config.for_views(views, scene, is_simulated=True).init == kept


@pytest.mark.parametrize("given, phases, expected", [
    ({}, (), "mlp"), ({}, ("splats", "octree"), "splats"), ({}, ("field",), "mlp"), ({}, ("octree",), "auto"),
    ({"init": "mlp"}, ("octree",), "mlp"), ({"representation": "octree"}, ("splats",), "splats"),
    ({"representation": "splats"}, ("splats",), "auto"), ({"representation": "field"}, ("field",), "auto"),
])  # fmt: skip
def test_a_resumed_run_keeps_its_start(given, phases, expected):
    """Photographs that are trained as splats have a phase of the same name, and stay what they are."""
    config = Config(**given, time_budget=100.0)
    assert config.for_views(100, SceneBounds(BOX, None, True), begun=phases).init == expected
    if phases:  # where one that is begun now would take another start
        now = dataclasses.replace(config, time_budget=20.0)
        assert now.for_views(100, SceneBounds(BOX, None, True), begun=phases).init == expected
    if "representation" not in given and "init" not in given:
        photographs = SceneBounds(BOX, 16 * BOX, False)
        assert config.for_views(100, photographs, begun=phases).for_scene(photographs).representation == "splats"


def test_another_budget_does_not_choose_another_start_half_way(tmp_path, tiny_scene):
    config = settings(tiny_scene, tmp_path, time_budget=20.0)
    run, data = run_of(config), load_data(config)
    assert run.config.init == "splats" and run.config.representation == "octree"
    config.time_budget = 1000.0
    saved = {"phase": "splats", "log_bytes": 0, "results": {}, "steps": {"splats": 3}}
    assert Run(config, data, Clock(0.0, 0.0), saved).config.init == "splats"
    config.time_budget = 20.0
    assert Run(config, data, Clock(0.0, 0.0), {**saved, "steps": {"octree": 3}}).config.init == "auto"
    config.time_budget = 1000.0
    assert Run(config, data, Clock(0.0, 0.0), None).config.init == "mlp"
    for results, init in (({}, "auto"), ({"converted": {}}, "splats")):  # splats that became no octree left low density
        both = {"phase": "octree", "log_bytes": 0, "results": results, "steps": {"splats": 3, "octree": 1}}
        assert Run(config, data, Clock(0.0, 0.0), both).config.init == init


def test_splats_whose_octree_fits_nowhere_leave_low_density(tmp_path, tiny_scene, monkeypatch):
    """... where nobody asked for them: an octree that grows as memory allows needs less."""
    monkeypatch.setattr(octree_start, "starting_splats_bytes", lambda *_: 1 << 60)
    said = []
    for init in ("auto", "splats"):
        (tmp_path / init).mkdir()
        run = run_of(settings(tiny_scene, tmp_path / init, time_budget=20.0, init=init))
        run.say = said.append
        assert run.config.init == "splats"
        if init == "splats":
            with pytest.raises(InputError, match="training would need"):
                begin.begin_octree(run, train.optimise)
        else:
            assert begin.begin_octree(run, train.optimise).first_stage == 0 and run.config.init == "auto"
            assert any("start: low density, for with splats first training would need" in sentence for sentence in said)


@pytest.mark.parametrize("name", ["truth.npz", "provenance.json"])
def test_what_lies_beside_simulated_images(tmp_path, name):
    transforms = tmp_path / "transforms_train.json"
    transforms.write_text("{}")
    assert not is_simulated(str(tmp_path)) and not is_simulated(str(transforms))
    (tmp_path / name).write_text("")
    assert is_simulated(str(tmp_path)) and is_simulated(str(transforms))


def test_the_choice_is_one_sentence():
    assert octree_start.why_start(Config(init="direct"), 8) is None and octree_start.why_start(Config(), 8) is None
    field, splats = (octree_start.why_start(Config(init=init, time_budget=30.0), 8) or "" for init in ("mlp", "splats"))
    assert "only 8 training views" in field and field.startswith("start: a field, ")
    long = octree_start.why_start(Config(init="mlp", time_budget=300.0), 100)
    assert long == ("start: a field, then the octree that it is distilled to, for there is time for one; --init direct "
                    "overrules")  # fmt: skip
    assert splats == ("start: splats, then the octree of the surfaces that they show, for 30 s are short; "
                      "--init direct overrules")  # fmt: skip
    photographs = octree_start.why_start(Config(init="splats", time_budget=90.0), 8, photographs=True)
    assert photographs == ("start: splats, then the octree of the surfaces that they show, for low density would leave haze in "
                           "photographs; --init direct overrules")  # fmt: skip


@pytest.mark.parametrize("given, reason", [
    ({"representation": "field", "init": "splats"}, "expected auto for field, got 'splats'"),
    ({"representation": "splats", "init": "splats"}, "octree for splats, got 'splats'"),
    ({"representation": "octree", "init": "hull"}, "expected auto, direct, mlp, splats for octree, got 'hull'"),
])  # fmt: skip
def test_a_start_of_another_representation_is_refused(given, reason):
    with pytest.raises(InputError, match=reason):
        Config(**given)


# ---------------------------------------------------------------- splats as a start
def test_photographs_from_surfaces_have_settings_of_their_own():
    """As `convert` has when it trains further; what was chosen stays, and objects have what they always have."""
    photographs, thing = SceneBounds(BOX, 16 * BOX, False), SceneBounds(BOX, None, True)
    known = PHOTOGRAPHS_FROM_SURFACES
    for config, expected in [
        (Config(init="splats", representation="octree"), (known["sparsity"], known["decay_from"])),
        (Config(init="splats", octree=OctreeConfig(sparsity=0.5)), (0.5, known["decay_from"])),
        (Config(init="direct"), (1.2e-3, 0.35)),
    ]:
        octree = config.for_scene(photographs).octree
        assert (octree.sparsity, octree.decay_from) == expected
    assert Config(init="splats").for_scene(thing).octree == Config(init="direct").for_scene(thing).octree


def test_they_take_a_share_of_the_time_or_few_steps(tmp_path, tiny_scene, monkeypatch):
    monkeypatch.setattr(Run, "_time_to_finish", lambda self, phase=None: 10.0)
    monkeypatch.setattr(Clock, "elapsed", lambda self: 10.0)
    run = run_of(settings(tiny_scene, tmp_path, init="splats", time_budget=80.0, splats={"steps": 5000}))
    assert settings_of(run.config).steps == START_STEPS
    photographs = Photographs(run.data.training)
    sizes = [(40, 40)] * 12
    assert make_schedule_of(run, photographs) == make_schedule(START_SHARE * 60, sizes, False)
    run = run_of(settings(tiny_scene, tmp_path, init="splats", splats={"steps": 5000}))
    assert make_schedule_of(run, photographs) == make_schedule(START_STEPS / 80, sizes, False)
    assert settings_of(Config(representation="octree", splats=SplatConfig(steps=3))).steps == 3
    assert settings_of(Config(representation="splats")).steps == SplatConfig().steps


def test_the_larger_of_both_is_announced(tiny_scene):
    dataset = load_dataset(tiny_scene)
    photographs, config = Photographs(dataset), SplatConfig(sh_degree=1)
    schedule = make_schedule(20.0, [(40, 40)] * 12, False, 10**6)
    few, many = (starting_splats_bytes(dataset, photographs, schedule, config, 77, n) for n in (1, 10**9))
    assert few > splat_bytes(schedule, config) + dataset.nbytes + 77
    assert many - few == LOOK_BYTES * 10**9 - splat_bytes(schedule, config)
    plain = OctreePlan(Config().for_scene(dataset.scene), dataset, 77)
    after = OctreePlan(Config().for_scene(dataset.scene), dataset, 77, 7 << 30)
    assert "splats" not in plain.sentence()
    assert f"before that {gib(7 << 30)} for splats" in after.sentence()
    assert after.sentence().startswith(f"{gib((7 << 30) + (160 << 20))} at its peak")


def test_an_octree_is_there_sooner_than_from_low_density(tmp_path, tiny_scene):
    """The same 300 steps of the octree, after splats of 120: the picture is better than their surfaces', and by a decibel
    better than from low density."""
    lines, phases = [], []
    more = {"octree": {**TINY["octree"], "steps": 300}, "checkpoint_every": 1000}

    def bar(name, done):
        phases.append(name)
        return progress_bar(name, done)

    splats = settings(tiny_scene, tmp_path / "splats", init="splats", splats={"steps": 120}, **more)
    splats, fog = (metrics_of(start(config, say=lines.append, bar=bar)) for config in
                   (splats, settings(tiny_scene, tmp_path / "fog", init="direct", **more)))  # fmt: skip
    assert phases == ["splats", "octree", "octree"]
    assert splats["psnr"] > fog["psnr"] + 1
    rows = splats["results"]
    assert (
        list(rows) == ["splats", "converted", "fine_tuned"] and rows["fine_tuned"]["psnr"] > rows["converted"]["psnr"]
    )
    assert rows["splats"]["steps"] == splats["steps"]["splats"] == 120 and rows["splats"]["leaves"] is None
    assert any(f"became {rows['converted']['leaves']:,} leaves" in line for line in lines)


def test_where_no_splat_can_become_a_leaf_it_is_said(tmp_path, tiny_scene, monkeypatch):
    """Splats far outside of the scene's region: one sentence, no octree."""
    from nerfvol.training import splat_start

    begin = splat_start.start_splats

    def far_away(run, photographs, most):
        splats, distance = begin(run, photographs, most)
        splats.means[...] += 100
        return splats, distance

    monkeypatch.setattr(splat_start, "start_splats", far_away)
    run = run_of(settings(tiny_scene, tmp_path, init="splats"))
    plan = octree_start.prepare_splats(run)
    with pytest.raises(InputError, match="none of the [0-9]+ splats lies in the region"):
        octree_start.start_from_splats(run, plan, Appearance(12, "off"), Appearance(12, "off"), lambda run, phase: None)


@pytest.mark.parametrize("init", ["auto", "splats"])
def test_splats_that_show_no_surfaces_leave_low_density(tmp_path, tiny_scene, monkeypatch, init):
    """... where they were chosen, not asked for."""

    def nothing(*arguments, **settings):
        raise InputError("no splat is seen")

    monkeypatch.setattr(convert, "surfaces_of", nothing)
    said, config = [], settings(tiny_scene, tmp_path, time_budget=20.0, init=init)
    if init == "splats":
        with pytest.raises(InputError, match="no splat is seen"):
            train.train(config, started=time.perf_counter() - 100, say=said.append)
    else:
        assert train.train(config, started=time.perf_counter() - 100, say=said.append) is not None
        assert any("low density, for the splats became no octree: no splat is seen" in sentence for sentence in said)
