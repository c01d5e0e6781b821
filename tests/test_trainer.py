"""The training run: exact resumption, independence of threads and clock, budgets, interruptions, endings."""

import dataclasses
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
from tiny import write_scene

import nerfvol
from nerfvol import cli, runs, session, trainer
from nerfvol.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.config import Config, assemble
from nerfvol.datasets import load_dataset
from nerfvol.errors import InputError
from nerfvol.finetune import OctreeConfig, OctreeTrainer
from nerfvol.octree_io import load_octree

ROOT = Path(nerfvol.__file__).parents[1]
TINY = {
    "threads": 1,
    "checkpoint_every": 1e-9,  # after every step
    "storage": "float32",
    "octree": {
        "steps": 60, "levels": [4, 5, 5], "downscales": [2, 1, 1], "until": [0.3, 0.6, 1.0], "tiles": [16, 16, 16],
        "prunes": [1, 1, 1], "prune_steps": 2,
    },
    "field": {
        "steps": 20, "downscales": [4, 2], "stage_ends": [0.3, 1.0], "march_steps": [32, 48], "samples_per_step": 2048,
        "max_rays": 512, "grid_resolution": 16,
        "shape": {"width": 16, "hash_levels": 4, "hash_log2_table": 10, "hash_min": 4, "hash_max": 24},
    },
    "distill": {"level": 5, "coarse_level": 3, "compare_downscale": 2, "visibility_downscale": 1},
}  # fmt: skip


def settings(scene, out, **more) -> Config:
    return assemble(Config, (TINY, "tiny"), ({"data": str(scene), "out": str(out), **more}, "test"))


def start(config: Config, **keywords) -> Path:
    runs.prepare(config)
    cli.set_threads(config.threads)
    return trainer.train(config, **keywords)


def product(run: Path) -> bytes:
    """The octree file, without the lengths of its metadata's paths mattering: all runs read the same scene."""
    return (run / runs.OCTREE).read_bytes()


def log_of(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / runs.LOG).read_text().splitlines()]


def metrics_of(run: Path) -> dict:
    return json.loads((run / runs.METRICS).read_text())


@dataclasses.dataclass
class Whole:
    """An uninterrupted run and a copy of each checkpoint it wrote, with its phase and step."""

    run: Path
    checkpoints: dict[tuple[str, int], Path]


@pytest.fixture(scope="module", params=["direct", "mlp"])
def whole(request, tmp_path_factory, tiny_scene) -> Whole:
    folder = tmp_path_factory.mktemp("whole")
    checkpoints = {}
    save = session.Run.save

    def save_and_keep(self, phase):
        save(self, phase)
        kept = folder / f"{phase.name}{phase.steps_done}"
        shutil.copy(self.folder / runs.CHECKPOINT, kept)
        checkpoints[phase.name, phase.steps_done] = kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session.Run, "save", save_and_keep)
        run = start(settings(tiny_scene, folder / "run", init=request.param))
    return Whole(run, checkpoints)


# ---------------------------------------------------------------- the same numbers
def test_resumed_anywhere_the_octree_is_the_same(whole, tmp_path, tiny_scene):
    """From the checkpoint after every step at which something begins or ends, and some between: bit by bit."""
    stages = {}
    for (phase, step), path in whole.checkpoints.items():
        state = load_checkpoint(path)["trainer"]
        stages[phase, step] = (state.get("stage"), state.get("prunings"), len(state.get("node_mask", [])))
    keys = list(whole.checkpoints)
    changes = [i for i in range(1, len(keys)) if stages[keys[i]] != stages[keys[i - 1]]]
    assert {(phase, 0) for phase, _ in keys} <= set(keys)  # each phase begins with one
    assert {stages[key][0] for key in keys if key[0] == "octree"} >= {1, 2}  # a distilled octree skips the first stage
    wanted = {0, len(keys) - 1, 7, *changes, *(i - 1 for i in changes)}
    init = load_config(whole.run)["init"]
    for index in sorted(wanted):
        phase, step = keys[index]
        out = tmp_path / f"{phase}{step}"
        out.mkdir()
        shutil.copy(whole.run / runs.CONFIG, out)
        shutil.copy(whole.checkpoints[phase, step], out / runs.CHECKPOINT)
        start(settings(tiny_scene, out, init=init, resume=True, checkpoint_every=1000))
        assert product(out) == product(whole.run), f"resumed at step {step} of the {phase}"
        assert metrics_of(out)["steps"] == metrics_of(whole.run)["steps"]
        assert list(metrics_of(out)["stages"]) == list(metrics_of(whole.run)["stages"])


