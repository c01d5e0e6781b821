"""The training run: memory released on the way, errors, what cannot be used, a real scene."""

import dataclasses
import gc
import json
import weakref

import numpy as np
import pytest

from nerfvol.config.assemble import read_yaml, write_yaml
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.training import prepare, session, train
from nerfvol.training.clock import Clock
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.prepare import claim_folder
from nerfvol.views import OctreeModel
from tests.fixtures.real import real_data
from tests.fixtures.runs import TINY, Pretended, log_of, metrics_of, run_of, settings, start
from tests.fixtures.tiny import write_scene


# ---------------------------------------------------------------- memory
@pytest.mark.parametrize("downscales, checkpoint_every, last", [
    ([2, 1, 1], 1000, 1), ([2, 1, 1], 1e-9, 1), ([1, 1, 1], 1e-9, 0)
])  # fmt: skip
def test_the_pictures_are_released_once_they_are_in_tiles(
    tmp_path, tiny_scene, monkeypatch, downscales, checkpoint_every, last
):
    """From the second step of the stage whose tiles serve to the end; ``last``: the first stage of the last resolution."""
    follow, held = session.Run.follow, []

    def look(self, phase, error):
        follow(self, phase, error)
        held.append((phase.stage, self.data.training.nbytes > 0))

    monkeypatch.setattr(session.Run, "follow", look)
    octree = {**TINY["octree"], "downscales": downscales}
    start(settings(tiny_scene, tmp_path, octree=octree, checkpoint_every=checkpoint_every, appearance="off"))
    stages, found = zip(*held, strict=True)
    needed = stages.index(last) + 1
    assert found == (True,) * needed + (False,) * (60 - needed)


def test_nothing_of_training_is_held_while_the_result_is_scored(tmp_path, tiny_scene, monkeypatch):
    trained, save, load = [], OctreeModel.save, train.load_model

    def watch(self, *rest):
        trained.append(weakref.ref(self.octree))
        return save(self, *rest)

    def look(path):
        gc.collect()
        assert trained[-1]() is None
        return load(path)

    monkeypatch.setattr(OctreeModel, "save", watch)
    monkeypatch.setattr(train, "load_model", look)
    start(settings(tiny_scene, tmp_path))
    assert len(trained) == 1


# ---------------------------------------------------------------- what cannot be used
def test_a_resumed_run_keeps_its_settings(tmp_path, tiny_scene, command):
    config = settings(tiny_scene, tmp_path)
    claim_folder(config)
    save_checkpoint(tmp_path / run_folder.CHECKPOINT, {"phase": "start"})
    before = (tmp_path / run_folder.CONFIG).read_text()
    code, _, err = command("train", "--resume", "--out", tmp_path, "--set", "octree.sh_degree=2")
    assert code == 2 and "octree.sh_degree = None, which cannot become 2" in err
    code, _, err = command("train", "--resume", "--out", tmp_path, "--background", "black")
    assert code == 2 and "background = " in err
    assert (tmp_path / run_folder.CONFIG).read_text() == before


def test_a_run_of_another_version_is_resumed(tmp_path, tiny_scene, command):
    """Whose settings had one fewer, and one by another name: what is not stated is as where nobody chose it."""
    claim_folder(settings(tiny_scene, tmp_path, octree={"tv_density": 1e-3}))
    written = read_yaml(tmp_path / run_folder.CONFIG)
    del written["octree"]["two_backgrounds"]
    written["octree"]["smooth_density"] = written["octree"].pop("tv_density")
    write_yaml(tmp_path / run_folder.CONFIG, written)
    save_checkpoint(tmp_path / run_folder.CHECKPOINT, {"phase": "done", "steps": 3})
    code, out, err = command("train", "--resume", "--out", tmp_path)
    assert code == 0 and "is finished (3 steps)" in out + err
    for change, said in (("two_backgrounds=true", "two_backgrounds = None"), ("tv_density=1e-4", "tv_density = 0.001")):
        code, _, err = command("train", "--resume", "--out", tmp_path, "--set", f"octree.{change}")
        assert code == 2 and f"octree.{said}, which cannot become" in err


@pytest.mark.parametrize("state", [
    {}, {"phase": "octree"}, {"phase": "lunch", "steps": 3}, {"phase": "done"},
    {"phase": "octree", "trainer": {"values": np.zeros(3)}}, {"phase": ["octree"]}, {"phase": "octree", "trainer": 3},
    {"phase": "octree", "trainer": {}, "elapsed": "long"}, {"phase": "field", "trainer": {}, "log_bytes": 0.5},
    {"phase": "octree", "trainer": {}, "results": []}, {"phase": "octree", "trainer": {}, "running": None},
])  # fmt: skip
def test_a_foreign_checkpoint_is_one_sentence(tmp_path, tiny_scene, command, state):
    claim_folder(settings(tiny_scene, tmp_path))
    filled = {"elapsed": 0.0, "log_bytes": 0, "results": {}, "steps": {}, "phase_started": 0.0, "running": 0.1}
    save_checkpoint(tmp_path / run_folder.CHECKPOINT, {**filled, **state} if "trainer" in state else state)
    code, _, err = command("train", "--resume", "--out", tmp_path)
    assert code == 2 and str(tmp_path / run_folder.CHECKPOINT) in err and err.count("\n") == 1, err


