"""Scores: means of per-view values, against the right picture on the right background, with all they depend on."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from nerfvol.datasets.load import load_dataset
from nerfvol.measure import scores
from nerfvol.measure.scores import LARGEST_PSNR, evaluate, score_views
from nerfvol.octree.io import save_octree
from nerfvol.views import OctreeModel
from tests.fixtures.tiny import make_sphere_octree


@pytest.fixture(scope="module")
def dataset(tiny_scene):
    return load_dataset(tiny_scene, "train")


def test_psnr_is_the_mean_over_views_not_of_the_mean_error(dataset):
    """Truth plus a constant error e_i has PSNR -20 log10 e_i in view i, exactly."""
    levels = np.geomspace(0.01, 0.1, len(dataset))

    def render(camera):
        index = dataset.cameras.index(camera)
        truth = dataset.composited(index, (0.5, 0.5, 0.5))
        return np.where(truth > 0.5, truth - levels[index], truth + levels[index])  # stays inside [0, 1]

    scores = score_views(render, dataset, (0.5, 0.5, 0.5))
    expected = -20 * np.log10(levels)
    # float32 images: rounding of 6e-8 against errors of at least 0.01
    np.testing.assert_allclose([row["psnr"] for row in scores["rows"]], expected, atol=1e-3)
    assert math.isclose(scores["psnr"], expected.mean(), abs_tol=1e-3)
    assert [row["name"] for row in scores["rows"]] == dataset.names
    assert math.isclose(scores["ssim"], np.mean([row["ssim"] for row in scores["rows"]]))
    assert 0 < scores["ssim"] < 1


@pytest.mark.parametrize("views, expected", [(1, 10.0), (2, 1.0), (3, 1.5)])
def test_what_the_first_view_makes_for_all_is_no_frames_time(dataset, monkeypatch, views, expected):
    """Nodes that are made at an octree's first picture: two views had the mean of that and of a frame."""
    clock, takes = [0.0], iter((10.0, 1.0, 2.0))
    monkeypatch.setattr(scores, "time", SimpleNamespace(perf_counter=lambda: clock[0]))

    def render(camera):
        clock[0] += next(takes)
        return np.zeros((camera.intrinsics.height, camera.intrinsics.width, 3), np.float32)

    assert score_views(render, dataset.chosen(range(views)), (0, 0, 0))["seconds_per_frame"] == expected


def test_equal_images_score_a_finite_top(dataset):
    white = (1.0, 1.0, 1.0)
    scores = score_views(lambda camera: dataset.composited(dataset.cameras.index(camera), white), dataset, white)
    assert scores["psnr"] == LARGEST_PSNR and scores["ssim"] == pytest.approx(1.0)


def test_renders_are_clipped_before_they_are_compared(dataset):
    def render(camera):
        truth = dataset.composited(dataset.cameras.index(camera), (1, 1, 1))
        return np.where(truth >= 1, 7.0, truth).astype(np.float32)

    assert score_views(render, dataset, (1, 1, 1))["psnr"] == LARGEST_PSNR


def test_octree_of_the_scene_agrees_on_any_background(dataset):
    """The same sphere as pictures and as an octree: cameras, colours, alpha and backgrounds all have to agree."""
    octree = make_sphere_octree(7)
    pairs = []
    for background in ((1, 1, 1), (0, 0, 0), (0.2, 0.7, 0.1)):
        scores = evaluate(OctreeModel(octree), dataset, background, on_view=lambda *pair: pairs.append(pair), lod=0.0)
        assert scores["psnr"] > 28, background  # 29.5: the rim, a leaf of 1/64 wide
    assert len(pairs) == 3 * len(dataset)
    for index, truth, image in pairs:
        alpha = dataset.images[index][..., 3]
        inner = np.ones_like(alpha, bool)  # the soft rim of the octree is a leaf or two wide, less than two pixels
        for shift in (-2, 2):
            inner &= (np.roll(alpha, shift, 0) == alpha) & (np.roll(alpha, shift, 1) == alpha)
        inner &= (alpha == 0) | (alpha == 255)
        assert inner.mean() > 0.5
        # colours vary by 0.4 * 3 per unit; the octree's surface lies within one leaf (1/64) of the sphere: below 0.04
        assert np.abs(truth - image)[inner].max() < 0.05