def load_config(run: Path) -> dict:
    return runs.run_settings(run)


def test_threads_change_nothing(whole, tmp_path, tiny_scene):
    init = load_config(whole.run)["init"]
    try:
        run = start(settings(tiny_scene, tmp_path / "two", init=init, threads=2, checkpoint_every=1000))
    finally:
        cli.set_threads(1)
    assert product(run) == product(whole.run)


def test_another_seed_changes_something(whole, tmp_path, tiny_scene):
    init = load_config(whole.run)["init"]
    run = start(settings(tiny_scene, tmp_path / "other", init=init, seed=1, checkpoint_every=1000))
    a, b = load_octree(run / runs.OCTREE)[0], load_octree(whole.run / runs.OCTREE)[0]
    assert a.values.shape != b.values.shape or not np.array_equal(a.values, b.values)


def test_without_a_budget_the_clock_changes_nothing(whole, tmp_path, tiny_scene, monkeypatch):
    """A clock that jumps by minutes between any two looks at it."""
    jumps = iter(range(0, 10**9, 137))
    monkeypatch.setattr(session.time, "perf_counter", lambda: float(next(jumps)))
    run = start(settings(tiny_scene, tmp_path / "run", init=load_config(whole.run)["init"], checkpoint_every=1000))
    assert product(run) == product(whole.run)


# ---------------------------------------------------------------- what a run leaves
def test_records(whole, command):
    metrics = json.loads((whole.run / runs.METRICS).read_text())
    code, *_ = command("eval", whole.run, "--split", "val", "--threads", 1, "--json", whole.run / "eval.json")
    record = json.loads((whole.run / "eval.json").read_text())
    assert code == 0
    for key in ("psnr", "ssim", "image_size", "background", "n_images", "threads", "hardware", "split"):
        assert metrics[key] == record[key], key
    assert metrics["leaves"] == load_octree(whole.run / runs.OCTREE)[0].n_leaves
    assert metrics["steps"]["octree"] == 60 and metrics["MB"] > 0 and metrics["vertices"] > metrics["leaves"]
    mlp = metrics["init"] == "mlp"
    assert list(metrics["stages"]) == (["field", "distilled", "fine_tuned"] if mlp else [])
    for row in metrics["stages"].values():
        assert {"psnr", "ssim", "seconds", "leaves", "MB", "seconds_per_frame"} <= row.keys()
    assert (whole.run / runs.DISTILLED).exists() == mlp
    names = {path.name for path in (whole.run / runs.PREVIEWS).iterdir()}
    assert {"octree_010.png", "octree_100.png"} <= names and ("field_100.png" in names) == mlp
    assert not [path.name for path in whole.run.iterdir() if ".tmp" in path.name]
    from nerfvol.render import find_orbit

    orbit = find_orbit("nowhere", *load_octree(whole.run / runs.OCTREE))
    assert orbit["radius"] == pytest.approx(3.2, rel=0.05) and orbit["center"] == pytest.approx([0, 0, 0], abs=0.05)


def test_training_gains(whole):
    """The picture is far better than the plain background's; fine-tuning gains on a distilled poor field."""
    metrics = json.loads((whole.run / runs.METRICS).read_text())
    if metrics["init"] == "direct":
        assert metrics["psnr"] > 18  # a white picture scores 12
    else:
        assert metrics["stages"]["fine_tuned"]["psnr"] > metrics["stages"]["distilled"]["psnr"] + 1


