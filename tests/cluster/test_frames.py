"""Frames drawn by several processes, in parts or after a kill are the bytes that one process draws at once."""

import json
import shutil

import numpy as np
import pytest

from nerfvol.datasets.frame import Frame
from nerfvol.datasets.load import load_dataset
from nerfvol.octree.io import save_octree
from nerfvol.splats.io import save_splats
from nerfvol.training.phase import RefinedPoses
from nerfvol.training.refined import write_refined
from tests.splats.scenes import random_splats

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def models(tmp_path_factory, sphere_octree):
    folder = tmp_path_factory.mktemp("models")
    save_octree(folder / "octree.safetensors", sphere_octree, {"background": [0.2, 0.4, 0.6]})
    save_splats(folder / "splats.safetensors", random_splats(200, 1, 3), {})
    return folder


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".part"}


PATH = ("--path", "lemniscate", "--seconds", "0.7", "--fps", "10", "--size", "40x30")


@pytest.mark.parametrize(
    ("model", "options"),
    [
        ("octree", ("--aov", "depth,normal")),
        ("splats", ("--format", "exr", "--aov", "median_depth")),
        ("octree", ("--compare", "splats", "--output", "depth")),
    ],
)
def test_ranges_make_the_bytes_of_one_run_and_leave_what_is_there(tmp_path, models, command, model, options):
    options = [str(models / f"{o}.safetensors") if o == "splats" else o for o in options]
    given = ("render", models / f"{model}.safetensors", *PATH, *options)
    assert command(*given, "--out", tmp_path / "whole")[0] == 0
    for part in ("0-6/2", "3-6", "1-2", "0-6"):
        code, said, _ = command(*given, "--out", tmp_path / "parts", "--frames", part)
        assert code == 0
    assert said.startswith("0 views, 7 in the path")
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    # One that was lost is made again, and only it.
    lost = next(path for path in (tmp_path / "parts").iterdir() if path.name.startswith("0004"))
    lost.unlink()
    assert command(*given, "--out", tmp_path / "parts", "--frames", "0-6")[1].startswith("1 views")
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


def test_pictures_of_another_film_are_not_taken_for_this_one(tmp_path, models, command):
    given = ("render", models / "octree.safetensors", *PATH, "--out", tmp_path, "--frames", "0-1")
    assert command(*given)[0] == 0
    for other in (("--background", "black"), ("--size", "41x30"), ("--aov", "depth")):
        code, _, said = command(*given, *other)
        assert code == 2 and "another model, path or drawn otherwise" in said
    (tmp_path / "film.json").unlink()  # pictures that nobody vouches for are drawn again
    assert command(*given)[1].startswith("2 views")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", "5-9"), "the path has the frames 0-6"),
        (("--frames", "3-1"), "A up to B"),
        (("--frames", "1-3/0"), "S at least 1"),
        (("--frames", "all"), "number of frames"),
        (("--frames", "1-3", "--out", "x.mp4"), "give --out a folder"),
    ],
)
def test_ranges_that_make_no_sense_are_one_sentence(tmp_path, models, command, options, message):
    out = () if "--out" in options else ("--out", tmp_path)
    code, _, said = command("render", models / "octree.safetensors", *PATH, *out, *options)
    assert code == 2 and message in said


def test_workers_of_a_cluster_make_the_same_bytes(tmp_path, models, command):
    pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")
    given = ("render", models / "octree.safetensors", *PATH, "--aov", "depth,normal", "--cluster", "local:2")
    assert command(*given[:-2], "--out", tmp_path / "here")[0] == 0
    assert command(*given, "--out", tmp_path / "there")[0] == 0
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
    shutil.rmtree(tmp_path / "there")
    splats = ("render", models / "splats.safetensors", *PATH)
    assert command(*splats, "--out", tmp_path / "here.gif")[0] == 0
    assert command(*splats, "--out", tmp_path / "there.gif", "--cluster", "local:2")[0] == 0
    assert (tmp_path / "there.gif").read_bytes() == (tmp_path / "here.gif").read_bytes()


