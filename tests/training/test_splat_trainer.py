"""Training splats: the same numbers however a run is cut and shared out, growth and pruning, what is refused and how."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nerfvol
from nerfvol.cameras.camera import Intrinsics
from nerfvol.cli.command import set_threads
from nerfvol.config.assemble import assemble
from nerfvol.config.octree import OctreeConfig
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.native import native
from nerfvol.octree.io import save_octree
from nerfvol.region import SceneBounds
from nerfvol.training import finishing, session, splat_schedule
from nerfvol.training.splat_trainer import SplatTrainer
from nerfvol.views import SplatModel
from tests.fixtures.rooms import draw, facing_cameras, trace_planes, write_photographs
from tests.fixtures.runs import TINY, killed, log_of, metrics_of, settings, start
from tests.fixtures.tiny import write_scene

ROOT = Path(nerfvol.__file__).parents[1]
SHORT = {"steps": 44, "grow_every": 10, "max_splats": 4000}
"""Rounds of growth at steps 10, 20, 30, 40; sizes change at 40 and 85 % of the run where there are three."""

pytestmark = pytest.mark.skipif(native() is None, reason="the reference path takes minutes; it has a test of its own")


def splat_settings(scene, out, **more) -> Config:
    return settings(scene, out, **{"representation": "splats", "splats": SHORT, "checkpoint_every": 1000, **more})


def splats_of(run: Path) -> bytes:
    return (run / run_folder.SPLATS).read_bytes()


@pytest.fixture(scope="module")
def photographs_folder(tmp_path_factory) -> Path:
    cameras = facing_cameras(12, Intrinsics(56, 40, 55.0, 55.0, 28.0, 20.0))
    return write_photographs(
        tmp_path_factory.mktemp("photographs"), cameras, [draw(c, trace_planes, 2) for c in cameras]
    )


# ---------------------------------------------------------------- the same numbers
@dataclasses.dataclass
class Whole:
    """A run, the checkpoint after each of its steps, and its scene."""

    run: Path
    checkpoints: dict[int, Path]
    scene: Path


@pytest.fixture
def small_sizes(monkeypatch):
    """Three sizes of pictures of 40 pixels."""
    monkeypatch.setattr(splat_schedule, "COARSEST_SIDE", 10)


@pytest.fixture(scope="module", params=["object", "photographs"])
def whole(request, tmp_path_factory, tiny_scene, photographs_folder) -> Whole:
    folder, checkpoints = tmp_path_factory.mktemp("whole"), {}
    scene = tiny_scene if request.param == "object" else photographs_folder
    save = session.Run.save

    def save_and_keep(self, phase):
        save(self, phase)
        checkpoints[phase.steps_done] = folder / str(phase.steps_done)
        shutil.copy(self.folder / run_folder.CHECKPOINT, checkpoints[phase.steps_done])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session.Run, "save", save_and_keep)
        patch.setattr(splat_schedule, "COARSEST_SIDE", 10)
        run = start(splat_settings(scene, folder / "run", checkpoint_every=1e-9))
    return Whole(run, checkpoints, scene)


def resumed(whole: Whole, out: Path, step: int, change=lambda state: None) -> Path:
    """The run as it goes on in ``out`` from the checkpoint after a step, which ``change`` may edit."""
    out.mkdir()
    shutil.copy(whole.run / run_folder.CONFIG, out)
    state = load_checkpoint(whole.checkpoints[step])
    change(state)
    save_checkpoint(out / run_folder.CHECKPOINT, state)
    return start(splat_settings(whole.scene, out, resume=True))


def test_resumed_anywhere_the_splats_are_the_same(whole, tmp_path, small_sizes):
    """From the checkpoints around every change of size or number and from the first and last one: bit by bit."""
    steps = sorted(whole.checkpoints)
    assert steps == list(range(1, 45))
    states = {step: load_checkpoint(whole.checkpoints[step])["trainer"] for step in steps}
    kind = {step: (state["stage"], int(state["n"]), int(state["seen_since"] == 1)) for step, state in states.items()}
    changes = [step for step in steps[1:] if kind[step] != kind[step - 1]]
    assert {kind[step][0] for step in steps} == {0, 1, 2} and {11, 21, 31} & set(changes)
    around = {k + d for k in (*changes, 11, 21, 31, 41) for d in (-1, 0)}  # before and after
    for step in sorted({1, 44, *around}):
        run = resumed(whole, tmp_path / str(step), step)
        assert splats_of(run) == splats_of(whole.run), f"resumed at step {step}"
        assert metrics_of(run)["steps"] == {"splats": 44}


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_nothing(whole, tmp_path, small_sizes, threads):
    try:
        run = start(splat_settings(whole.scene, tmp_path / "run", threads=threads))
    finally:
        set_threads(1)
    assert splats_of(run) == splats_of(whole.run)


def test_another_seed_changes_something(whole, tmp_path, small_sizes):
    a = SplatModel.load(start(splat_settings(whole.scene, tmp_path / "run", seed=1)) / run_folder.SPLATS).splats
    b = SplatModel.load(whole.run / run_folder.SPLATS).splats
    assert a.n != b.n or not np.array_equal(a.means, b.means)


def test_without_a_budget_the_clock_changes_nothing(whole, tmp_path, small_sizes, monkeypatch):
    jumps = iter(range(0, 10**9, 137))
    monkeypatch.setattr(session.time, "perf_counter", lambda: float(next(jumps)))
    assert splats_of(start(splat_settings(whole.scene, tmp_path / "run"))) == splats_of(whole.run)


def test_kill_9_costs_no_file(tmp_path, tiny_scene):
    plan = {**TINY, "representation": "splats", "splats": {**SHORT, "steps": 600}, "checkpoint_every": 0.02}
    plan["data"] = str(tiny_scene)
    (tmp_path / "tiny.yaml").write_text(json.dumps(plan))
    run = tmp_path / "run"
    arguments = ["train", "--out", str(run), "--config", str(tmp_path / "tiny.yaml")]
    killed(arguments, run, 2)
    at = load_checkpoint(run / run_folder.CHECKPOINT)["trainer"]["steps_done"]
    assert 0 < at < 600
    start(assemble(Config, (plan, "plan"), ({"out": str(run), "resume": True}, "test")))
    start(assemble(Config, (plan, "plan"), ({"out": str(tmp_path / "straight")}, "test")))
    assert splats_of(run) == splats_of(tmp_path / "straight")


def test_records(whole, command):
    metrics = metrics_of(whole.run)
    model = SplatModel.load(whole.run / run_folder.SPLATS)
    code, *_ = command("eval", whole.run, "--split", "val", "--threads", 1, "--json", whole.run / "eval.json")
    record = json.loads((whole.run / "eval.json").read_text())
    assert code == 0
    for key in ("psnr", "ssim", "image_size", "background", "n_images", "split"):
        assert metrics[key] == record[key], key
    assert metrics["representation"] == "splats" and metrics["splats"] == model.packed.n <= 4000
    assert metrics["MB"] == (whole.run / run_folder.SPLATS).stat().st_size / 1e6
    names = {path.name for path in (whole.run / run_folder.PREVIEWS).iterdir()}
    assert {"splats_030.png", "splats_100.png"} <= names
    assert {"orbit", "provenance", "background", "near"} <= model.metadata.keys()
    assert not [path.name for path in whole.run.iterdir() if ".tmp" in path.name]
    assert (np.abs(model.splats.logits) < 60).all()


def test_a_finished_run_says_so(whole, command):
    before = splats_of(whole.run)
    code, out, _ = command("train", "--resume", "--out", whole.run)
    assert code == 0 and "nothing to resume" in out and splats_of(whole.run) == before


# ---------------------------------------------------------------- checkpoints
@pytest.mark.parametrize("change", [
    lambda t: t.update(params=t["params"][:-1]), lambda t: t.update(first=t["first"][:, :4]), lambda t: t.pop("n"),
    lambda t: t.update(error=t["error"][:-1]), lambda t: t.update(seen=t["seen"][None]), lambda t: t.pop("stage"),
    lambda t: t.update(stage="first"), lambda t: t.update(stage=7), lambda t: t.update(stage=-1), lambda t: t.update(n=10**6),
    lambda t: t.pop("subject_distance"), lambda t: t.update(subject_distance=0.0), lambda t: t.update(factors=[3, 2, 1]),
    lambda t: t.update(ends=[0.1]), lambda t: t.update(most=None), lambda t: t.update(origin=np.zeros(2)),
    lambda t: t.update(origin=np.full(3, np.nan)), lambda t: t.update(steps_done=-1), lambda t: t.update(started_with=0),
    lambda t: t.clear(),
])  # fmt: skip
def test_a_checkpoint_whose_parts_do_not_fit_is_refused(whole, tmp_path, small_sizes, change):
    with pytest.raises(InputError, match="checkpoint.* does not fit the splats of this run: ") as error:
        resumed(whole, tmp_path / "run", 15, lambda state: change(state["trainer"]))
    assert "\n" not in str(error.value)


def test_a_resumed_run_announces_the_splats_it_was_begun_with(tmp_path, tiny_scene):
    """Not what the seconds that are left would pay for."""
    config = splat_settings(tiny_scene, tmp_path / "run", splats={**SHORT, "max_splats": None})
    said: list[str] = []
    step = SplatTrainer.step

    def stop(self, progress):
        if self.steps_done == 5:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, progress)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SplatTrainer, "step", stop)
        with pytest.raises(KeyboardInterrupt):
            start(config, say=said.append)
    assert any("saved at step 6 of the splats" in line for line in said)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(splat_schedule, "PIXELS_PER_SPLAT", 16)
        start(dataclasses.replace(config, resume=True), say=said.append)
    first, second = [line for line in said if "up to" in line]
    assert "up to 2,400 splats" in first and "up to 2,400 splats" in second


# ---------------------------------------------------------------- ends
def test_a_collapse_is_one_sentence(tmp_path, tiny_scene, command):
    plan = {**TINY, "splats": {**SHORT, "prune_opacity": 1.0}, "checkpoint_every": 1000}
    (tmp_path / "tiny.yaml").write_text(json.dumps(plan))
    arguments = ("--representation", "splats", "--config", tmp_path / "tiny.yaml", "--out", tmp_path / "run")
    code, _, err = command("train", "--data", tiny_scene, *arguments)
    assert code == 2 and "collapsed to empty space at step 10" in err and "--init" in err and err.count("\n") == 1


def test_divergence_does_not_reach_a_checkpoint(tmp_path, tiny_scene, monkeypatch):
    step = SplatTrainer.step

    def explode(self, progress):
        report = step(self, progress)
        return dataclasses.replace(report, squared_error=float("nan")) if self.steps_done == 6 else report

    monkeypatch.setattr(SplatTrainer, "step", explode)
    with pytest.raises(InputError, match="diverged at step 6.*splats.rate_means"):
        start(splat_settings(tiny_scene, tmp_path, checkpoint_every=1e-9))
    assert load_checkpoint(tmp_path / run_folder.CHECKPOINT)["trainer"]["steps_done"] == 5


def test_a_budget_ends(tmp_path, tiny_scene, monkeypatch):
    """On a clock that goes on by a hundredth of a second whenever it is looked at: within the budget, with time to write."""
    ticks = iter(range(10**9))
    monkeypatch.setattr(session.time, "perf_counter", lambda: 0.01 * next(ticks))
    run = start(splat_settings(tiny_scene, tmp_path / "run", time_budget=8.0), started=0.0)
    last = log_of(run)[-1]
    assert last["progress"] >= 1 and 8 * (1 - finishing.RESERVE_SHARE) - 0.5 < last["seconds"] < 8
    assert metrics_of(run)["steps"]["splats"] == last["step"] > 44  # the seconds count, not the setting


# ---------------------------------------------------------------- data of all kinds
def test_ten_pictures_of_24_pixels(tmp_path):
    scene = write_scene(tmp_path / "scene", {"train": 10, "val": 2}, size=24)
    run = start(splat_settings(scene, tmp_path / "run", splats={"steps": 150}))
    assert metrics_of(run)["psnr"] > 22 and metrics_of(run)["splats"] <= 1000  # a white picture scores 12


def test_photographs_of_two_sizes_and_lenses(tmp_path):
    lenses = [Intrinsics(56, 40, 55.0, 55.0, 28.0, 20.0), Intrinsics(33, 60, 50.0, 52.0, 15.0, 31.0, k1=-0.15, k2=0.03)]
    cameras = [dataclasses.replace(c, intrinsics=lenses[i % 2]) for i, c in enumerate(facing_cameras(18, lenses[0]))]
    scene = write_photographs(tmp_path / "scene", cameras, [draw(c, trace_planes, 2) for c in cameras])
    run = start(splat_settings(scene, tmp_path / "run", splats={"steps": 200}))
    rows = metrics_of(run)["rows"]
    assert len(rows) == 3 and min(row["psnr"] for row in rows) > 24, rows


@pytest.mark.parametrize("alpha, init, expected", [
    (True, "auto", "octree"), (True, "direct", "octree"), (True, "sweep", "splats"), (True, "random", "splats"),
    (False, "auto", "splats"), (False, "points", "splats"), (False, "direct", "octree"), (False, "mlp", "octree"),
    (True, "splats", "octree"), (False, "splats", "octree"),
    (True, __file__, "splats"),
])  # fmt: skip
def test_which_representation_suits(alpha, init, expected):
    """Photographs become splats, objects an octree; a start that only the other has decides."""
    box = np.array([[-1.0] * 3, [1.0] * 3])
    scene = SceneBounds(box, None if alpha else 16 * box, alpha)
    assert Config(init=init).for_scene(scene).representation == expected
    for asked in ("octree", "splats") if init == "auto" else ():
        assert Config(init=init, representation=asked).for_scene(scene).representation == asked


@pytest.mark.parametrize("views, alpha, given, start, tv", [
    (16, True, {}, "mlp", 3e-4), (17, True, {}, "auto", 6e-5), (16, False, {}, "auto", None),
    (8, True, {"init": "direct"}, "direct", 3e-4), (8, True, {"init": "mlp"}, "mlp", 3e-4),
    (8, True, {"representation": "splats"}, "mlp", 3e-4), (8, True, {"representation": "field"}, "auto", 6e-5),
    (8, True, {"octree": OctreeConfig(tv_sh=0.5)}, "mlp", None),
    (8, True, {"time_budget": 10.0}, "auto", 3e-4), (8, True, {"time_budget": 11.0}, "mlp", 3e-4),
    (8, True, {"time_budget": 9.0, "init": "mlp"}, "mlp", 3e-4), (100, True, {"time_budget": 9.0}, "auto", 6e-5),
    (100, True, {"time_budget": 20.0}, "splats", 6e-5),
])  # fmt: skip
def test_objects_of_few_views_begin_as_fields_where_there_is_time(views, alpha, given, start, tv):
    """Where nobody says otherwise; what somebody chose stays."""
    box = np.array([[-1.0] * 3, [1.0] * 3])
    scene = SceneBounds(box, None if alpha else 16 * box, alpha)
    config = Config(**given).for_views(views, scene).for_scene(scene)
    assert config.init == start
    assert tv is None or config.octree.tv_sh == config.octree.tv_density == tv
    if config.init == "mlp":
        assert config.distill.level == 7 and config.octree.two_backgrounds
    assert "octree" not in given or (config.octree.tv_sh, config.octree.tv_density) == (0.5, 3e-4)


# ---------------------------------------------------------------- where it starts
@pytest.mark.parametrize("init, sentence", [
    ("auto", "points from a plane sweep"), ("sweep", "points from a plane sweep"), ("random", "3000 random points"),
])  # fmt: skip
def test_a_start_by_name(tmp_path, photographs_folder, init, sentence):
    said: list[str] = []
    config = splat_settings(photographs_folder, tmp_path / "run", init=init, splats={"steps": 1, "max_splats": 1200})
    start(config, say=said.append)
    line = next(line for line in said if line.startswith("start: "))
    assert sentence in line and ("as asked" in line) == (init != "auto")
    logits = SplatModel.load(tmp_path / "run" / run_folder.SPLATS).splats.logits
    opacity = 1 / (1 + np.exp(-float(np.median(logits))))
    assert opacity == pytest.approx(0.3 if init == "random" else 0.5, abs=0.03)  # one step away from what it began with
    assert metrics_of(tmp_path / "run")["splats"] <= 1200
    assert "1,200 of these points are taken: as many splats as this run may have" in said


def test_the_start_never_has_more_than_the_most(tmp_path, photographs_folder):
    """As many as asked for, sized for the gaps between them, the same ones for the same seed."""
    sizes = {}
    for most in (300, 1200):
        counts, step = [], SplatTrainer.step

        def watch(self, progress, counts=counts, step=step):
            counts.append((self.state.n, float(np.exp(np.median(self.state.splats().log_scales)))))
            return step(self, progress)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(SplatTrainer, "step", watch)
            splats = {"steps": 30, "grow_every": 5, "max_splats": most}
            start(splat_settings(photographs_folder, tmp_path / str(most), splats=splats))
        assert 0.9 * most < counts[0][0] and max(n for n, _ in counts) <= most
        sizes[most] = counts[0][1]
    assert sizes[300] > 1.2 * sizes[1200]


def test_a_start_from_a_file(tmp_path, whole):
    """A run goes on with what another one wrote: one step later it is about as good; of other harmonics too."""
    path, before = whole.run / run_folder.SPLATS, metrics_of(whole.run)
    for given, degree in ((path, 0), (whole.run, 3)):
        out = tmp_path / str(degree)
        start(splat_settings(whole.scene, out, init=str(given), splats={"steps": 1, "sh_degree": degree}))
        after = metrics_of(out)
        assert SplatModel.load(out / run_folder.SPLATS).packed.sh_degree == degree
        assert after["splats"] == before["splats"] and after["psnr"] > before["psnr"] - 2.5
    sentence = f"--init .*: it has {before['splats']:,} splats, expected 1 to 50"
    with pytest.raises(InputError, match=sentence):
        start(splat_settings(whole.scene, tmp_path / "few", init=str(path), splats={"steps": 1, "max_splats": 50}))
    with pytest.MonkeyPatch.context() as patch:  # more than the seconds would pay for: all are kept
        patch.setattr(splat_schedule, "PIXELS_PER_SPLAT", 10**9)
        patch.setattr(splat_schedule, "_MOST", {True: (60.0,) * 10, False: (60.0,) * 10})
        start(splat_settings(whole.scene, tmp_path / "all", init=str(path), splats={"steps": 1}))
    assert metrics_of(tmp_path / "all")["splats"] == before["splats"]


def test_a_run_goes_on_without_the_file_it_began_with(tmp_path, whole):
    """The checkpoint has all that came of it."""
    file = tmp_path / "start.safetensors"
    shutil.copy(whole.run / run_folder.SPLATS, file)
    config = splat_settings(whole.scene, tmp_path / "run", init=str(file), splats={"steps": 9}, checkpoint_every=1e-9)
    step, step_five = SplatTrainer.step, KeyboardInterrupt("killed")

    def die(self, progress):
        if self.steps_done == 5:
            raise step_five
        return step(self, progress)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SplatTrainer, "step", die)
        with pytest.raises(KeyboardInterrupt, match="killed"):
            start(config)
    start(dataclasses.replace(config, out=str(tmp_path / "straight")))
    file.unlink()
    start(splat_settings(whole.scene, tmp_path / "run", init=str(file), splats={"steps": 9}, resume=True))
    assert splats_of(tmp_path / "run") == splats_of(tmp_path / "straight")


@pytest.mark.parametrize("representation, init, reason", [
    ("splats", "fog", "expected auto, mlp, points, .*random or a file of splats or an octree for splats, got 'fog'"),
    ("splats", "direct", "expected auto, mlp, points.* or a file of splats or an octree for splats, got 'direct'"),
    ("octree", "sweep", "expected auto, direct, mlp, splats for octree, got 'sweep'"),
    ("octree", "FILE", "expected auto, direct, mlp, splats for octree, got '.*octree.safetensors'"),
    ("auto", "fog", "expected auto, direct, mlp, splats, points.* or a file of splats or an octree, got 'fog'"),
    ("splats", "points", "the start 'points' cannot be used: .* without the points of a model"),
    ("mesh", "auto", "representation.*octree.*splats"),
])  # fmt: skip
def test_a_wrong_start_is_one_sentence(tmp_path, tiny_scene, command, sphere_octree, representation, init, reason):
    import re

    (tmp_path / "tiny.yaml").write_text(json.dumps(TINY))
    if init == "FILE":
        init = tmp_path / "octree.safetensors"
        save_octree(init, sphere_octree, {})
    arguments = ("--representation", representation, "--init", init, "--config", tmp_path / "tiny.yaml")
    code, _, err = command("train", "--data", tiny_scene, "--out", tmp_path / "run", *arguments)
    assert code == 2 and err.startswith("nerfvol: error: ") and err.count("\n") == 1, err
    assert re.search(reason, err), err


def test_the_reference_path_trains_too(tmp_path):
    """The same picture after a few steps, to rounding."""
    scene = write_scene(tmp_path / "scene", {"train": 3, "val": 1}, size=24)
    plan = {
        **TINY,
        "representation": "splats",
        "data": str(scene),
        "splats": {"steps": 5, "grow_every": 2, "max_splats": 60},
    }
    (tmp_path / "tiny.yaml").write_text(json.dumps({**plan, "checkpoint_every": 1000}))
    for name, environment in (("kernels", {}), ("reference", {"NERFVOL_REFERENCE": "1"})):
        arguments = ["train", "--out", str(tmp_path / name), "--config", str(tmp_path / "tiny.yaml")]
        subprocess.run(
            [sys.executable, "-m", "nerfvol.cli", *arguments],
            cwd=ROOT, env={**os.environ, **environment}, check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
    a, b = (metrics_of(tmp_path / name) for name in ("kernels", "reference"))
    assert a["splats"] == b["splats"] and a["psnr"] == pytest.approx(b["psnr"], abs=0.05)