def test_a_finished_run_says_so(whole, command):
    before = product(whole.run)
    code, out, _ = command("train", "--resume", "--out", whole.run)
    assert code == 0 and "is finished" in out and "nothing to resume" in out
    assert product(whole.run) == before


# ---------------------------------------------------------------- interruptions
def resumed(whole: Whole, out: Path, scene: Path, step: int, change=lambda state: None) -> Path:
    """The run as it goes on in ``out`` from the checkpoint after a step of the octree, which ``change`` may edit."""
    out.mkdir()
    shutil.copy(whole.run / runs.CONFIG, out)
    shutil.copy(whole.run / runs.LOG, out)
    state = load_checkpoint(whole.checkpoints["octree", step])
    change(state)
    save_checkpoint(out / runs.CHECKPOINT, state)
    init = load_config(whole.run)["init"]
    return start(settings(scene, out, init=init, resume=True, checkpoint_every=1000))


def test_the_log_goes_on_where_the_checkpoint_left_it(whole, tmp_path, tiny_scene):
    """What a killed run logged after its last checkpoint is cut off; what it logged before stays."""
    for step in (45, 55):  # before and after the line of step 50
        run = resumed(whole, tmp_path / str(step), tiny_scene, step)
        lines, expected = ([(line["phase"], line["step"]) for line in log_of(r)] for r in (run, whole.run))
        assert lines == expected and lines[-2:] == [("octree", 50), ("octree", 60)]


def test_clock_and_running_error_go_on_where_the_checkpoint_left_them(whole, tmp_path, tiny_scene):
    """Years on the clock and a running error of 1 at step 55: five steps later the log and the scores know of both."""
    change = {"elapsed": 3e8, "phase_started": 2e8, "running": 1.0}
    run = resumed(whole, tmp_path / "run", tiny_scene, 55, lambda state: state.update(change))
    last, metrics = log_of(run)[-1], metrics_of(run)
    assert last["step"] == 60 and 3e8 < last["seconds"] < metrics["seconds"] < 3.1e8
    new_share = 1 - session.RUNNING**5  # of the five steps' errors, each below 1
    assert 10 ** (-last["psnr"] / 10) == pytest.approx(1 - new_share, abs=new_share)
    if metrics["stages"]:
        assert 1e8 < metrics["stages"]["fine_tuned"]["seconds"] < 1.1e8


@pytest.mark.parametrize("change", [
    lambda t: t.update(values=t["values"][:-1], moments=t["moments"][:-1]), lambda t: t.update(moments=t["moments"][:, :4]),
    lambda t: t.update(error=t["error"][:-1]), lambda t: t.update(footprint=t["footprint"][None]),
    lambda t: t.update(node_mask=t["node_mask"][:-1]), lambda t: t.update(stage="first"), lambda t: t.pop("rich"),
])  # fmt: skip
def test_a_checkpoint_whose_parts_do_not_fit_is_refused(whole, tmp_path, tiny_scene, change):
    with pytest.raises(InputError):
        resumed(whole, tmp_path / "run", tiny_scene, 45, lambda state: change(state["trainer"]))


@pytest.mark.parametrize("downscales, checkpoint_every, last", [
    ([2, 1, 1], 1000, 1), ([2, 1, 1], 1e-9, 1), ([1, 1, 1], 1e-9, 0)
])  # fmt: skip
def test_the_pictures_are_let_go_once_they_are_in_tiles(
    tmp_path, tiny_scene, monkeypatch, downscales, checkpoint_every, last
):
    """From the second step of the stage whose tiles serve to the end; ``last``: the first stage of the last resolution."""
    follow, held = session.Run.follow, []

    def look(self, phase, error):
        follow(self, phase, error)
        held.append((phase.stage, "images" in vars(self.dataset)))

    monkeypatch.setattr(session.Run, "follow", look)
    octree = {**TINY["octree"], "downscales": downscales}
    start(settings(tiny_scene, tmp_path, octree=octree, checkpoint_every=checkpoint_every))
    stages, found = zip(*held, strict=True)
    needed = stages.index(last) + 1
    assert found == (True,) * needed + (False,) * (60 - needed)


