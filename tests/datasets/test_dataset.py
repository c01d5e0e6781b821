"""What can be asked of posed images: a few of them, smaller ones, what stands right before a lens."""

import dataclasses
import os

import numpy as np
import pytest

from nerfvol.datasets import decoding, sampled
from nerfvol.datasets.dataset import NEAR_SHARE, Dataset
from nerfvol.datasets.load import dataset_cameras, load_dataset
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds
from tests.fixtures.scenes import random_images, ring
from tests.fixtures.tiny import write_scene


def test_a_few_views_come_from_all_around(tiny_scene):
    dataset = load_dataset(tiny_scene, "train")
    few = dataset.evenly(3)
    assert few.names == [dataset.names[i] for i in (0, 6, 11)]
    for name, image, camera in zip(few.names, few.images, few.cameras, strict=True):
        i = dataset.names.index(name)
        assert image is dataset.images[i] and camera is dataset.cameras[i]
    assert dataset.evenly(12) is dataset
    assert dataset.evenly(1).names == dataset.names[:1]


def test_smaller_views_are_the_pyramids(tiny_scene):
    dataset, background = load_dataset(tiny_scene, "train"), (0.2, 0.5, 0.9)
    small = dataset.smaller(4, background)
    assert small.names == dataset.names and small.scene is dataset.scene
    for image, expected in zip(small.images, dataset.pyramid(background, 4), strict=True):
        assert np.array_equal(image, expected)
    for camera, original in zip(small.cameras, dataset.cameras, strict=True):
        assert camera.intrinsics == original.intrinsics.scaled(4)
        np.testing.assert_allclose(camera.c2w, original.c2w, rtol=0, atol=1e-12)  # made orthonormal once more
    with pytest.raises(InputError, match="the downscale factor must be a positive integer, got 0"):
        dataset.smaller(0, background)


@pytest.mark.parametrize(
    "size, rows, columns",
    [(100, slice(0, 16), slice(0, 24)), (20, slice(0, 16), slice(2, 22)), (9, slice(3, 12), slice(7, 16))],
)
def test_the_middle_of_views(size, rows, columns):
    """Pixels and the rays that belong to them, of pictures of 24x16 pixels."""
    bounds = SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]), None, has_alpha=False)
    dataset = Dataset(ring(3), random_images(3), ["a", "b", "c"], bounds, "test")
    part = dataset.middles(size)
    for camera, image, whole, original in zip(part.cameras, part.images, dataset.cameras, dataset.images, strict=True):
        assert np.array_equal(image, original[rows, columns]) and np.shares_memory(image, original)
        directions, expected = camera.intrinsics.directions(), whole.intrinsics.directions()[rows, columns]
        np.testing.assert_allclose(directions, expected, rtol=0, atol=2e-7)
        np.testing.assert_allclose(camera.c2w, whole.c2w, rtol=0, atol=1e-12)


def test_a_part_must_lie_in_the_picture(tiny_scene):
    lens = load_dataset(tiny_scene, "train").cameras[0].intrinsics
    for place in [(-1, 0, 10, 10), (0, -1, 10, 10), (31, 0, 10, 10), (0, 31, 10, 10)]:
        with pytest.raises(InputError, match="no part of a 40x40 image"):
            lens.cropped(*place)


def test_what_stands_before_a_lens(tiny_scene):
    """Photographs only: a tenth of the median distance to the scene's middle, around each camera."""
    dataset = load_dataset(tiny_scene, "train")
    positions = np.stack([camera.position for camera in dataset.cameras])
    distances = np.linalg.norm(positions - dataset.scene.center, axis=1)
    outwards = (positions - dataset.scene.center) / distances[:, None]
    radius = NEAR_SHARE * np.median(distances)
    inside, outside = (positions + factor * radius * outwards for factor in (0.99, 1.01))
    points = np.concatenate([positions, inside, outside])
    assert not dataset.before_a_lens(points).any()
    with_shells = SceneBounds(dataset.scene.aabb, 8 * dataset.scene.aabb, has_alpha=False)
    hidden = dataclasses.replace(dataset, scene=with_shells).before_a_lens(points)
    assert hidden.tolist() == [True] * 24 + [False] * 12


