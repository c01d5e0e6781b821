"""``nerfvol convert``: files that open, the cost in a sentence, and refusals."""

import gzip
import json

import numpy as np
import pytest

from nerfvol.config.training import Config
from nerfvol.models import load_model
from nerfvol.octree.io import save_octree
from nerfvol.region import SceneBounds
from nerfvol.training import convert, tuning
from nerfvol.training.splat_trainer import SplatTrainer
from tests.fixtures.runs import TINY


@pytest.fixture
def octree_file(tmp_path, sphere_octree):
    path = tmp_path / "sphere.safetensors"
    save_octree(path, sphere_octree, {"background": [1.0, 1.0, 1.0]})
    return path


def test_there_and_back_with_and_without_images(tmp_path, tiny_scene, command, octree_file, monkeypatch):
    monkeypatch.setattr(convert, "FITTED_STEPS", 5)
    monkeypatch.setattr(convert, "FITTED_PIXELS", 40)
    monkeypatch.setattr(convert, "VIRTUAL_VIEWS", 9)
    splats, again = tmp_path / "s.ply", tmp_path / "o.safetensors"
    code, out, err = command("convert", octree_file, "--to", "splats", "--data", tiny_scene, "--out", splats)
    assert code == 0, err
    assert (
        "2 held-out views: octree" in out
        and "dB lost" in out
        and f"{load_model(splats).describe()['splats']:,} splats" in out
    )
    code, out, err = command("convert", splats, "--to", "octree", "--level", 5, "--out", again)
    assert code == 0, err
    assert f"pictures of {splats}" in out and load_model(again).kind == "octree"
    assert command("info", again)[0] == 0
    tuned = tmp_path / "t.safetensors"
    code, out, err = command(
        "convert", octree_file, "--to", "splats", "--data", tiny_scene, "--time-budget", "0.3s", "--out", tuned
    )
    assert code == 0 and "steps on the photographs" in out and load_model(tuned).metadata["near"] > 0, err
    tune, asked = tuning.tuned_octree, []

    def watched(octree, dataset, background, config, *more):
        asked.append(config.octree)
        return tune(octree, dataset, background, config, *more)

    monkeypatch.setattr(tuning, "tuned_octree", watched)
    code, out, err = command(
        "convert", splats, "--to", "octree", "--level", 5, "--data", tiny_scene, "--time-budget", "0.3s", "--out", again
    )
    assert code == 0 and "steps on the photographs" in out, err
    assert max(asked[0].levels) == 5  # no stage splits what was asked for
    # Twelve views are few: smooth, and before two backgrounds, as where train has so many.
    scene = SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]), None, False)
    few = Config(representation="octree").for_views(12, scene).octree
    names = ("tv_density", "tv_sh", "tv_from", "two_backgrounds")
    assert few.two_backgrounds and all(getattr(asked[0], name) == getattr(few, name) for name in names)


def test_convert_and_export_make_the_same_splats(tmp_path, command, octree_file):
    for name in ("s.ply", "s.spz"):
        if name.endswith("spz"):
            pytest.importorskip("gsply", reason="needs gsply")
        converted, exported = tmp_path / f"c_{name}", tmp_path / f"e_{name}"
        assert command("convert", octree_file, "--to", "splats", "--out", converted)[0] == 0
        assert (
            command("export", octree_file, "--out", exported, "--format", "splats" if name == "s.ply" else "spz")[0]
            == 0
        )
        unpack = gzip.decompress if name.endswith("spz") else bytes  # whose head has the time
        assert unpack(converted.read_bytes()) == unpack(exported.read_bytes())
    n = load_model(tmp_path / "c_s.ply").describe()["splats"]
    few = tmp_path / "few.ply"
    assert command("convert", octree_file, "--to", "splats", "--max-splats", n - 1, "--out", few)[0] == 0
    assert n / 16 < load_model(few).describe()["splats"] < n
    code, _, err = command("convert", octree_file, "--to", "splats", "--max-splats", 1, "--out", few)
    assert code == 2 and "at most 1 splats were asked for: this octree has" in err and err.count("\n") == 1, err


@pytest.mark.parametrize("arguments, reason", [
    (["--out", "x.safetensors"], "needs --to"),
    (["--to", "splats"], "needs --out"),
    (["--to", "octree", "--out", "x.safetensors"], "holds octree already"),
    (["--to", "splats", "--out", "x.obj"], "x.obj: expected a file that ends in .safetensors, .ply or .spz"),
    (["--to", "mesh", "--out", "x.safetensors"], "to: expected"),
    (["--to", "splats", "--out", "x.safetensors", "--data", "nowhere"], "--data nowhere: no such folder"),
    (["--to", "splats", "--out", "x.safetensors", "--time-budget", "3s"], "say which with --data"),
])  # fmt: skip
def test_what_cannot_be_is_one_sentence(command, octree_file, monkeypatch, tmp_path, arguments, reason):
    monkeypatch.chdir(tmp_path)
    code, _, err = command("convert", octree_file, *arguments)
    assert code == 2 and err.startswith("nerfvol: error: ") and err.count("\n") == 1 and reason in err, err


def test_splats_are_trained_from_an_octree(tmp_path, tiny_scene, command, octree_file, monkeypatch):
    begun = []
    monkeypatch.setattr(SplatTrainer, "__init__", lambda self, photographs, splats, *rest, init=SplatTrainer.__init__: (
        begun.append(splats), init(self, photographs, splats, *rest))[1])  # fmt: skip
    (tmp_path / "tiny.yaml").write_text(json.dumps({**TINY, "splats": {"steps": 3, "max_splats": 500}}))
    code, out, err = command(
        "train", "--data", tiny_scene, "--representation", "splats", "--init", octree_file, "--out", tmp_path / "run",
        "--config", tmp_path / "tiny.yaml",
    )  # fmt: skip
    assert code == 0, err
    assert "discs on what is seen of the" in out and 0 < begun[0].n <= 500