def test_nothing_of_training_is_held_while_the_result_is_scored(tmp_path, tiny_scene, monkeypatch):
    trained, save, load = [], trainer.save_octree, trainer.load_octree

    def watch(path, octree, *rest):
        trained.append(weakref.ref(octree))
        return save(path, octree, *rest)

    def look(path):
        gc.collect()
        assert trained[-1]() is None
        return load(path)

    monkeypatch.setattr(trainer, "save_octree", watch)
    monkeypatch.setattr(trainer, "load_octree", look)
    start(settings(tiny_scene, tmp_path))
    assert len(trained) == 1


def test_a_run_outside_the_main_thread_leaves_signals_alone(tmp_path, tiny_scene):
    run = session.Run(settings(tiny_scene, tmp_path), session.Clock(None, 0.0), None)
    handler, seen = signal.getsignal(signal.SIGINT), []

    def work():
        with run.interruptible():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [handler]


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path, tiny_scene, command, monkeypatch):
    (tmp_path / "tiny.yaml").write_text(json.dumps({**TINY, "checkpoint_every": 1000}))
    follow = session.Run.follow

    def press(self, phase, error):
        follow(self, phase, error)
        if phase.steps_done == 33:
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(session.Run, "follow", press)
    arguments = ("--data", tiny_scene, "--out", tmp_path / "run", "--config", tmp_path / "tiny.yaml")
    code, out, err = command("train", *arguments)
    assert code == 130 and "interrupted" in err
    assert f"saved at step 33 of the octree; to go on: nerfvol train --resume --out {tmp_path / 'run'}" in out
    assert signal.getsignal(signal.SIGINT) is handler
    monkeypatch.undo()
    code, out, _ = command("train", "--resume", "--out", tmp_path / "run")
    assert code == 0 and "resumed at step 33 of the octree" in out
    start(settings(tiny_scene, tmp_path / "straight", checkpoint_every=1000))
    assert product(tmp_path / "run") == product(tmp_path / "straight")


def test_a_second_ctrl_c_stops_at_once(tmp_path, tiny_scene):
    run = session.Run(settings(tiny_scene, tmp_path), session.Clock(None, 0.0), None)
    with run.interruptible():
        os.kill(os.getpid(), signal.SIGINT)
        assert run.interrupted
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)


def test_kill_9_costs_no_file(tmp_path, tiny_scene):
    """Killed at an arbitrary moment: the checkpoint is whole, the log is cut back, the numbers are the same."""
    plan = {**TINY, "octree": {**TINY["octree"], "steps": 400}, "data": str(tiny_scene), "checkpoint_every": 0.05}
    (tmp_path / "tiny.yaml").write_text(json.dumps(plan))
    run = tmp_path / "run"
    arguments = ["train", "--out", str(run), "--config", str(tmp_path / "tiny.yaml")]
    process = subprocess.Popen([sys.executable, "-m", "nerfvol.cli", *arguments], cwd=ROOT, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not (run / runs.LOG).exists() or len((run / runs.LOG).read_text().splitlines()) < 3:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.002)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert load_checkpoint(run / runs.CHECKPOINT)["phase"] == "octree"
    start(assemble(Config, (plan, "plan"), ({"out": str(run), "resume": True}, "test")))
    start(assemble(Config, (plan, "plan"), ({"out": str(tmp_path / "straight")}, "test")))
    assert product(run) == product(tmp_path / "straight")
    steps = [line["step"] for line in log_of(run)]
    assert steps == sorted(set(steps)) == [line["step"] for line in log_of(tmp_path / "straight")]


