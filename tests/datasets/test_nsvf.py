"""NSVF's layout says the same of a scene as transforms.json, its names make the splits, and damaged files are refused."""

import numpy as np
import pytest

from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures import scenes

LENS = scenes.Intrinsics(24, 16, 30.0, 31.5, 11.75, 8.5)
BOX = [-1.0, -1.25, -0.75, 1.0, 1.5, 0.5]


def write(folder, **more):
    return scenes.write_nsvf(folder, scenes.ring(intrinsics=LENS), scenes.random_images(), **more)


def test_nsvf_agrees_with_transforms(tmp_path):
    expected = load_dataset(
        scenes.write_instant_ngp(tmp_path, scenes.ring(intrinsics=LENS), scenes.random_images()), "val"
    )
    found = load_dataset(write(tmp_path / "nsvf"), "val")  # without other names than training's every 8th is held out
    assert found.names == [f"0_{name}" for name in expected.names] and "every 8th view" in found.messages[0]
    for a, b in zip(found.images, expected.images, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(found.cameras, expected.cameras, strict=True):
        assert a.intrinsics == b.intrinsics
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-12)
    np.testing.assert_allclose(found.scene.aabb, expected.scene.aabb, atol=1e-12)
    assert found.points is None


def test_names_make_the_splits(tmp_path):
    write(tmp_path, prefixes=("0_", "1_", "2_"), box=BOX)
    for split, prefix in (("train", "0_"), ("val", "1_"), ("test", "2_")):
        dataset = load_dataset(tmp_path, split)
        assert len(dataset) == 3 and all(name.startswith(prefix) for name in dataset.names)
        np.testing.assert_array_equal(dataset.scene.aabb, np.reshape(BOX, (2, 3)))
        assert dataset.messages[-1] == "scene bounds: the aabb of the file" and len(dataset.messages) == 2


@pytest.mark.parametrize("prefix,missing", [("1_", "test"), ("2_", "val")])
def test_validation_and_test_stand_for_each_other(tmp_path, prefix, missing):
    write(tmp_path, prefixes=("0_", prefix))
    dataset = load_dataset(tmp_path, missing)
    assert len(dataset) == 4 and all(name.startswith(prefix) for name in dataset.names)
    assert f"no image is named for the {missing} views" in dataset.messages[0]


def test_other_names_are_split_by_holding_out(tmp_path):
    write(tmp_path, prefixes=("0_", "1_", "left_"))
    assert len(load_dataset(tmp_path)) == 7 and len(load_dataset(tmp_path, "val")) == 2


@pytest.mark.parametrize("text", [
    "30 11.75 8.5 0.\n0. 0. 0.\n0.\n1.\n16 24\n", "30 0 11.75\n0 30 8.5\n0 0 1\n",
    "30 0 11.75 0 0 30 8.5 0 0 0 1 0 0 0 0 1", "30 0 11.75 0\r\n0 30 8.5 0\r\n0 0 1 0\r\n0 0 0 1\r\n\r\n",
])  # fmt: skip
def test_the_ways_to_write_intrinsics(tmp_path, text):
    write(tmp_path)
    (tmp_path / "intrinsics.txt").write_bytes(text.encode())
    assert load_dataset(tmp_path).cameras[0].intrinsics == scenes.Intrinsics(24, 16, 30.0, 30.0, 11.75, 8.5)


@pytest.mark.parametrize("name,text,sentence", [
    ("intrinsics.txt", "", "expected a 4x4 matrix, got 0 rows"), ("intrinsics.txt", "f 30", "expected lines of numbers"),
    ("intrinsics.txt", "1 2\n3 4", r"expected a 4x4 matrix, got 2 rows of \[2\] numbers"),
    ("intrinsics.txt", "-30 0 12\n0 30 8\n0 0 1", "focal lengths must be positive"),
    ("intrinsics.txt", "nan 0 12\n0 30 8\n0 0 1", "fx must be a finite number"),
    ("pose/0_view_003.txt", "1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1", r"got 4 rows of \[3, 4\] numbers"),
    ("pose/0_view_003.txt", "1 1 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1", "0_view_003.txt: a camera pose must be rigid"),
    ("pose/0_view_003.txt", "1 0 0\n0 1 0\n0 0 1", r"must be a 4x4 \(or 3x4\) matrix, got shape \(3, 3\)"),
    ("bbox.txt", "0 0 0 1 1", "bbox.txt: the box must be two corners"),
    ("bbox.txt", "0 0 0 1 1 -1 0.4", "bbox.txt: the box must be finite with its first corner below"),
])  # fmt: skip
def test_damaged_files_are_refused(tmp_path, name, text, sentence):
    write(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(tmp_path):
    write(tmp_path)
    (tmp_path / "pose/0_view_003.txt").unlink()
    assert any(
        "1 of 9 images have no pose in pose, and are left out: 0_view_003.png" in m
        for m in load_dataset(tmp_path).messages
    )
    for image in (tmp_path / "rgb").iterdir():
        image.unlink()
    with pytest.raises(InputError, match="rgb: expected images, but there are none"):
        load_dataset(tmp_path)
