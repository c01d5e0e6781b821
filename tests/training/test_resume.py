"""A whole run: exact resumption, independence of threads and clock, what it leaves, interruptions."""

import dataclasses
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import nerfvol
from nerfvol.cli.command import set_threads
from nerfvol.cli.target import open_target
from nerfvol.config.assemble import assemble, run_settings
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.octree.io import load_octree
from nerfvol.training import session
from tests.fixtures.runs import TINY, killed, log_of, metrics_of, product, run_of, settings, start

ROOT = Path(nerfvol.__file__).parents[1]


@dataclasses.dataclass
class Whole:
    """An uninterrupted run and a copy of each checkpoint it wrote, with its phase and step."""

    run: Path
    checkpoints: dict[tuple[str, int], Path]


@pytest.fixture(scope="module", params=["direct", "mlp", "splats"])
def whole(request, tmp_path_factory, tiny_scene) -> Whole:
    folder = tmp_path_factory.mktemp("whole")
    checkpoints = {}
    save = session.Run.save

    def save_and_keep(self, phase):
        save(self, phase)
        kept = folder / f"{phase.name}{phase.steps_done}"
        shutil.copy(self.folder / run_folder.CHECKPOINT, kept)
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
    assert {(phase, 1) for phase, _ in keys} <= set(keys)  # each phase has one from its first step on
    assert {stages[key][0] for key in keys if key[0] == "octree"} >= {1, 2}  # a distilled octree skips the first stage
    wanted = {0, len(keys) - 1, 7, *changes, *(i - 1 for i in changes)}
    init = load_config(whole.run)["init"]
    for index in sorted(wanted):
        phase, step = keys[index]
        out = tmp_path / f"{phase}{step}"
        out.mkdir()
        shutil.copy(whole.run / run_folder.CONFIG, out)
        shutil.copy(whole.checkpoints[phase, step], out / run_folder.CHECKPOINT)
        start(settings(tiny_scene, out, init=init, resume=True, checkpoint_every=1000))
        assert product(out) == product(whole.run), f"resumed at step {step} of the {phase}"
        assert metrics_of(out)["steps"] == metrics_of(whole.run)["steps"]
        assert list(metrics_of(out)["results"]) == list(metrics_of(whole.run)["results"])


def load_config(run: Path) -> dict:
    return run_settings(run)


def test_threads_change_nothing(whole, tmp_path, tiny_scene):
    init = load_config(whole.run)["init"]
    try:
        run = start(settings(tiny_scene, tmp_path / "two", init=init, threads=2, checkpoint_every=1000))
    finally:
        set_threads(1)
    assert product(run) == product(whole.run)


def test_another_seed_changes_something(whole, tmp_path, tiny_scene):
    init = load_config(whole.run)["init"]
    run = start(settings(tiny_scene, tmp_path / "other", init=init, seed=1, checkpoint_every=1000))
    a, b = load_octree(run / run_folder.OCTREE)[0], load_octree(whole.run / run_folder.OCTREE)[0]
    assert a.values.shape != b.values.shape or not np.array_equal(a.values, b.values)


def test_without_a_budget_the_clock_changes_nothing(whole, tmp_path, tiny_scene, monkeypatch):
    """A clock that jumps by minutes between any two looks at it."""
    jumps = iter(range(0, 10**9, 137))
    monkeypatch.setattr(session.time, "perf_counter", lambda: float(next(jumps)))
    run = start(settings(tiny_scene, tmp_path / "run", init=load_config(whole.run)["init"], checkpoint_every=1000))
    assert product(run) == product(whole.run)


# ---------------------------------------------------------------- what a run leaves
def test_records(whole, command):
    metrics = json.loads((whole.run / run_folder.METRICS).read_text())
    code, *_ = command("eval", whole.run, "--split", "val", "--threads", 1, "--json", whole.run / "eval.json")
    record = json.loads((whole.run / "eval.json").read_text())
    assert code == 0
    for of in (metrics, record):  # the clock is measured anew each time
        assert (of["hardware"].pop("clock_ghz") is None) == (of["hardware"]["kernel_path"] == "reference")
    for key in ("psnr", "ssim", "image_size", "background", "n_images", "threads", "hardware", "split"):
        assert metrics[key] == record[key], key
    assert metrics["leaves"] == load_octree(whole.run / run_folder.OCTREE)[0].n_leaves
    assert metrics["steps"]["octree"] == 60 and metrics["MB"] > 0 and metrics["vertices"] > metrics["leaves"]
    rows = {"direct": [], "mlp": ["field", "distilled", "fine_tuned"], "splats": ["splats", "converted", "fine_tuned"]}
    assert list(metrics["results"]) == rows[metrics["init"]]
    first = {"direct": {}, "mlp": {"field": 20}, "splats": {"splats": 25}}
    assert metrics["steps"] == {**first[metrics["init"]], "octree": 60}
    for row in metrics["results"].values():
        assert {"psnr", "ssim", "seconds", "leaves", "MB", "seconds_per_frame"} <= row.keys()
    assert (whole.run / run_folder.DISTILLED).exists() == (metrics["init"] == "mlp")
    names = {path.name for path in (whole.run / run_folder.PREVIEWS).iterdir()}
    assert {"octree_010.png", "octree_100.png"} <= names and all(
        f"{phase}_100.png" in names for phase in metrics["steps"]
    )
    assert not [path.name for path in whole.run.iterdir() if ".tmp" in path.name]
    orbit = open_target(str(whole.run / run_folder.OCTREE)).orbit()
    assert orbit["radius"] == pytest.approx(3.2, rel=0.05) and orbit["center"] == pytest.approx([0, 0, 0], abs=0.05)


