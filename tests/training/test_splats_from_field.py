"""Splats of an object that few views show begin with a small field: the same bits however a run is cut, and what is said."""

import shutil

import numpy as np
import pytest

from nerfvol.config.training import SHORT_RUN, Config
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import EmptyModel
from nerfvol.files import run_folder
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.native import native
from nerfvol.region import SceneBounds
from nerfvol.training import begin, octree_start, session, splat_schedule
from nerfvol.training.clock import Clock
from nerfvol.training.memory.base import BASE_BYTES, gib
from nerfvol.training.memory.fields import FIELD_BYTES, distillation_bytes
from nerfvol.training.prepare import load_data
from nerfvol.training.splat_start import make_schedule_of
from nerfvol.training.train import optimise
from tests.fixtures.runs import TINY, metrics_of, run_of, settings, start

pytestmark = pytest.mark.skipif(native() is None, reason="the reference path takes minutes; it has a test of its own")

BOX = np.array([[-1.0] * 3, [1.0] * 3])
FIELD = {**TINY["field"], "few_views": 16, "steps": 60}


def splat_settings(scene, out, **more) -> Config:
    base = {"representation": "splats", "field": FIELD, "splats": {"steps": 12, "grow_every": 5, "max_splats": 3000}}
    return settings(scene, out, **{**base, "checkpoint_every": 1000, **more})


@pytest.mark.parametrize("views, given, expected", [
    (16, {}, "mlp"), (17, {}, "auto"), (16, {"time_budget": SHORT_RUN}, "auto"), (16, {"time_budget": 11.0}, "mlp"),
    (16, {"init": "hull"}, "hull"), (17, {"init": "mlp"}, "mlp"),
])  # fmt: skip
def test_which_splats_begin_with_a_field(views, given, expected):
    """Those of an object that few views show, where there is time."""
    config = Config(representation="splats", **given)
    assert config.for_views(views, SceneBounds(BOX, None, True)).init == expected
    photographs = SceneBounds(BOX, 16 * BOX, False)
    assert config.for_views(views, photographs).init == given.get("init", "auto")


@pytest.mark.parametrize(
    "phases, expected", [((), "mlp"), (("field",), "mlp"), (("field", "splats"), "mlp"), (("splats",), "auto")]
)
def test_a_resumed_run_keeps_its_start(phases, expected):
    for budget in (None, 5.0, 60.0) if phases else (None,):
        config = Config(representation="splats", time_budget=budget)
        assert config.for_views(8, SceneBounds(BOX, None, True), begun=phases).init == expected


def test_a_run_whose_field_came_out_empty_goes_on_without(tmp_path, tiny_scene):
    config = splat_settings(tiny_scene, tmp_path)
    data = load_data(config)
    for results, init in (({}, "auto"), ({"distilled": {}}, "mlp")):
        saved = {"phase": "splats", "log_bytes": 0, "results": results, "steps": {"field": 60, "splats": 1}}
        assert session.Run(config, data, Clock(0.0, 0.0), saved).config.init == init


@pytest.fixture(scope="module")
def whole(tmp_path_factory, tiny_scene):
    """A run, what it said, and its checkpoints by phase and step."""
    folder, checkpoints, said = tmp_path_factory.mktemp("whole"), {}, []
    save = session.Run.save

    def save_and_keep(self, phase):
        save(self, phase)
        checkpoints[phase.name, phase.steps_done] = folder / f"{phase.name}_{phase.steps_done}"
        shutil.copy(self.folder / run_folder.CHECKPOINT, checkpoints[phase.name, phase.steps_done])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session.Run, "save", save_and_keep)
        run = start(splat_settings(tiny_scene, folder / "run", checkpoint_every=1e-9), say=said.append)
    return run, said, checkpoints


def test_what_is_said_and_left(whole):
    run, said, checkpoints = whole
    told = "\n".join(said)
    assert "start: a field, then discs on the octree that it is distilled to, for there are only" in told
    assert "sizes of them before two backgrounds" in told and "to distil the field" in told
    assert "discs on what is seen of the" in told and "silhouettes" not in told
    metrics = metrics_of(run)
    assert metrics["steps"] == {"field": 60, "splats": 12}
    assert list(metrics["results"]) == ["field", "distilled", "fine_tuned"]
    assert metrics["results"]["fine_tuned"]["leaves"] is None
    assert load_checkpoint(checkpoints["splats", 12])["trainer"]["factors"] == [1]  # pictures of 40 pixels


def test_the_schedule_begins_with_a_half(tmp_path, tiny_scene, monkeypatch):
    monkeypatch.setattr(splat_schedule, "COARSEST_SIDE", 10)
    for init, factors in (("auto", (2, 1)), ("hull", (4, 2, 1))):
        (tmp_path / init).mkdir()
        run = run_of(splat_settings(tiny_scene, tmp_path / init, init=init))
        assert make_schedule_of(run, Photographs(run.data.training)).factors == factors


@pytest.mark.parametrize("phase, step", [("field", 59), ("splats", 1), ("splats", 7)])
def test_resumed_anywhere_the_splats_are_the_same(whole, tmp_path, tiny_scene, phase, step):
    run, _, checkpoints = whole
    out = tmp_path / "run"
    out.mkdir()
    shutil.copy(run / run_folder.CONFIG, out)
    save_checkpoint(out / run_folder.CHECKPOINT, load_checkpoint(checkpoints[phase, step]))
    said: list[str] = []
    again = start(splat_settings(tiny_scene, out, resume=True), say=said.append)
    assert f"resumed at step {step} of the {phase}" in said
    assert sum("to distil the field" in line for line in said) == (phase == "field")
    assert (again / run_folder.SPLATS).read_bytes() == (run / run_folder.SPLATS).read_bytes()


def test_an_empty_field_leaves_what_suits_the_data(tmp_path, tiny_scene, monkeypatch):
    """... where nobody asked for a field."""

    def empty(*_):
        raise EmptyModel("the field is empty")

    monkeypatch.setattr(octree_start, "_distilled", empty)
    said: list[str] = []
    run = start(splat_settings(tiny_scene, tmp_path / "auto"), say=said.append)
    assert any(line.startswith("start: without a field, for the field came out empty") for line in said)
    assert any("silhouettes" in line for line in said) and (run / run_folder.SPLATS).is_file()
    with pytest.raises(EmptyModel):
        start(splat_settings(tiny_scene, tmp_path / "asked", init="mlp"))


def test_memory_counts_the_field(tmp_path, tiny_scene):
    """At its peak it is what is there with the field or with the splats, whichever is more."""
    run = run_of(splat_settings(tiny_scene, tmp_path))
    said: list[str] = []
    run.say = said.append
    training, kept = run.data.training, run.data.held_out_bytes
    with run:
        begin.begin_splats(run, optimise)
    announced = next(line for line in said if "memory: " in line)
    field = distillation_bytes(training, 2, kept)
    assert f"before that {gib(field)[:3]}" in announced
    assert f"{gib(BASE_BYTES + FIELD_BYTES + field)} at its peak" in announced
