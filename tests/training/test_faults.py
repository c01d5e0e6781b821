"""Faults around a run: other pictures, a second writer, a full disk, scenes far from the origin, signals."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from nerfvol.config.octree import FINEST_LEVEL, OctreeConfig, finest_level
from nerfvol.config.training import Config
from nerfvol.datasets.fingerprint import changes, fingerprint
from nerfvol.datasets.frame import Frame
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from nerfvol.files import atomic
from nerfvol.files.lock import only_writer
from nerfvol.files.run_folder import OCTREE, PREVIOUS, UNFINISHED
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds
from nerfvol.training.prepare import claim_folder
from nerfvol.views import render_image


@pytest.fixture
def dataset(tiny_scene):
    return load_dataset(tiny_scene, "train")


def changed(dataset, **columns):
    """A dataset with some columns replaced, in memory."""
    return dataclasses.replace(dataset, images=list(columns.pop("images", dataset.images)), **columns)


def test_a_fingerprint_knows_what_changed(dataset):
    before = fingerprint(dataset)
    assert changes(before, fingerprint(dataset)) is None
    fewer = dataset.evenly(len(dataset) - 1)
    assert "1 are gone" in changes(before, fingerprint(fewer))
    assert "1 are new" in changes(fingerprint(fewer), before)
    images = [image.copy() for image in dataset.images]
    images[2][0, 0, 0] ^= 1
    assert f"1 have other pixels or masks ({dataset.names[2]})" in changes(
        before, fingerprint(changed(dataset, images=images))
    )
    poses = [dataclasses.replace(c, c2w=c.c2w.copy()) for c in dataset.cameras]
    poses[1].c2w[0, 3] += 1e-2
    assert f"1 have another pose ({dataset.names[1]})" in changes(before, fingerprint(changed(dataset, cameras=poses)))
    masks = [np.full(image.shape[:2], 255, np.uint8) for image in dataset.images]
    assert "other pixels or masks" in changes(before, fingerprint(changed(dataset, masks=masks)))
    order = list(reversed(range(len(dataset))))
    turned = changed(
        dataset, images=[dataset.images[i] for i in order], cameras=[dataset.cameras[i] for i in order],
        names=[dataset.names[i] for i in order],
    )  # fmt: skip
    assert "another order" in changes(before, fingerprint(turned))


@pytest.fixture(scope="module")
def stopped(tmp_path_factory, tiny_scene):
    """A run that was stopped after five steps."""
    from tests.fixtures.runs import settings, start

    def stop(run, phase, began):
        run.interrupted = run.interrupted or phase.steps_done >= 5

    folder = tmp_path_factory.mktemp("stopped") / "run"
    with pytest.raises(KeyboardInterrupt):
        start(settings(tiny_scene, folder), say=lambda sentence: None, watch=stop)
    return folder


def edit(folder, change):
    """Changes the document of the training views."""
    path = folder / "transforms_train.json"
    document = json.loads(path.read_text())
    change(document["frames"])
    path.write_text(json.dumps(document))


def state(folder, **what):
    """States more at the top of the document of the training views."""
    path = folder / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | what))


def turn_over(path):
    Image.open(path).transpose(Image.Transpose.ROTATE_180).save(path)


@pytest.mark.parametrize("change, said", [
    (lambda d: [path.unlink() for path in sorted((d / "train").iterdir())[2:]], "10 are gone"),
    (lambda d: edit(d, lambda frames: frames.__delitem__(slice(2, None))), "10 are gone"),
    (lambda d: edit(d, lambda frames: frames.reverse()), "order"),
    (lambda d: edit(d, lambda frames: frames[3]["transform_matrix"][0].__setitem__(3, 3.3)), "another pose"),
    (lambda d: turn_over(sorted((d / "train").iterdir())[4]), "other pixels"),
    (lambda d: state(d, aabb=[[-1, -1, -1], [1, 1, 1]]), "the scene's aabb was"),
    (lambda d: edit(d, lambda frames: frames[3].update(light="noon")), "the lights that they are taken under"),
])  # fmt: skip
def test_a_run_is_resumed_with_its_own_pictures_alone(stopped, tmp_path, tiny_scene, command, change, said):
    """One sentence, whatever became of them, and nothing of the run is touched."""
    scene, run = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(tiny_scene, scene)
    shutil.copytree(stopped, run)
    change(scene)
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    code, _, err = command("train", "--resume", "--out", run, "--data", scene)
    assert code == 2 and "the data are not those that the run was begun with" in err and said in err
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before


def test_views_too_small_to_score_are_refused_before_the_first_step(tiny_scene, tmp_path, command):
    """40x40 at a quarter is 10x10, and SSIM's window 11x11."""
    out = tmp_path / "run"
    code, text, err = command("train", "--data", tiny_scene, "--downscale", 4, "--out", out, "--set", "octree.steps=3")
    assert code == 2 and not out.exists() and "training" not in text
    assert "is 10x10, expected 11x11 pixels" in err and err.count("\n") == 1