# ---------------------------------------------------------------- budgets
@pytest.mark.parametrize("init", ["direct", "mlp"])
def test_a_budget_ends_every_stage(tmp_path, tiny_scene, init, monkeypatch):
    """More steps than fit: by a clock that goes on 20 ms at every look, each phase gets its share and is finished."""
    looks = iter(range(10**9))
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 0.02 * next(looks))
    monkeypatch.setattr(session, "FINISH_SECONDS", 100.0)
    config = settings(tiny_scene, tmp_path, init=init, time_budget=10.0, checkpoint_every=1000)
    config.octree.steps = config.field.steps = 10**9
    start(config)
    metrics = json.loads((tmp_path / runs.METRICS).read_text())
    log = log_of(tmp_path)
    assert metrics["psnr"] > 12 and metrics["time_budget"] == 10
    assert log[-1]["phase"] == "octree" and log[-1]["progress"] >= 1 and log[-1]["stage"] == 2
    # All of the time but what is kept to finish: 2 seconds here, by the bound on its share.
    assert log[-1]["seconds"] == pytest.approx(8, abs=0.1)
    if init == "mlp":
        assert metrics["stages"]["field"]["seconds"] == pytest.approx(session.FIELD_SHARE * 8, abs=0.1)


@dataclasses.dataclass
class Pretended:
    """What a run asks of a phase for its plans."""

    name: str
    n_leaves: int = 0


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


def test_time_is_kept_to_score_every_view(tmp_path, tiny_scene, monkeypatch):
    """By a clock that goes on a second at every look, with a picture that takes 10 more, on one thread.

    A view takes one second to score, and to render a guess of 0.1 microseconds a pixel before there is a picture and 11
    seconds then. Two views are held out; a tenth is added for what else they need.
    """
    seconds = [0.0]

    def look() -> float:
        seconds[0] += 1
        return seconds[0]

    def picture(camera):
        seconds[0] += 10

    monkeypatch.setattr(session.time, "perf_counter", look)
    cli.set_threads(1)
    run = session.Run(settings(tiny_scene, tmp_path, time_budget=1000.0), session.Clock(0.0, 0.0), None)
    monkeypatch.setattr(session.Clock, "elapsed", lambda self: 100.0)
    writing = session.FINISH_SECONDS + session.FINISH_SECONDS_PER_LEAF * 1_000_000
    octree = Pretended("octree")
    assert 100 / run.progress(octree) == pytest.approx(1000 - writing - 2.2 * (1 + 1600e-7))
    octree.picture, octree.stage, octree.trainer, octree.n_leaves = picture, 0, Pretended("trainer"), 3_000_000
    octree.trainer.bank = None
    run.enter_stage(octree)
    writing = session.FINISH_SECONDS + session.FINISH_SECONDS_PER_LEAF * 3_000_000
    assert 100 / run.progress(octree) == pytest.approx(1000 - writing - 2.2 * (1 + 11))


def test_a_budget_is_kept(tmp_path, tiny_scene):
    """On the real clock; a step of this scene takes milliseconds."""
    config = settings(tiny_scene, tmp_path, time_budget=3.0, checkpoint_every=1000)
    config.octree.steps = 10**9
    started = time.perf_counter()
    start(config, started=started)
    log = log_of(tmp_path)
    assert log[-1]["progress"] >= 1 and log[-1]["seconds"] > 1.5  # no upper bound: a busy machine may freeze it


def test_a_budget_that_is_over_before_the_start(tmp_path, tiny_scene):
    start(settings(tiny_scene, tmp_path, time_budget=1.0), started=time.perf_counter() - 10)
    assert json.loads((tmp_path / runs.METRICS).read_text())["steps"] == {"octree": 0}
    assert load_octree(tmp_path / runs.OCTREE)[0].n_leaves > 0


def test_the_time_of_earlier_sessions_counts(tmp_path, tiny_scene):
    clock = session.Clock(time.perf_counter() - 2, 30.0)
    assert clock.elapsed() == pytest.approx(32, abs=0.5)
    assert 0 < session.Clock(None, 0.0).elapsed() < 3600