def test_a_scene_of_nothing_is_said_at_once(tmp_path):
    """White pictures on a white background hold nothing; on a black one they do."""
    from nerfvol.files.pictures import write_png

    scene = write_scene(tmp_path / "scene", {"train": 3, "val": 1}, size=24)
    for path in scene.rglob("*.png"):
        write_png(path, np.ones((24, 24, 3)))
    with pytest.raises(InputError, match="the training images are empty.*--background"):
        start(settings(scene, tmp_path / "run"))
    data = run_of(settings(scene, tmp_path, background="black")).data.training
    clear = dataclasses.replace(data, images=[np.zeros((24, 24, 4), np.uint8)] * len(data))
    for colour in np.arange(256) / 510:  # 127.5 is no level, whichever way it is rounded
        with pytest.raises(InputError, match="the training images are empty"):
            prepare.require_something(clear, (colour, colour, colour))


@pytest.mark.parametrize("init, section, more", [
    ("direct", "octree", {"steps": 1000, "prune_weight": 1.1}),  # no leaf can have that weight
    ("mlp", "field", {"steps": 1000, "shape": {**TINY["field"]["shape"], "density_bias": -60}}),
])  # fmt: skip
def test_a_collapse_is_said_early(tmp_path, tiny_scene, init, section, more):
    config = settings(tiny_scene, tmp_path, init=init, checkpoint_every=1000, **{section: {**TINY[section], **more}})
    with pytest.raises(InputError, match="collapsed to empty space.*--background.*or "):
        start(config)
    assert [line["progress"] for line in log_of(tmp_path) if line["progress"] > 0.2] == []


def test_a_field_that_nobody_asked_for_may_come_out_empty(tmp_path, tiny_scene, compiled):
    """Low density takes its place; a run resumed from there knows it, and that of one whose field became an octree."""
    shape = {**TINY["field"]["shape"], "density_bias": -60}
    config = settings(tiny_scene, tmp_path, field={**TINY["field"], "few_views": 100, "steps": 1000, "shape": shape})
    said = []
    start(config, say=said.append)
    assert sum("start: low density, for the field came out empty" in sentence for sentence in said) == 1
    metrics = metrics_of(tmp_path)
    assert metrics["init"] == "auto" and metrics["steps"]["octree"] == 60 and not metrics["results"]
    for results, init in (({}, "auto"), ({"distilled": {}}, "mlp")):
        saved = {"phase": "octree", "log_bytes": 0, "results": results, "steps": {"field": 32, "octree": 1}}
        assert session.Run(config, prepare.load_data(config), Clock(0.0, 0.0), saved).config.init == init


@pytest.mark.parametrize("error", ["nan", "inf"])
def test_divergence_does_not_reach_a_checkpoint(tmp_path, tiny_scene, monkeypatch, error):
    step = OctreeTrainer.step

    def explode(self, progress):
        report = step(self, progress)
        return dataclasses.replace(report, squared_error=float(error)) if self.steps_done == 6 else report

    monkeypatch.setattr(OctreeTrainer, "step", explode)
    with pytest.raises(InputError, match=f"diverged at step 6.*error is {error}.*learning rates"):
        start(settings(tiny_scene, tmp_path))
    assert load_checkpoint(tmp_path / run_folder.CHECKPOINT)["trainer"]["steps_done"] == 5


def test_the_running_error_follows_slowly(tmp_path, tiny_scene):
    run, phase = run_of(settings(tiny_scene, tmp_path)), Pretended("octree")
    phase.steps_done = 1
    for error, running in ((1.0, 1.0), (0.0, 0.98), (0.5, 0.98**2 + 0.01)):
        run.follow(phase, error)
        assert run.running == pytest.approx(running)


def test_fields_and_octrees_are_compared_on_parts_of_views(tmp_path, tiny_scene, monkeypatch):
    """A field renders slowly."""
    for most, size in [(200, 40), (40, 40), (13, 13)]:
        monkeypatch.setattr(prepare, "COMPARED_SIZE", most)
        run = run_of(settings(tiny_scene, tmp_path, compare_views=1))
        (camera,), (image,) = run.data.compared.cameras, run.data.compared.images
        assert image.shape[:2] == (size, size) and camera.intrinsics.width == size


# ---------------------------------------------------------------- a real scene
@pytest.mark.parametrize("init", ["direct", "mlp"])
def test_lego_small(tmp_path, init, command):
    """The whole way on real pictures, an eighth of their size, in a few seconds."""
    plan = {
        "octree": {**TINY["octree"], "steps": 150, "levels": [5, 6, 7], "tiles": [64, 128, 128]},
        "field": {"steps": 40, "downscales": [2, 1], "stage_ends": [0.5, 1.0], "march_steps": [64, 96],
                  "samples_per_step": 8192},
        "distill": {"level": 6, "coarse_level": 4},
        "compare_views": 1, "threads": 1,
    }  # fmt: skip
    (tmp_path / "plan.yaml").write_text(json.dumps(plan))
    code, out, err = command(
        "train", "--data", real_data("lego"), "--out", tmp_path / "run", "--downscale", 8,
        "--init", init, "--config", tmp_path / "plan.yaml",
    )  # fmt: skip
    assert code == 0, err
    metrics = json.loads((tmp_path / "run" / run_folder.METRICS).read_text())
    assert metrics["psnr"] > 20 and metrics["image_size"] == [100, 100]  # a white picture scores 9.8
    if init == "mlp":
        rows = metrics["results"]
        assert rows["fine_tuned"]["psnr"] > rows["distilled"]["psnr"] > 12
    code, *_ = command("render", tmp_path / "run", "--orbit", 2, "--size", "50x50", "--out", tmp_path / "views")
    assert code == 0