def test_what_a_killed_run_left_behind_is_swept(stopped, tmp_path, command):
    """Its temporaries, in the folder and among the previews: it may be killed while it writes either."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    gone = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True
    ).stdout.strip()
    (run / "previews").mkdir(exist_ok=True)
    left = [run / f"{place}.x.{gone}.{atomic._machine()}{'0' * 8}.tmp.png" for place in ("", "previews/")]
    for path in left:
        path.write_bytes(b"half")
    code, _, err = command("train", "--resume", "--out", run)
    assert code == 0, err
    assert not any(path.exists() for path in left)


def test_a_folder_has_one_writer(tmp_path):
    with only_writer(tmp_path, "trains"):
        code = "from nerfvol.files.lock import only_writer; from pathlib import Path; import sys\n" \
               "with only_writer(Path(sys.argv[1]), 'trains'): pass"  # fmt: skip
        other = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True)
        assert "another process trains there" in other.stderr
    assert not list(tmp_path.iterdir())
    with only_writer(tmp_path, "trains"):
        pass


def test_what_has_no_model_never_takes_the_place_of_one(tmp_path):
    """Two stopped runs over a finished one: its octree is still there, and still in RUN/previous."""
    run = tmp_path / "run"
    run.mkdir()
    (run / OCTREE).write_text("the octree")
    config = Config(data="d", out=str(run))
    for _ in range(3):  # each writes its config.yaml and is stopped
        claim_folder(config)
    assert (run / PREVIOUS / OCTREE).read_text() == "the octree"
    assert (run / UNFINISHED / "config.yaml").is_file()


@pytest.mark.parametrize("scale, shift", [(1.0, (441547.5, 5121946.5, 2345.25)), (1e-6, (0, 0, 0)), (1e8, (3e9, 0, 0))])
def test_a_frame_brings_a_scene_near_and_back(dataset, scale, shift):
    """Cameras, bounds and octree come back to where they were, to float64's rounding; ordinary scenes are left alone."""
    assert Frame.of(dataset.scene).is_identity
    move = np.asarray(shift, np.float64)
    cameras = [dataclasses.replace(c, c2w=np.vstack([np.c_[c.c2w[:3, :3], c.position * scale + move], c.c2w[3]]))
               for c in dataset.cameras]  # fmt: skip
    scene = SceneBounds(dataset.scene.aabb * scale + move, None, True)
    far = dataclasses.replace(dataset, cameras=cameras, scene=scene)
    frame = Frame.of(scene)
    near = frame.dataset_into(far)
    assert np.abs(near.scene.aabb).max() < 100 and 1e-2 < near.scene.side < 100
    back = frame.dataset_back(near)
    atol = 4 * np.finfo(float).eps * max(np.abs(move).max(), scale * 10)
    np.testing.assert_allclose(back.scene.aabb, scene.aabb, atol=atol, rtol=0)
    for a, b in zip(back.cameras, far.cameras, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=atol, rtol=0)


