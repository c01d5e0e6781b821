"""What a model's file says of itself: no field of it, however odd, ends in a traceback or in a page of its own digits."""

import json

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from nerfvol.cameras.paths import describe_orbit, orbit_cameras
from nerfvol.cli.target import open_target
from nerfvol.datasets import decoding
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.files.run_folder import CONFIG
from nerfvol.models import load_model
from nerfvol.octree.io import save_octree
from nerfvol.splats.io import save_splats
from nerfvol.splats.splats import Splats
from tests.fixtures.tiny import write_scene

ORBIT = {"center": [0.5, 0.5, 0.5], "radius": 2.0, "elevation_deg": 20.0, "up": [0, 0, 1], "size": [16, 16]}
MANY = "9" * 5000


def edited(path, change):
    """The file at ``path`` with its document changed."""
    with safe_open(path, "numpy") as file:
        document = json.loads(file.metadata()["nerfvol"])
    change(document)
    save_file(load_file(path), path, {"nerfvol": json.dumps(document)})
    return path


@pytest.mark.parametrize("name", ["up", "size"])
def test_an_orbit_that_leaves_something_open_is_the_usual_one(sphere_octree, tmp_path, name):
    """None is as good as nothing."""
    for k, orbit in enumerate((ORBIT | {name: None}, {key: value for key, value in ORBIT.items() if key != name})):
        save_octree(tmp_path / f"{k}.safetensors", sphere_octree, {"orbit": orbit})
    first, second = (orbit_cameras(2, open_target(str(tmp_path / f"{k}.safetensors")).orbit(), None) for k in (0, 1))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.c2w, b.c2w)
        assert a.intrinsics == b.intrinsics


@pytest.mark.parametrize("name", ["center", "radius"])
def test_an_orbit_without_its_middle_or_radius_is_refused(sphere_octree, tmp_path, name):
    save_octree(tmp_path / "a.safetensors", sphere_octree, {"orbit": ORBIT | {name: None}})
    with pytest.raises(InputError, match=f"its orbit's {name} is None"):
        open_target(str(tmp_path / "a.safetensors")).orbit()


def test_where_a_run_was_seen_from_is_asked_of_its_cameras_and_no_picture_is_decoded(
    sphere_octree, tmp_path, monkeypatch
):
    """Of all that were trained on, not only of those that are looked at to tell what kind of scene it is."""
    write_scene(tmp_path / "scene", {"train": 30}, size=20)
    path = tmp_path / "octree.safetensors"
    save_octree(path, sphere_octree, {})
    (tmp_path / CONFIG).write_text(json.dumps({"data": str(tmp_path / "scene")}))
    dataset = load_dataset(tmp_path / "scene", "train")
    monkeypatch.setattr(decoding, "read_pixels", None)
    target = open_target(str(path))
    assert target.orbit() == describe_orbit(dataset.cameras, dataset.scene.aabb)
    cameras = target.training_cameras()
    assert len(cameras) == len(dataset.cameras) == 26  # every eighth is held out
    for camera, other in zip(cameras, dataset.cameras, strict=True):
        np.testing.assert_array_equal(camera.c2w, other.c2w)


def test_thousands_of_digits_are_not_repeated(sphere_octree, tmp_path):
    """In the version of a checkpoint, and in parameters of an octree's and splats' storage."""
    save_checkpoint(tmp_path / "checkpoint", {"phase": "octree"})
    edited(tmp_path / "checkpoint", lambda document: document.update(version=MANY))
    save_octree(tmp_path / "octree", sphere_octree, {}, "compact")
    edited(tmp_path / "octree", lambda document: document["codec"].update(density_softness=MANY))
    rows = np.random.default_rng(0).normal(size=(9, 23)).astype(np.float32)
    splats = Splats(rows[:, :3], rows[:, 3:6], rows[:, 6:10], rows[:, 10], rows[:, 11:23].reshape(9, 3, 4))
    save_splats(tmp_path / "splats", splats, {"near": 0.01}, "compact")
    edited(tmp_path / "splats", lambda document: document.update(format=MANY))
    for name, load in (("checkpoint", load_checkpoint), ("octree", load_model), ("splats", load_model)):
        with pytest.raises(InputError, match="9999") as refused:
            load(tmp_path / name)
        assert len(str(refused.value)) < 300, name
