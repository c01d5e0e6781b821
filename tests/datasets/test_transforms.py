"""transforms*.json in its three dialects: one scene, the same cameras and pixels; splits; every kind of bad input."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures import scenes

DISTORTED = replace(scenes.LENS, fy=31.0, cx=11.2, cy=8.7, k1=0.05, k2=-0.03, k3=0.01, k4=0.002, p1=0.004, p2=-0.002)


def same_views(dataset, cameras, images, intrinsics):
    assert len(dataset) == len(cameras)
    for found, camera, pixels, image in zip(dataset.cameras, cameras, dataset.images, images, strict=True):
        np.testing.assert_array_equal(pixels, image)
        np.testing.assert_allclose(found.c2w, camera.c2w, atol=1e-14)
        for key in ("width", "height", "fx", "fy", "cx", "cy", *("k1", "k2", "k3", "k4", "p1", "p2")):
            assert math.isclose(getattr(found.intrinsics, key), getattr(intrinsics, key), rel_tol=1e-14), key


@pytest.mark.parametrize("writer", [scenes.write_blender, scenes.write_instant_ngp, scenes.write_nerfstudio])
def test_one_scene_in_every_dialect(tmp_path, writer):
    cameras, images = scenes.ring(), scenes.random_images()
    writer(tmp_path, cameras, images)
    held = load_dataset(tmp_path, "val")
    same_views(held, cameras[::8], images[::8], scenes.LENS)  # no split in the files: every 8th by name
    kept = [i for i in range(9) if i % 8]
    train = load_dataset(tmp_path, "train")
    same_views(train, [cameras[i] for i in kept], [images[i] for i in kept], scenes.LENS)
    assert train.names == [f"view_{i:03d}" for i in kept]
    assert "every 8th view by name is held out (2 of 9)" in train.messages[0]
    np.testing.assert_array_equal(train.scene.aabb, held.scene.aabb)


@pytest.mark.parametrize("writer", [scenes.write_instant_ngp, scenes.write_nerfstudio])
def test_lens_distortion_is_read(tmp_path, writer):
    cameras = [Camera(DISTORTED, c.c2w) for c in scenes.ring()]
    writer(tmp_path, cameras, scenes.random_images())
    same_views(load_dataset(tmp_path, "val"), cameras[::8], scenes.random_images()[::8], DISTORTED)


@pytest.mark.parametrize("key,value", [("camera_model", "OPENCV_FISHEYE"), ("is_fisheye", True)])
def test_fisheye_lenses_are_read(tmp_path, key, value):
    lens = replace(scenes.LENS, k1=0.05, k2=0.01, k3=0.002, k4=0.001)
    cameras = [Camera(lens, c.c2w) for c in scenes.ring()]
    scenes.write_instant_ngp(tmp_path, cameras, scenes.random_images(), **{key: value})
    assert load_dataset(tmp_path, "val").cameras[0].intrinsics == replace(lens, fisheye=True)


def test_a_frames_own_figures_win(tmp_path):
    names = scenes.save_images(tmp_path, scenes.random_images(2))
    own, other = scenes.ring(2)
    frames = [scenes.frame(names[0], own, fl_x=25.0, fl_y=26.0, cx=10.0, k1=0.2), scenes.frame(names[1], other)]
    scenes.write_json(tmp_path / "transforms_train.json", camera_angle_x=1.0, k1=0.1, frames=frames)
    scenes.write_json(tmp_path / "transforms_val.json", camera_angle_x=1.0, frames=frames)
    first, second = (c.intrinsics for c in load_dataset(tmp_path).cameras)
    assert (first.fx, first.fy, first.cx, first.cy, first.k1) == (25.0, 26.0, 10.0, 8.0, 0.2)
    assert math.isclose(second.fx, 12 / math.tan(0.5))
    assert (second.fy, second.cx, second.k1) == (second.fx, 12, 0.1)


def test_both_angles_and_degrees(tmp_path):
    names = scenes.save_images(tmp_path, scenes.random_images(2))
    frames = [scenes.frame(n, c) for n, c in zip(names, scenes.ring(2), strict=True)]
    scenes.write_json(tmp_path / "transforms.json", camera_angle_x=1.0, camera_angle_y=0.8, frames=frames)
    lens = load_dataset(tmp_path).cameras[0].intrinsics
    assert math.isclose(lens.fx, 12 / math.tan(0.5)) and math.isclose(lens.fy, 8 / math.tan(0.4))
    scenes.write_json(tmp_path / "transforms.json", x_fov=60.0, frames=frames)
    assert math.isclose(load_dataset(tmp_path).cameras[0].intrinsics.fx, 12 / math.tan(math.pi / 6))


@pytest.mark.parametrize("on_disk,listed", [
    ("a.PNG", "./a"), ("a.png", "a.png"), ("A.png", "a.png"), ("a.JPG", "a.jpg"), ("sub/a.jpeg", "sub\\a"),
    ("a.1.png", "a.1"),
])  # fmt: skip
def test_images_are_found_as_listed(tmp_path, on_disk, listed):
    path = tmp_path / on_disk
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(scenes.random_images(1)[0]).save(path)
    frames = [scenes.frame(listed, scenes.ring(1)[0])]
    scenes.write_json(tmp_path / "transforms.json", camera_angle_x=1.0, frames=frames)
    dataset = load_dataset(tmp_path)
    assert len(dataset) == 1 and dataset.names == [("a.1" if "1" in listed else "a")]
    assert any("single view" in message for message in dataset.messages)


def test_names_that_repeat_keep_their_folders(tmp_path):
    frames = []
    for folder, camera in zip(("left", "right"), scenes.ring(2), strict=True):
        names = scenes.save_images(tmp_path / folder, scenes.random_images(1))
        frames.append(scenes.frame(f"./{folder}/{names[0]}", camera))
    for split in ("train", "val"):
        scenes.write_json(tmp_path / f"transforms_{split}.json", camera_angle_x=1.0, frames=frames)
    assert load_dataset(tmp_path).names == ["left_view_000", "right_view_000"]


def test_missing_images_are_reported_and_left_out(tmp_path):
    cameras, images = scenes.ring(), scenes.random_images()
    scenes.write_instant_ngp(tmp_path, cameras, images)
    for i in (0, 5):
        (tmp_path / "images" / f"view_{i:03d}.png").unlink()
    train, held = load_dataset(tmp_path), load_dataset(tmp_path, "val")
    present = [1, 2, 3, 4, 6, 7, 8]
    same_views(held, [cameras[1]], [images[1]], scenes.LENS)
    same_views(train, [cameras[i] for i in present[1:]], [images[i] for i in present[1:]], scenes.LENS)
    assert any(m.startswith("transforms.json lists 2 images that are not on disk") for m in train.messages)


def test_val_stands_for_test(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(), splits=("train", "val"))
    assert len(load_dataset(tmp_path)) == 9
    held = load_dataset(tmp_path, "test")
    assert len(held) == 9 and "the val views are used instead" in held.messages[0]


def test_listed_splits_are_used(tmp_path):
    named = {
        "train_filenames": [f"images/view_{i:03d}.png" for i in (0, 1, 2, 3)],
        "val_filenames": ["images/view_004.png"],
        "test_filenames": ["images/view_005.png", "images/view_006.png"],
    }
    scenes.write_nerfstudio(tmp_path, scenes.ring(), scenes.random_images(), **named)
    sizes = {split: load_dataset(tmp_path, split).names for split in ("train", "val", "test")}
    assert sizes["val"] == ["view_004"] and sizes["test"] == ["view_005", "view_006"] and len(sizes["train"]) == 4


def test_a_json_file_can_be_named_itself(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images())
    assert len(load_dataset(tmp_path / "transforms_train.json", "train")) == 7


def test_downscale_averages_premultiplied_colour_and_follows_with_the_camera(tmp_path):
    images = scenes.random_images(9, channels=4)
    scenes.write_blender(tmp_path, scenes.ring(), images, splits=("train", "val"))
    small = load_dataset(tmp_path, downscale=4)
    assert small.cameras[0].intrinsics == load_dataset(tmp_path).cameras[0].intrinsics.scaled(4)
    alpha = images[3][..., 3:] / 255
    truth = (images[3][..., :3] * alpha).reshape(4, 4, 6, 4, 3).mean(axis=(1, 3)) / 255
    # half a level from rounding colour, half from rounding alpha
    assert np.abs(small.composited(3, (0, 0, 0)) - truth).max() <= 1 / 255 + 1e-6
    assert all(image.shape == (4, 6, 4) for image in small.images)


def test_the_pyramid_composites_and_averages(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(9, channels=4), splits=("train", "val"))
    dataset = load_dataset(tmp_path, threads=3)
    for k in (1, 2, 8):
        for i, level in enumerate(dataset.pyramid((1, 0.5, 0), k)):
            truth = dataset.composited(i, (1, 0.5, 0)).reshape(16 // k, k, 24 // k, k, 3).mean(axis=(1, 3))
            assert level.dtype == np.uint8 and np.abs(level / 255 - truth).max() <= 0.51 / 255
    with pytest.raises(InputError, match="factor"):
        dataset.pyramid((1, 1, 1), 0)


def test_alpha_that_hides_nothing_is_dropped(tmp_path):
    images = scenes.random_images(9, channels=4)
    for image in images:
        image[..., 3] = 255
    scenes.write_blender(tmp_path, scenes.ring(), images, splits=("train", "val"))
    dataset = load_dataset(tmp_path)
    assert not dataset.scene.has_alpha and dataset.scene.is_unbounded
    np.testing.assert_array_equal(dataset.images[2], images[2][..., :3])


def test_cameras_inside_the_bounds_simply_work(tmp_path):
    scenes.write_instant_ngp(tmp_path, scenes.ring(), scenes.random_images())
    dataset = load_dataset(tmp_path, aabb=[-9, -9, -9, 9, 9, 9])
    np.testing.assert_array_equal(dataset.scene.aabb, [[-9] * 3, [9] * 3])


# --- bad input: one clear sentence each -------------------------------------------------------------------------------


def scene_json(tmp_path, change):
    """Nine good views, then ``change`` applied to the json."""
    scenes.write_instant_ngp(tmp_path, scenes.ring(), scenes.random_images())
    path = tmp_path / "transforms.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def put(key, value):
    return lambda data: data.update({key: value})


def put_in_frame(key, value):
    return lambda data: data["frames"][3].update({key: value})


def bend(row, column, value):
    def change(data):
        data["frames"][3]["transform_matrix"][row][column] = value

    return change


BAD_JSON = {
    "no frames": (put("frames", []), 'non-empty list "frames"'),
    "frames is no list": (put("frames", {"a": 1}), 'non-empty list "frames"'),
    "frame is no object": (lambda data: data["frames"].__setitem__(3, "view"), "frame 3: expected an object"),
    "scaled pose": (bend(0, 0, 4.0), "frame 3.*must be rigid"),
    "text in a pose": (bend(0, 0, "one"), "frame 3.*4 rows of 4 numbers"),
    "number beyond floats in a pose": (bend(0, 0, 10**400), "frame 3.*4 rows of 4 numbers"),
    "ragged pose": (put_in_frame("transform_matrix", [[1, 0], [0]]), "frame 3.*4 rows of 4 numbers"),
    "pose of another shape": (put_in_frame("transform_matrix", [[1, 0], [0, 1]]), r"frame 3.*shape \(2, 2\)"),
    "no pose": (lambda data: data["frames"][3].pop("transform_matrix"), "frame 3.*transform_matrix is missing"),
    "no file name": (put_in_frame("file_path", None), "frame 3: expected file_path"),
    "zero byte in a file name": (put_in_frame("file_path", "a\0b"), "frame 3: expected file_path"),
    "zero focal length": (put("fl_x", 0), "focal lengths must be positive.*singular"),
    "infinite focal length": (put("fl_x", math.inf), "fl_x must be a finite number"),
    "no focal length": (lambda data: [data.pop("fl_x"), data.pop("fl_y")], "focal length is missing"),
    "half turn of view": (lambda d: [d.pop("fl_x"), d.pop("fl_y"), d.update(camera_angle_x=math.pi)], "0 and pi"),
    "text in the calibration": (put("k1", "big"), "k1 must be a finite number"),
    "true in the calibration": (put("cx", True), "cx must be a finite number"),
    "half a pixel": (put("w", 24.5), "w must be a whole number"),
    "image of another size": (put("w", 25), "expected an image of 25x16 pixels as its calibration states, got 24x16"),
    "unknown lens": (put("camera_model", "EQUIRECTANGULAR"), "'EQUIRECTANGULAR' is not supported"),
    "lens by another name": (put("equirectangular", True), "equirectangular is not supported"),
    "lens that folds over": (put("k1", -9.0), "cannot be undone"),
    "names that are no list": (put("train_filenames", "images/view_003.png"), "train_filenames must be a list"),
    "negative aabb_scale": (put("aabb_scale", -1), "aabb_scale must be positive"),
    "flat aabb": (put("aabb", [[0, 0, 0], [1, 1, 0]]), "aabb must be finite with its first corner below"),
    "aabb of words": (put("aabb", [["a", 0, 0], [1, 1, 0]]), "aabb must be two corners"),
}


@pytest.mark.parametrize("kind", BAD_JSON)
def test_bad_json_is_refused_in_one_sentence(tmp_path, kind):
    change, sentence = BAD_JSON[kind]
    scene_json(tmp_path, change)
    with pytest.raises(InputError, match=sentence) as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("content,sentence", [
    (b"", "is not JSON"), (b"{", "is not JSON"), (b"{}", '"frames"'), (b"[1, 2]", '"frames"'),
    (b"\xff\xfe\x00", "UTF-8"), (b"[" * 200_000, "nested too deeply"),
])  # fmt: skip
def test_what_is_no_json_is_refused(tmp_path, content, sentence):
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        load_dataset(tmp_path)


def test_missing_folders_and_odd_arguments(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(InputError, match="split must be one of"):
        load_dataset(tmp_path, "training")
    with pytest.raises(InputError, match="downscale must be"):
        load_dataset(tmp_path, downscale=0)


def test_a_split_that_is_not_there(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(), splits=("val", "test"))
    with pytest.raises(InputError, match="expected transforms_train.json"):
        load_dataset(tmp_path)
    assert len(load_dataset(tmp_path, "val")) == 9


def test_no_image_left(tmp_path):
    scenes.write_instant_ngp(tmp_path, scenes.ring(), scenes.random_images())
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="none of the 9 images it lists exists"):
        load_dataset(tmp_path)


def test_a_truncated_image_names_its_file(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(9, (60, 60)), splits=("train", "val"))
    path = tmp_path / "train" / "view_004.png"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match="view_004.png: the image is damaged or truncated"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("kept", [5000, 20], ids=["body", "header"])
def test_one_damaged_image_of_many_is_left_out_and_named(tmp_path, kept):
    """A card that lost one file does not cost a set of twelve; two in twelve do, and so does one of nine."""
    scenes.write_blender(tmp_path, scenes.ring(12), scenes.random_images(12, (60, 60)), splits=("train", "val"))
    whole = load_dataset(tmp_path)
    for name in ("view_004.png", "view_007.png"):
        path = tmp_path / "train" / name
        path.write_bytes(path.read_bytes()[:kept])
        if name == "view_004.png":
            dataset = load_dataset(tmp_path)
            assert len(dataset) == len(dataset.images) == len(dataset.cameras) == 11
            assert dataset.names == [n for n in whole.names if "view_004" not in n]
            assert np.array_equal(dataset.cameras[4].c2w, whole.cameras[5].c2w)
            (said,) = [m for m in dataset.messages if "cannot be read" in m]
            assert said.startswith("1 images cannot be read and are left out") and "view_004.png" in said
            dataset.images.release()
            assert np.array_equal(dataset.images[4], whole.images[5])
    with pytest.raises(InputError, match="view_00[47].png"):
        load_dataset(tmp_path)


def test_one_image_of_another_size(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(), splits=("train", "val"))
    Image.new("RGB", (25, 16)).save(tmp_path / "train" / "view_004.png")
    with pytest.raises(InputError, match="view_004.png: expected an image of 24x16 pixels like .*, got 25x16"):
        load_dataset(tmp_path)


def test_all_transparent_images(tmp_path):
    images = scenes.random_images(9, channels=4)
    for image in images:
        image[..., 3] = 0
    scenes.write_blender(tmp_path, scenes.ring(), images, splits=("train", "val"))
    with pytest.raises(InputError, match="all 9 images are fully transparent"):
        load_dataset(tmp_path)
    images[4][3, 3, 3] = 1
    scenes.write_blender(tmp_path, scenes.ring(), images, splits=("train", "val"))
    assert load_dataset(tmp_path).scene.has_alpha


def test_bounds_no_camera_sees(tmp_path):
    scene_json(tmp_path, put("aabb", [[900, 900, 900], [901, 901, 901]]))
    for path in (tmp_path / "images").iterdir():
        Image.fromarray(scenes.random_images(1, channels=4)[0]).save(path)
    with pytest.raises(InputError, match="seen by none of the 7 cameras"):
        load_dataset(tmp_path)
    with pytest.raises(InputError, match="finite with its first corner below"):
        load_dataset(tmp_path, aabb=[0, 0, 0, 1, 1, math.nan])


def test_more_than_memory_is_refused_before_decoding(tmp_path, monkeypatch):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(9, (240, 160)), splits=("train", "val"))
    monkeypatch.setattr("nerfvol.datasets.load.total_memory", lambda: 2**20)  # of the container, where that is lower
    with pytest.raises(InputError, match="9 images need 0.0 GiB and there are 0.0 GiB of memory; use a downscale of 2"):
        load_dataset(tmp_path)
    assert len(load_dataset(tmp_path, downscale=2)) == 9
    monkeypatch.setattr("nerfvol.datasets.load.total_memory", lambda: None)  # a platform that does not tell
    assert len(load_dataset(tmp_path)) == 9


def test_intrinsics_equality_shares_one_ray_table(tmp_path):
    scenes.write_instant_ngp(tmp_path, scenes.ring(), scenes.random_images())
    dataset = load_dataset(tmp_path)
    assert len({camera.intrinsics for camera in dataset.cameras}) == 1
    assert dataset.cameras[0].intrinsics == Intrinsics(24, 16, 30.0, 30.0, 12.0, 8.0)


def test_two_independent_camera_codes_agree_through_the_file(tmp_path):
    """data_synth writes poses with its own camera code; the rays made from its file are the rays it rendered with."""
    from data_synth.cameras import Camera as SynthCamera
    from data_synth.cameras import look_at, pixel_ray

    synth = [SynthCamera(24, 16, 31.7, look_at(eye)) for eye in ([3.0, 1.0, 2.0], [-2.0, 2.5, -0.3], [0.1, -4.0, 1.0])]
    names = scenes.save_images(tmp_path, scenes.random_images(3))
    frames = [{"file_path": n, "transform_matrix": c.c2w.tolist()} for n, c in zip(names, synth, strict=True)]
    for split in ("train", "val"):
        scenes.write_json(tmp_path / f"transforms_{split}.json", camera_angle_x=synth[0].angle_x, frames=frames)
    for camera, truth in zip(load_dataset(tmp_path).cameras, synth, strict=True):
        origin, directions = camera.rays()
        expected = [pixel_ray.py_func(truth.data(), i + 0.5, j + 0.5) for j in range(16) for i in range(24)]
        np.testing.assert_allclose(origin, truth.c2w[:3, 3], rtol=2.0**-23)
        np.testing.assert_allclose(directions, expected, atol=4 * 2.0**-23)