def test_pictures_that_the_kind_of_scene_is_judged_by_are_decoded_once_for_all_splits(tmp_path, monkeypatch):
    """And again where a file has changed: by its time, or by its size."""
    write_scene(tmp_path, {"train": 5, "val": 2}, size=20)
    read, asked = sampled.read_small, []
    monkeypatch.setattr(sampled, "read_small", lambda path, size: asked.append(path.name) or read(path, size))
    sampled._sampled.cache_clear()
    for split in ("train", "val", "train"):
        kind = load_dataset(tmp_path, split).kind
    assert sorted(asked) == [f"r_{i}.png" for i in range(5)] and kind == "object"
    picture = tmp_path / "train" / "r_3.png"
    state = picture.stat()
    os.utime(picture, ns=(state.st_atime_ns, state.st_mtime_ns + 1000))
    load_dataset(tmp_path, "val")
    assert asked[5:] == ["r_3.png"]
    picture.write_bytes(picture.read_bytes() + b" ")
    os.utime(picture, ns=(state.st_atime_ns, state.st_mtime_ns + 1000))
    load_dataset(tmp_path, "val")
    assert asked[6:] == ["r_3.png"]


def test_only_the_views_that_are_wanted_are_decoded(tmp_path, monkeypatch):
    """``most``: evenly chosen, the same that Dataset.evenly takes of all."""
    write_scene(tmp_path, {"train": 5, "val": 7}, size=20)
    everything = load_dataset(tmp_path, "val").evenly(3)
    read, asked = decoding.read_pixels, []
    monkeypatch.setattr(decoding, "read_pixels", lambda path, *rest: asked.append(path.name) or read(path, *rest))
    some = load_dataset(tmp_path, "val", most=3)
    assert some.names == everything.names == ["r_0", "r_3", "r_6"] and sorted(asked) == [
        "r_0.png",
        "r_3.png",
        "r_6.png",
    ]
    for a, b in zip(some.images, everything.images, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("downscale", [1, 2])
def test_what_was_decoded_to_judge_the_scene_is_not_decoded_again(tmp_path, monkeypatch, downscale):
    """Pictures larger than those that are looked at: taken over whole, once, and then read again like all others."""
    write_scene(tmp_path, {"train": 3, "val": 1}, size=300)
    read, asked = decoding.read_pixels, []
    monkeypatch.setattr(decoding, "read_pixels", lambda path, *rest: asked.append(path.name) or read(path, *rest))
    sampled._sampled.cache_clear()
    dataset = load_dataset(tmp_path, "train", downscale)
    first = [image.copy() for image in dataset.images]
    assert asked == []
    dataset.release()
    for a, b in zip(first, dataset.images, strict=True):
        np.testing.assert_array_equal(a, b)
    assert sorted(asked) == ["r_0.png", "r_1.png", "r_2.png"]


@pytest.mark.parametrize("settings", [{}, {"downscale": 2, "holdout": "arc"}, {"scene": "surroundings"}])
@pytest.mark.parametrize("split", ["train", "val"])
def test_cameras_alone_are_those_of_the_pictures_and_decode_none_of_them(tmp_path, monkeypatch, split, settings):
    write_scene(tmp_path, {"train": 30, "val": 7}, size=20)
    dataset = load_dataset(tmp_path, split, **settings)
    monkeypatch.setattr(decoding, "read_pixels", None)
    cameras, scene = dataset_cameras(tmp_path, split, **settings)
    assert len(cameras) == len(dataset) > 1
    for camera, other in zip(cameras, dataset.cameras, strict=True):
        assert camera.intrinsics == other.intrinsics
        np.testing.assert_array_equal(camera.c2w, other.c2w)
    np.testing.assert_array_equal(scene.aabb, dataset.scene.aabb)
    assert scene.n_shells == dataset.scene.n_shells