def test_eval_command(tmp_path, tiny_scene, sphere_octree, command):
    from PIL import Image

    octree_file = tmp_path / "o.safetensors"
    save_octree(octree_file, sphere_octree, {"background": [0.0, 0.0, 0.0]})
    record_file, images = tmp_path / "scores.json", tmp_path / "images"
    code, text, _ = command(
        "eval", octree_file, "--data", tiny_scene, "--split", "test", "--json", record_file, "--save-images", images,
        "--threads", 1,
    )  # fmt: skip
    assert code == 0 and "PSNR" in text
    record = json.loads(record_file.read_text())
    assert record["n_images"] == len(record["rows"]) == 2
    held_out = load_dataset(tiny_scene, "test")
    background = (0.0, 0.0, 0.0)
    assert record["psnr"] == pytest.approx(evaluate(OctreeModel(sphere_octree), held_out, background)["psnr"], abs=1e-6)
    assert record["background"] == [0.0, 0.0, 0.0] and record["image_size"] == [40, 40]
    assert record["threads"] == 1 and record["split"] == "test" and record["kernel_path"]
    assert record["hardware"]["cpu"] and record["hardware"]["cores"] >= 1
    assert record["psnr"] == pytest.approx(np.mean([row["psnr"] for row in record["rows"]]))
    assert record["seconds_per_frame"] > 0
    for row in record["rows"]:
        # truth | render | error | depth, 8 pixels apart
        assert np.asarray(Image.open(images / f"{row['name']}.png")).shape == (40, 4 * 40 + 3 * 8, 3)
    code, text, _ = command("eval", octree_file, "--data", tiny_scene, "--downscale", 2, "--json", record_file)
    record = json.loads(record_file.read_text())
    assert code == 0 and record["image_size"] == [20, 20] and record["split"] == "val" and record["downscale"] == 2


def test_eval_options_from_a_file(tmp_path, tiny_scene, sphere_octree, command):
    save_octree(tmp_path / "o.safetensors", sphere_octree, {})
    config = tmp_path / "eval.yaml"
    config.write_text(f"data: {tiny_scene}\nsplit: train\nbackground: black\njson: {tmp_path / 's.json'}\n")
    assert command("eval", tmp_path / "o.safetensors", "--config", config, "--split", "val")[0] == 0
    record = json.loads((tmp_path / "s.json").read_text())
    assert record["split"] == "val" and record["background"] == [0, 0, 0]


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["none.safetensors", "--data", "."], "no such run folder or model file: none.safetensors"),
        ([".", "--data", "."], "is no run folder: it holds neither octree.safetensors"),
        (["o.safetensors"], "needs --data"),
        (["o.safetensors", "--data", "nowhere"], "nowhere"),
        (["o.safetensors", "--data", "SCENE", "--split", "all"], "split: expected train or val or test, got 'all'"),
        (["o.safetensors", "--data", "SCENE", "--json", "file/x.json"], "file, not a folder"),
        (["o.safetensors", "--data", "SCENE", "--background", "pink"], "white, black or R,G,B"),
        (["o.safetensors", "--data", "SCENE", "--downscale", "100"], "downscale"),
        (["o.safetensors", "--data", "SCENE", "--backgroud", "white"], "did you mean --background"),
        (["file", "--data", "SCENE"], "file is not a usable model file"),
        ([], "needs RUN|FILE"),
    ],
)
def test_bad_eval_arguments(tmp_path, tiny_scene, sphere_octree, command, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    save_octree("o.safetensors", sphere_octree, {})
    (tmp_path / "file").write_text("not an octree")
    arguments = [tiny_scene if word == "SCENE" else word for word in arguments]
    code, _, err = command("eval", *arguments)
    assert code == 2 and err.startswith("nerfvol: error: ") and err.count("\n") == 1
    assert reason in err, err
