"""Refined poses in runs: planted errors are won back, exact poses stay, resumed runs repeat bit by bit, scores are labelled."""

import csv
import json

import numpy as np
import pytest

from nerfvol.cameras.camera import Intrinsics
from nerfvol.cameras.motions import BETA1, Motions, moved
from nerfvol.errors import InputError
from nerfvol.files.checkpoint import load_checkpoint
from nerfvol.models import load_model
from nerfvol.native import native
from nerfvol.training.splat_trainer import MOTION_DECAY, MOTION_PIXELS, SplatTrainer
from tests.fixtures.rooms import draw, facing_cameras, trace_planes, write_photographs
from tests.fixtures.runs import metrics_of, settings, start

pytestmark = pytest.mark.skipif(native() is None, reason="the reference path takes minutes")
N = 14


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """One scene with its poses, and with each turned by 0.5 degrees and shifted by 1 % of the distance to the middle plane."""
    root = tmp_path_factory.mktemp("poses")
    cameras = facing_cameras(N, Intrinsics(80, 56, 78.0, 78.0, 40.0, 28.0))
    pictures = [np.round(0.75 * draw(c, trace_planes, 2)).astype(np.uint8) for c in cameras]
    rng = np.random.default_rng(3)

    def off(c2w):
        w, v = rng.normal(size=(2, 3))
        return moved(c2w, np.concatenate([np.radians(0.5) * w / np.linalg.norm(w), 0.045 * v / np.linalg.norm(v)]))

    return write_photographs(root / "exact", cameras, pictures), write_photographs(root / "off", cameras, pictures, off)


def run(scene, out, **more):
    options = {"representation": "splats", "init": "sweep", "checkpoint_every": 1000, "seed": 1}
    options["splats"] = {"steps": 600, "grow_every": 50, "max_splats": 3000}
    return start(settings(scene, out, **options | more))


def test_planted_errors_are_won_back_and_exact_poses_stay(scenes, tmp_path):
    refined = {
        name: run(scene, tmp_path / name, refine_poses=True)
        for name, scene in zip(("exact", "off"), scenes, strict=True)
    }
    plain = metrics_of(run(scenes[1], tmp_path / "plain"))
    scores = {name: metrics_of(path) for name, path in refined.items()}
    assert "psnr_posed" not in plain and set(scores["off"]) >= {"psnr", "psnr_posed", "ssim_posed"}
    best = scores["exact"]["psnr_posed"]
    assert plain["psnr"] < best - 3
    assert scores["off"]["psnr_posed"] > best - 0.1 * (best - plain["psnr"]) - 0.3
    moves = {name: [row["moved_pixels"] for row in json.loads((path / "refined_poses.json").read_text())["photographs"]]
             for name, path in refined.items()}  # fmt: skip
    # An exact pose comes to rest within what its last steps can do: each is MOTION_PIXELS MOTION_DECAY pixels, and Adam's
    # memory takes 1 / (1 - BETA1) of them in one direction before it turns.
    rest = MOTION_PIXELS * MOTION_DECAY / (1 - BETA1)
    assert np.median(moves["exact"]) < rest < 2 * rest < np.median(moves["off"])
    rows = list(csv.DictReader((refined["off"] / "photographs.csv").read_text().splitlines()))
    assert all(float(row["pose_moved_pixels"]) >= 0 for row in rows)
    page = (refined["off"] / "photographs.html").read_text()
    assert page.count("<figure>") == len(rows) and "http" not in page and page.index(rows[0]["photograph"]) > 0
    assert load_model(refined["off"] / "splats.safetensors").metadata["refined_poses"] > 0


def test_a_resumed_run_has_the_same_poses(scenes, tmp_path):
    short = {"splats": {"steps": 60, "grow_every": 25, "max_splats": 800}, "refine_poses": True}
    whole = run(scenes[1], tmp_path / "whole", **short)

    with pytest.MonkeyPatch.context() as patch:
        step = SplatTrainer.step

        def stop(self, progress):
            if self.steps_done == 41:
                raise RuntimeError("killed")
            return step(self, progress)

        patch.setattr(SplatTrainer, "step", stop)
        with pytest.raises(RuntimeError, match="killed"):
            run(scenes[1], tmp_path / "part", **short, checkpoint_every=1e-9)
    state = load_checkpoint(tmp_path / "part" / "checkpoint.safetensors")["trainer"]["motions"]
    assert state["visits"].sum() > 0
    run(scenes[1], tmp_path / "part", **short, checkpoint_every=1e-9, resume=True)
    names = ("refined_poses.json", "photographs.csv")
    assert all((whole / n).read_bytes() == (tmp_path / "part" / n).read_bytes() for n in names)


def test_an_octree_s_cameras_stay(scenes, tmp_path):
    with pytest.raises(InputError, match="--refine-poses moves cameras by the gradients of splats"):
        run(scenes[0], tmp_path / "run", refine_poses=True, representation="octree", init="direct")


def test_the_scene_comes_back_with_its_cameras(scenes, tmp_path, monkeypatch):
    """Refined cameras may turn, shift and scale together; the model that is saved is put where the given poses are."""
    short = {"splats": {"steps": 30, "grow_every": 25, "max_splats": 800}, "refine_poses": True}
    monkeypatch.setattr(Motions, "back", lambda self: (1.0, np.eye(3), np.zeros(3)))
    stays = load_model(run(scenes[1], tmp_path / "stays", **short) / "splats.safetensors")
    turn, shift = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.5, -1, 2])
    monkeypatch.setattr(Motions, "back", lambda self: (2.0, turn, shift))
    comes = load_model(run(scenes[1], tmp_path / "comes", **short) / "splats.safetensors")
    before, after = (model.splats.means + model.splats.origin for model in (stays, comes))
    assert np.abs(after - (2 * before @ turn.T + shift)).max() < 1e-5 * np.abs(before).max()
    assert comes.metadata["refined_poses"] == pytest.approx(2 * stays.metadata["refined_poses"], rel=1e-12)
