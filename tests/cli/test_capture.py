"""``nerfvol capture`` with a stub in the place of structure from motion: every step once, however often it is stopped."""

import json
import shutil

import pytest
from PIL import Image

from nerfvol.native import native
from tests.fixtures.rooms import draw, facing_cameras, trace_planes, write_photographs
from tests.poses.test_make import small, stub

BUDGET, OTHER = "4s", "3s"


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "photos"
    folder.mkdir()
    for i, camera in enumerate(facing_cameras(9, small())):
        Image.fromarray(draw(camera, trace_planes, 1)).save(folder / f"p{i}.png")
    return folder


@pytest.fixture
def with_stub(monkeypatch):
    """Counts calls of structure from motion."""
    calls = []

    def counted(job, progress):
        calls.append(job)
        return stub(job, progress)

    defaults = list(__import__("nerfvol.poses.make", fromlist=["make_poses"]).make_poses.__defaults__)
    monkeypatch.setattr("nerfvol.poses.make.make_poses.__defaults__", (*defaults[:-1], counted))
    return calls


@pytest.mark.skipif(native() is None, reason="the reference path takes minutes")
def test_every_step_once_however_often_it_is_stopped(command, photos, tmp_path, with_stub, monkeypatch):
    run, arguments = tmp_path / "run", ("--views", 3, "--size", 200, "--threads", 1)

    def capture(budget=None):
        return command(
            "capture", photos, "--out", run, *arguments, *(() if budget is None else ("--time-budget", budget))
        )

    import nerfvol.film
    import nerfvol.training.train as training

    step, seen = training.optimise, []

    def stopped(run, phase, bar):
        """Stops as a kill would, after the first checkpoint."""
        run.enter(phase)
        run.follow(phase, phase.step(0.0).squared_error)
        run.claim(phase)
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "optimise", stopped)
    assert capture(BUDGET)[0] == 130 and len(with_stub) == 1 and (run / "scene" / "poses.json").is_file()
    assert not (run / "splats.safetensors").exists()

    def going_on(run, phase, bar):
        seen.append((run.phase, run.config.time_budget))
        step(run, phase, bar)

    monkeypatch.setattr(training, "optimise", going_on)
    monkeypatch.setattr(nerfvol.film, "write_videos", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
    code, out, _ = capture(OTHER)
    assert code == 130 and seen == [("splats", 3.0)] and "resumed at step 1" in out and len(with_stub) == 1
    assert (run / "splats.safetensors").exists() and not (run / "video.mp4").exists()
    monkeypatch.undo()
    monkeypatch.setattr("nerfvol.poses.make.require_pycolmap", lambda: None)
    model = (run / "splats.safetensors").stat().st_mtime_ns
    code, out, _ = capture()
    assert code == 0 and (run / "video.mp4").stat().st_size > 500 and "video.mp4" in out
    assert model == (run / "splats.safetensors").stat().st_mtime_ns
    made = (run / "video.mp4").stat().st_mtime_ns
    assert capture()[0] == 0 and made == (run / "video.mp4").stat().st_mtime_ns
    table = (run / "photographs.csv").read_text().splitlines()
    assert len(table) == 1 + 7 and json.loads((run / "metrics.json").read_text())["representation"] == "splats"
    trained = []
    monkeypatch.setattr(training, "train", lambda config, *_: trained.append((config.time_budget, config.resume)))
    assert capture(OTHER)[0] == 0 and not trained
    code, out, _ = capture("5s")
    assert code == 0 and trained == [(5.0, False)] and "had a time budget of 3.0 s" in out and "previous" in out


def test_photographs_without_poses_are_told_what_to_do(command, photos, tmp_path):
    code, _, error = command("train", "--data", photos, "--out", tmp_path / "run")
    assert code == 2 and "no camera poses yet" in error and f"nerfvol poses {photos} --out scene" in error
    assert "--poses auto" in error and "nerfvol capture" in error


def test_photographs_with_poses_are_left_alone(tmp_path):
    from nerfvol.cli.photographs import without_poses

    cameras = facing_cameras(3, small())
    scene = write_photographs(tmp_path / "scene", cameras, [draw(c, trace_planes, 1) for c in cameras])
    assert not without_poses(scene) and not without_poses(scene / "transforms.json")
    shutil.move(scene / "transforms.json", tmp_path)
    assert without_poses(scene) and without_poses(scene / "images")


@pytest.mark.parametrize("arguments,sentence", [
    (("poses",), "needs PHOTOS|VIDEO"),
    (("poses", "nowhere"), "needs --out"),
    (("poses", "nowhere", "--out", "o"), "no such folder or file"),
    (("poses", "x", "--out", "o", "--mapper", "best"), "expected auto or global or incremental"),
    (("capture",), "needs PHOTOS|VIDEO"),
    (("capture", "nowhere", "--out", "o"), "no such folder or file"),
])  # fmt: skip
def test_refusals(command, arguments, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = command(*arguments)
    assert code == 2 and sentence in error and len(error.strip().splitlines()) == 1