# ---------------------------------------------------------------- what cannot be used
def test_a_resumed_run_keeps_its_settings(tmp_path, tiny_scene, command):
    config = settings(tiny_scene, tmp_path)
    runs.prepare(config)
    save_checkpoint(tmp_path / runs.CHECKPOINT, {"phase": "start"})
    before = (tmp_path / runs.CONFIG).read_text()
    code, _, err = command("train", "--resume", "--out", tmp_path, "--set", "octree.sh_degree=2")
    assert code == 2 and "octree.sh_degree = 1, which cannot become 2" in err
    code, _, err = command("train", "--resume", "--out", tmp_path, "--background", "black")
    assert code == 2 and "background = " in err
    assert (tmp_path / runs.CONFIG).read_text() == before


@pytest.mark.parametrize("state", [
    {}, {"phase": "octree"}, {"phase": "lunch", "steps": 3}, {"phase": "done"},
    {"phase": "octree", "trainer": {"values": np.zeros(3)}}, {"phase": ["octree"]}, {"phase": "octree", "trainer": 3},
    {"phase": "octree", "trainer": {}, "elapsed": "long"}, {"phase": "field", "trainer": {}, "log_bytes": 0.5},
    {"phase": "octree", "trainer": {}, "stages": []}, {"phase": "octree", "trainer": {}, "running": None},
])  # fmt: skip
def test_a_foreign_checkpoint_is_one_sentence(tmp_path, tiny_scene, command, state):
    runs.prepare(settings(tiny_scene, tmp_path))
    filled = {"elapsed": 0.0, "log_bytes": 0, "stages": {}, "steps": {}, "phase_started": 0.0, "running": 0.1}
    save_checkpoint(tmp_path / runs.CHECKPOINT, {**filled, **state} if "trainer" in state else state)
    code, _, err = command("train", "--resume", "--out", tmp_path)
    assert code == 2 and str(tmp_path / runs.CHECKPOINT) in err and err.count("\n") == 1, err


def test_a_scene_of_nothing_is_said_at_once(tmp_path):
    """White pictures on a white background hold nothing; on a black one they do."""
    from nerfvol.pictures import write_png

    scene = write_scene(tmp_path / "scene", {"train": 3, "val": 1}, size=24)
    for path in scene.rglob("*.png"):
        write_png(path, np.ones((24, 24, 3)))
    with pytest.raises(InputError, match="the training images are empty.*--background"):
        start(settings(scene, tmp_path / "run"))
    assert session.Run(settings(scene, tmp_path, background="black"), session.Clock(0.0, 0.0), None).dataset


@pytest.mark.parametrize("init, section, more", [
    ("direct", "octree", {"steps": 1000, "prune_weight": 1.1}),  # no leaf can have that weight
    ("mlp", "field", {"steps": 1000, "shape": {**TINY["field"]["shape"], "density_bias": -60}}),
])  # fmt: skip
def test_a_collapse_is_said_early(tmp_path, tiny_scene, init, section, more):
    config = settings(tiny_scene, tmp_path, init=init, checkpoint_every=1000, **{section: {**TINY[section], **more}})
    with pytest.raises(InputError, match="collapsed to empty space.*--background.*or "):
        start(config)
    assert [line["progress"] for line in log_of(tmp_path) if line["progress"] > 0.2] == []


@pytest.mark.parametrize("error", ["nan", "inf"])
def test_divergence_does_not_reach_a_checkpoint(tmp_path, tiny_scene, monkeypatch, error):
    step = trainer.OctreePhase.step

    def explode(self, progress):
        found, samples = step(self, progress)
        return (float(error) if self.steps_done == 6 else found), samples

    monkeypatch.setattr(trainer.OctreePhase, "step", explode)
    with pytest.raises(InputError, match=f"diverged at step 6.*error is {error}.*learning rates"):
        start(settings(tiny_scene, tmp_path))
    assert load_checkpoint(tmp_path / runs.CHECKPOINT)["trainer"]["step_count"] == 5