def test_scores_from_workers_are_those_from_here(tmp_path, models, tiny_scene, command):
    pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")
    records = {}
    for name, more in (("here", ()), ("there", ("--cluster", "local:2"))):
        images, record = tmp_path / name, tmp_path / f"{name}.json"
        given = ("--data", tiny_scene, "--save-images", images, "--json", record, "--split", "train")
        assert command("eval", models / "octree.safetensors", *given, *more)[0] == 0
        records[name] = json.loads(record.read_text())
    here, there = ([row | {"seconds": 0} for row in records[name]["rows"]] for name in ("here", "there"))
    assert len(here) > 3 and here == there and records["here"]["psnr"] == records["there"]["psnr"]
    assert contents(tmp_path / "here") == contents(tmp_path / "there")


def test_scores_of_refined_cameras_from_workers_are_those_from_here(tmp_path, models, tiny_scene, command, monkeypatch):
    """By workers that load the data themselves, as those of other machines do."""
    pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")
    for user in ("engine", "share"):
        monkeypatch.setattr(f"nerfvol.cluster.{user}.may_copy", lambda: False)
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(models / "octree.safetensors", run)
    (run / "config.yaml").write_text(f"data: {json.dumps(str(tiny_scene))}\n")
    records = {}
    for name, more in (("given", ()), ("here", ()), ("there", ("--cluster", "local:2"))):
        if name == "here":
            dataset = load_dataset(tiny_scene, "train")
            poses = np.stack([camera.c2w for camera in dataset.cameras])
            poses[:, :3, 3] += 0.05
            refined = RefinedPoses(dataset.names, poses, np.ones(len(poses)))
            write_refined(run / "refined_poses.json", refined, Frame())
        record = tmp_path / f"{name}.json"
        assert command("eval", run, "--split", "train", "--json", record, *more)[0] == 0
        records[name] = [row | {"seconds": 0} for row in json.loads(record.read_text())["rows"]]
    assert records["there"] == records["here"] != records["given"]


def test_a_synthetic_set_from_workers_is_that_from_here(tmp_path, command):
    pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")
    given = ("synth", "sphere", "--views", "6", "--size", "12x10", "--integrator", "emission", "--exr")
    assert command(*given, "--out", tmp_path / "here")[0] == 0
    assert command(*given, "--out", tmp_path / "there", "--cluster", "local:2")[0] == 0
    for split in ("train", "val", "test"):
        assert contents(tmp_path / "here" / split) == contents(tmp_path / "there" / split)
    names = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "there").iterdir())


def test_a_large_path_traced_picture_is_shared_by_workers(tmp_path, command, monkeypatch):
    """Cut into bands and blocks here; 40 samples are three blocks, the last of eight."""
    pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")
    from data_synth import parts
    from nerfvol.cluster.window import Window

    for name, value in {"WHOLE_RAYS": 100, "PART_RAYS": 12 * 4 * 16, "PART_PIXELS": 50}.items():
        monkeypatch.setattr(parts, name, value)
    given, asked = ("synth", "sphere", "--size", "12x10", "--integrator", "path", "--spp", "40"), []
    results = Window.results
    monkeypatch.setattr(
        Window, "results", lambda self, items, ahead=None: asked.extend(items) or results(self, items, ahead)
    )
    assert command(*given, "--picture", tmp_path / "here.png")[0] == 0
    assert command(*given, "--picture", tmp_path / "there.png", "--cluster", "local:2")[0] == 0
    assert len({piece.part for piece in asked}) == len(asked) > 4
    assert (tmp_path / "there.png").read_bytes() == (tmp_path / "here.png").read_bytes()


def test_an_engine_that_is_not_there_is_one_sentence(tmp_path, models, command):
    code, _, said = command("render", models / "octree.safetensors", *PATH, "--out", tmp_path, "--cluster", "nowhere")
    assert code == 2 and "--cluster: expected local:N" in said
    one = (
        "render",
        models / "octree.safetensors",
        "--orbit",
        "1",
        "--out",
        tmp_path / "one.png",
        "--cluster",
        "local:2",
    )
    code, _, said = command(*one)
    assert code == 2 and "--cluster shares out views" in said