def test_training_gains(whole):
    """The picture is far better than the plain background's; fine-tuning gains on a distilled poor field, and on the surfaces
    of poor splats."""
    metrics = json.loads((whole.run / run_folder.METRICS).read_text())
    if metrics["init"] == "direct":
        assert metrics["psnr"] > 18  # a white picture scores 12
    else:
        _, start, tuned = metrics["results"].values()
        assert tuned["psnr"] > start["psnr"] + 1


def test_a_finished_run_says_so(whole, command):
    before = product(whole.run)
    code, out, _ = command("train", "--resume", "--out", whole.run)
    assert code == 0 and "is finished" in out and "nothing to resume" in out
    assert product(whole.run) == before


# ---------------------------------------------------------------- interruptions
def resumed(whole: Whole, out: Path, scene: Path, step: int, change=lambda state: None) -> Path:
    """The run as it goes on in ``out`` from the checkpoint after a step of the octree, which ``change`` may edit."""
    out.mkdir()
    shutil.copy(whole.run / run_folder.CONFIG, out)
    shutil.copy(whole.run / run_folder.LOG, out)
    state = load_checkpoint(whole.checkpoints["octree", step])
    change(state)
    save_checkpoint(out / run_folder.CHECKPOINT, state)
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
    if metrics["results"]:
        assert 1e8 < metrics["results"]["fine_tuned"]["seconds"] < 1.1e8


@pytest.mark.parametrize("change", [
    lambda t: t.update(values=t["values"][:-1], moments=t["moments"][:-1]), lambda t: t.update(moments=t["moments"][:, :4]),
    lambda t: t.update(error=t["error"][:-1]), lambda t: t.update(footprint=t["footprint"][None]),
    lambda t: t.update(node_mask=t["node_mask"][:-1]), lambda t: t.update(stage="first"), lambda t: t.pop("cursors"),
    lambda t: t["cursors"]["foreground"].update(position=-1), lambda t: t["cursors"]["background"].update(epoch="x"),
])  # fmt: skip
def test_a_checkpoint_whose_parts_do_not_fit_is_refused(whole, tmp_path, tiny_scene, change):
    with pytest.raises(InputError):
        resumed(whole, tmp_path / "run", tiny_scene, 45, lambda state: change(state["trainer"]))


@pytest.mark.parametrize("position", [10**6, 2**62])
def test_a_place_behind_the_end_of_the_queue_ends(whole, tmp_path, tiny_scene, position):
    """With other tiles than the checkpoint's a queue once waited for ever to come to its end; it begins a new epoch."""
    change = lambda state: state["trainer"]["cursors"]["foreground"].update(position=position)  # noqa: E731
    run = resumed(whole, tmp_path / "run", tiny_scene, 45, change)
    assert metrics_of(run)["steps"]["octree"] == 60


def test_a_run_outside_the_main_thread_leaves_signals_alone(tmp_path, tiny_scene):
    run = run_of(settings(tiny_scene, tmp_path))
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
    run = run_of(settings(tiny_scene, tmp_path))
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
    killed(arguments, run, 3)
    assert load_checkpoint(run / run_folder.CHECKPOINT)["phase"] == "octree"
    start(assemble(Config, (plan, "plan"), ({"out": str(run), "resume": True}, "test")))
    start(assemble(Config, (plan, "plan"), ({"out": str(tmp_path / "straight")}, "test")))
    assert product(run) == product(tmp_path / "straight")
    steps = [line["step"] for line in log_of(run)]
    assert steps == sorted(set(steps)) == [line["step"] for line in log_of(tmp_path / "straight")]