@pytest.mark.parametrize(
    "scale, shift", [(1.0, (441547.5, 5121946.5, 2345.25)), (1e-6, (0, 0, 0)), (2.0**27, (3e9, 0, 0))]
)
def test_pictures_do_not_depend_on_where_the_scene_lies(dataset, scale, shift):
    rng = np.random.default_rng(0)
    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), [-0.5] * 3, 1.0, density_scale=9.0)
    octree.values = rng.normal(size=octree.values.shape).astype(np.float32)
    camera = dataset.cameras[0].scaled(2)
    plain = render_image(octree, camera, (0.2, 0.5, 0.9), lod=0.0)
    moved = Octree(octree.node_mask, octree.leaf_mask, origin=octree.origin * scale + shift, size=scale, sh_degree=1,
                   density_scale=9.0 / scale)  # fmt: skip
    moved.values = octree.values
    pose = camera.c2w.copy()
    pose[:3, 3] = pose[:3, 3] * scale + shift
    far = render_image(moved, dataclasses.replace(camera, c2w=pose), (0.2, 0.5, 0.9), lod=0.0)
    # Where the offset costs float64 digits, a ray is off by eps * shift / scale root cubes; colours change by a few of that.
    off = np.finfo(float).eps * np.abs(shift).max() / scale
    np.testing.assert_allclose(far["rgb"], plain["rgb"], atol=1e-4 + 100 * off)
    np.testing.assert_allclose(far["depth"] / scale, plain["depth"], atol=1e-3)


@pytest.mark.parametrize("side", [8, 24, 72, 100, 200, 400, 800, 1080, 4000])
def test_stages_suit_the_pictures(side):
    """Nobody averages pictures below 24 pixels; stages agree with one another; large pictures have the plain schedule, larger
    ones that and stages of finer leaves, down to half a pixel, in the time of the last one."""
    config = OctreeConfig().for_pictures(side)
    assert max(config.downscales) == 1 or side // max(config.downscales) >= 24
    assert config.downscales[-1] == 1 and config.stage_ends[-1] == 1
    rows = list(zip(config.levels, config.downscales, strict=True))
    assert len(set(rows)) == len(rows) or side >= 400
    assert (config == OctreeConfig()) == (400 <= side < 1024)
    if side >= 1024:
        plain, finest = OctreeConfig(), min(finest_level(side), FINEST_LEVEL)
        assert (
            config.levels == plain.levels + list(range(11, finest + 1))
            and config.stage_ends[:6] == plain.stage_ends[:6]
        )
        config.check()
    mine = OctreeConfig(downscales=[8, 8, 4, 2, 1, 1, 1])
    assert mine.for_pictures(side) is mine


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="the system has no such signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)])
def test_a_run_that_is_told_to_end_saves_first(tiny_scene, tmp_path, number):
    from tests.fixtures.runs import settings, start

    told = []

    def say(sentence):
        told.append(sentence)
        if "training views of" in sentence:
            os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt):
        start(settings(tiny_scene, tmp_path / "run"), say=say)
    assert any("to go on: nerfvol train --resume" in sentence for sentence in told)
    assert (tmp_path / "run" / "checkpoint.safetensors").is_file()


def test_a_preview_that_cannot_be_written_is_a_warning(tiny_scene, tmp_path, monkeypatch):
    from nerfvol.files import pictures
    from tests.fixtures.runs import settings, start

    def full(path, image):
        raise InputError(f"cannot write {path}: no space is left on the device")

    monkeypatch.setattr(pictures, "write_png", full)
    told = []
    start(settings(tiny_scene, tmp_path / "run"), say=told.append)
    assert any(s.startswith("warning: cannot write") and "without this preview" in s for s in told)


@pytest.mark.parametrize("scale", [1e-6, 1e8])
def test_models_of_a_frame_come_back_looking_the_same(scale):
    """Octree and splats: sizes times the scale, densities over it, so that optical depths stay."""
    from nerfvol.splats.splats import Splats

    frame = Frame(np.array([5e6, 4e5, 10.0]), scale)
    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), [-0.5] * 3, 1.0, density_scale=9.0)
    back = frame.octree_back(octree)
    np.testing.assert_allclose([back.size, back.size * back.density_scale], [scale, 9.0])
    np.testing.assert_allclose(back.origin, frame.shift - 0.5 * scale, rtol=1e-15)
    rng = np.random.default_rng(0)
    splats = Splats(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=(5, 4)), rng.normal(size=5),
                    rng.normal(size=(5, 3, 1)), origin=np.array([1.0, 2, 3]))  # fmt: skip
    again = frame.splats_into(frame.splats_back(splats))
    np.testing.assert_allclose(again.means, splats.means, rtol=1e-6)
    np.testing.assert_allclose(again.log_scales, splats.log_scales, atol=1e-5)
    np.testing.assert_allclose(
        np.exp(frame.splats_back(splats).log_scales), scale * np.exp(splats.log_scales), rtol=1e-5
    )
    np.testing.assert_allclose(frame.splats_back(splats).origin, frame.back(splats.origin), rtol=1e-15)