def test_the_running_error_follows_slowly(tmp_path, tiny_scene):
    run, phase = session.Run(settings(tiny_scene, tmp_path), session.Clock(None, 0.0), None), Pretended("octree")
    phase.steps_done = 1
    for error, running in ((1.0, 1.0), (0.0, 0.98), (0.5, 0.98**2 + 0.01)):
        run.follow(phase, error)
        assert run.running == pytest.approx(running)


def test_a_run_scores_itself_on_views_from_all_around(tiny_scene):
    dataset = load_dataset(tiny_scene, "train")
    few = session.some_views(dataset, 3)
    assert few.names == [dataset.names[i] for i in (0, 6, 11)]
    for name, image, camera in zip(few.names, few.images, few.cameras, strict=True):
        i = dataset.names.index(name)
        assert image is dataset.images[i] and camera is dataset.cameras[i]
    assert session.some_views(dataset, 12) is dataset


# ---------------------------------------------------------------- a real scene
@pytest.mark.skipif("NERFVOL_DATA" not in os.environ, reason="NERFVOL_DATA names no folder of real scenes")
@pytest.mark.parametrize("init", ["direct", "mlp"])
def test_lego_small(tmp_path, init, command):
    """The whole way on real pictures, an eighth of their size, in a few seconds."""
    plan = {
        "octree": {**TINY["octree"], "steps": 150, "levels": [5, 6, 7], "tiles": [64, 128, 128]},
        "field": {"steps": 40, "downscales": [2, 1], "stage_ends": [0.5, 1.0], "march_steps": [64, 96],
                  "samples_per_step": 8192},
        "distill": {"level": 6, "coarse_level": 4, "compare_views": 1, "visibility_downscale": 2},
        "compare_views": 1, "threads": 1,
    }  # fmt: skip
    (tmp_path / "plan.yaml").write_text(json.dumps(plan))
    code, out, err = command(
        "train", "--data", Path(os.environ["NERFVOL_DATA"]) / "lego", "--out", tmp_path / "run", "--downscale", 8,
        "--init", init, "--config", tmp_path / "plan.yaml",
    )  # fmt: skip
    assert code == 0, err
    metrics = json.loads((tmp_path / "run" / runs.METRICS).read_text())
    assert metrics["psnr"] > 20 and metrics["image_size"] == [100, 100]  # a white picture scores 9.8
    if init == "mlp":
        rows = metrics["stages"]
        assert rows["fine_tuned"]["psnr"] > rows["distilled"]["psnr"] > 12
    code, *_ = command("render", tmp_path / "run", "--orbit", 2, "--size", "50x50", "--out", tmp_path / "views")
    assert code == 0


# ---------------------------------------------------------------- pruning
def test_nothing_is_pruned_before_it_could_become_visible(tiny_scene):
    """A thin start needs steps: however few the tiles and however short the stage, pruning waits for them."""
    config = OctreeConfig(
        levels=[4, 5], downscales=[4, 2], until=[0.001, 1.0], tiles=[4, 4], prunes=[1, 1], prune_steps=12
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    leaves = tuner.octree.n_leaves
    for _ in range(12):
        tuner.step(0.5)
        assert tuner.octree.n_leaves == leaves and tuner.stage == 0
    tuner.step(0.5)
    assert tuner.prunings == 1 and tuner.octree.n_leaves < leaves


def test_splitting_stays_within_the_memory(tiny_scene, capsys):
    """Where memory allows fewer leaves than a stage wants, it splits those with the largest error, and says so."""
    config = OctreeConfig(
        levels=[4, 5], downscales=[2, 1], until=[0.01, 1.0], tiles=[16, 16], prunes=[0, 0], prune_steps=4
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    tuner.max_leaves = 6000
    for _ in range(9):
        tuner.step(0.5)
    assert tuner.stage == 1 and tuner.octree.n_leaves <= 6000
    assert "memory allows 6,000 leaves" in capsys.readouterr().out
