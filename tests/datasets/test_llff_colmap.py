"""LLFF and COLMAP say the same of a scene as transforms.json, and damaged files are refused."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures import scenes

LENSES = {
    "PINHOLE": replace(scenes.LENS, fy=31.0, cx=11.5),
    "OPENCV": replace(scenes.LENS, k1=0.05, k2=-0.03, p1=0.004, p2=-0.002),
    "FULL_OPENCV": replace(scenes.LENS, k1=0.05, k2=-0.03, k3=0.01, p1=0.004, p2=-0.002),
    "OPENCV_FISHEYE": replace(scenes.LENS, k1=0.05, k2=-0.03, k3=0.01, k4=0.002, fisheye=True),
}


def agree(found, expected):
    """Two loaders' views of one scene: the same names, pixels and rays."""
    assert found.names == expected.names and len(found) > 0
    for a, b in zip(found.images, expected.images, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(found.cameras, expected.cameras, strict=True):
        assert a.intrinsics.fisheye == b.intrinsics.fisheye
        np.testing.assert_allclose(a.position, b.position, atol=1e-12)
        np.testing.assert_allclose(a.rays()[1], b.rays()[1], atol=4 * 2.0**-23)


def reference(folder, cameras, images):
    folder.mkdir()
    fisheye = {"is_fisheye": True} if cameras[0].intrinsics.fisheye else {}
    return scenes.write_instant_ngp(folder, cameras, images, **fisheye)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("text", [False, True])
def test_colmap_agrees_with_transforms(tmp_path, model, text):
    cameras, images = [Camera(LENSES[model], c.c2w) for c in scenes.ring()], scenes.random_images()
    scenes.write_colmap(tmp_path, cameras, images, model=model, text=text)
    other = reference(tmp_path / "other", cameras, images)
    for split in ("train", "val"):
        agree(load_dataset(tmp_path, split), load_dataset(other, split))


def test_quaternions_of_any_length_are_rotations(tmp_path):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), stretch=-1.01)
    agree(load_dataset(tmp_path), load_dataset(reference(tmp_path / "other", scenes.ring(), scenes.random_images())))


def test_llff_agrees_with_transforms(tmp_path):
    cameras, images = scenes.ring(), scenes.random_images()
    scenes.write_llff(tmp_path, cameras, images)
    other = reference(tmp_path / "other", cameras, images)
    agree(load_dataset(tmp_path), load_dataset(other))
    np.testing.assert_allclose(load_dataset(tmp_path).scene.aabb, load_dataset(other).scene.aabb, atol=1e-12)


def test_forward_facing_bounds_hold_what_lies_between_near_and_far(tmp_path):
    poses = [np.eye(4) for _ in range(9)]
    for i, pose in enumerate(poses):
        pose[:2, 3] = 0.1 * (i % 3), 0.1 * (i // 3)
    scenes.write_llff(tmp_path, [Camera(scenes.LENS, pose) for pose in poses], scenes.random_images())
    scene = load_dataset(tmp_path).scene
    # looking down -z from z = 0: depths 2 to 9, at 9 the image is 9 * 24 / 30 = 7.2 wide
    assert scene.aabb[0, 2] <= -9 and scene.aabb[1, 2] >= -2 and scene.aabb[1, 2] < 0.5
    half = (7.2 + 0.2) / 2
    np.testing.assert_allclose(scene.aabb[:, 0], [0.1 - half, 0.1 + half], atol=1e-12)
    assert scene.is_unbounded


def test_the_largest_copy_of_the_photographs_is_taken(tmp_path):
    scenes.write_llff(tmp_path, scenes.ring(), scenes.random_images(), factor=4)
    scenes.save_images(tmp_path / "images_8", scenes.random_images(size=(12, 8)))
    (tmp_path / "images_old").mkdir()
    assert load_dataset(tmp_path).images[0].shape == (16, 24, 3)
    for path in (tmp_path / "images_4").iterdir():
        path.unlink()
    (tmp_path / "images_4").rmdir()
    small = load_dataset(tmp_path)
    assert small.images[0].shape == (8, 12, 3) and small.cameras[0].intrinsics.fx == 15


def test_missing_photographs_of_a_model_are_left_out(tmp_path):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images())
    (tmp_path / "images" / "view_003.png").unlink()
    dataset = load_dataset(tmp_path)
    assert dataset.names == [f"view_{i:03d}" for i in (1, 2, 4, 5, 6, 7, 8)]  # view_000 alone is held out of eight
    assert any("lists 1 images that are not on disk" in message for message in dataset.messages)


@pytest.mark.parametrize("text", [False, True])
def test_poses_that_do_not_fit_the_points_of_the_model_are_doubted(tmp_path, text):
    """Poses of other photographs: half of the cameras look away from what their images are said to show, or stand so that
    it lies next to them. Where they look at it nothing is said, also right at the edge of their images."""
    cameras = scenes.ring()
    k = cameras[0].intrinsics
    edge = 0.5 * min(k.width / k.fx, k.height / k.fy) * 4.0  # at the ring's middle, 4 away
    places = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3)) * edge
    scenes.write_colmap(tmp_path, cameras, scenes.random_images(), text=text, model="PINHOLE")
    before = load_dataset(tmp_path).messages
    scenes.write_points(tmp_path, cameras, places, text=text)
    assert load_dataset(tmp_path).messages == before and not any("not the poses" in message for message in before)
    for away in (np.diag([-1.0, 1, -1, 1]), np.diag([1.0, -1, -1, 1])):
        turned = [replace(c, c2w=c.c2w @ away) if i % 9 < 5 else c for i, c in enumerate(cameras)]
        scenes.write_colmap(tmp_path, turned, scenes.random_images(), text=text, model="PINHOLE")
        assert any("only 44 % of what its tracks list lies inside" in m for m in load_dataset(tmp_path).messages)
    for axis, distance in ((0, 2.5), (0, -2.5), (1, 1.9), (1, -1.9)):  # images are half as wide again as they are high
        aside = [replace(c, c2w=c.c2w + np.outer(distance * edge * c.c2w[:, axis], [0, 0, 0, 1.0])) for c in cameras]
        scenes.write_colmap(tmp_path, aside, scenes.random_images(), text=text, model="PINHOLE")
        assert any("these are not the poses of the photographs" in m for m in load_dataset(tmp_path).messages)


@pytest.mark.parametrize("text", [False, True])
def test_poses_that_fit_badly_are_said_so(tmp_path, text):
    """By the errors that the model states; -1 is COLMAP's word for one that was not computed."""
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), text=text, model="PINHOLE")
    for error, said in ((3.25, True), (1.5, False), (-1.0, False)):
        scenes.write_points(tmp_path, scenes.ring(), [(0.0, 0.0, 0.0)] * 5, text=text, error=error)
        messages = load_dataset(tmp_path).messages
        assert any("3.2 pixels or more" in m and "nerfvol poses" in m for m in messages) == said, error
        assert any("the poses fit badly" in m for m in messages) == said, error


@pytest.mark.parametrize("nowhere", [np.nan, np.inf, -1e308])
def test_points_that_are_nowhere_are_in_no_image(tmp_path, nowhere):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), model="PINHOLE")
    scenes.write_points(tmp_path, scenes.ring(), [(0.0, 0.0, 0.0), (nowhere, nowhere, nowhere)])
    assert any("only 50 % of what its tracks list" in message for message in load_dataset(tmp_path).messages)


@pytest.mark.parametrize("text", [False, True])
def test_the_points_of_a_model(tmp_path, text):
    cameras, places = scenes.ring(), np.random.default_rng(0).uniform(-0.3, 0.3, (40, 3))
    scenes.write_colmap(tmp_path, cameras, scenes.random_images(), text=text)
    assert load_dataset(tmp_path).points is None
    scenes.write_points(tmp_path, cameras, places, text=text)
    dataset = load_dataset(tmp_path, "val", downscale=2)
    points = dataset.points
    assert points is dataset.points and len(points) == 40
    np.testing.assert_array_equal(points.positions, places)  # repr writes what float reads, in text too
    assert points.positions.dtype == np.float64 and points.colours.dtype == np.uint8
    np.testing.assert_array_equal(points.colours, [[1, 2, 250]] * 40)
    np.testing.assert_array_equal(points.track_lengths, [9] * 40)
    np.testing.assert_array_equal(points.errors, [0.5] * 40)
    assert points.source.endswith("points3D.txt" if text else "points3D.bin")
    assert replace(dataset, names=dataset.names).points.source == points.source
    scenes.write_points(tmp_path, cameras, [(np.nan, 0, 0), (0, 0, 1e300), (-np.inf, 0, 0), (3, 2, 1)], text=text)
    np.testing.assert_array_equal(load_dataset(tmp_path).points.positions, [[3, 2, 1]])


def test_points_are_read_when_they_are_asked_for(tmp_path, monkeypatch):
    """Of a model's points loading looks at some; what is damaged further on is said by whoever asks for all."""
    monkeypatch.setattr("nerfvol.datasets.colmap._MOST_POINTS", 2)
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images())
    scenes.write_points(tmp_path, scenes.ring(), np.zeros((3, 3)))
    edit(tmp_path / "sparse/0/points3D.bin", lambda d: d[:-7])
    dataset = load_dataset(tmp_path)
    with pytest.raises(InputError, match="points3D.bin: the file is truncated"):
        dataset.points  # noqa: B018


@pytest.mark.parametrize("colour", ["1 2 256", "1 -1 3", "1 2.5 3"])
def test_colours_that_are_none_are_refused(tmp_path, colour):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), text=True)
    scenes.write_points(tmp_path, scenes.ring(), np.zeros((3, 3)), text=True)
    edit(tmp_path / "sparse/0/points3D.txt", lambda d: d.replace(b"1 2 250", colour.encode(), 1))
    with pytest.raises(InputError, match="expected POINT3D_ID"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_damaged_points_are_refused(tmp_path, text):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), text=text)
    scenes.write_points(tmp_path, scenes.ring(), np.zeros((3, 3)), text=text)
    path = tmp_path / "sparse" / "0" / ("points3D.txt" if text else "points3D.bin")
    edit(path, (lambda d: d.replace(b" 0.5 ", b" half ")) if text else (lambda d: d[:-7]))
    if text:
        edit(path, lambda d: d.replace(b"0.0 0.0 0.0", b"0.0 here 0.0", 1))
    with pytest.raises(InputError, match="expected POINT3D_ID" if text else "truncated"):
        load_dataset(tmp_path)


def edit(path, change):
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize("name,change,sentence", [
    ("images.bin", lambda d: d[:100], "truncated"),
    ("images.bin", lambda d: d[:-5], "truncated"),
    ("images.bin", lambda d: struct.pack("<Q", 2**60) + d[8:], "truncated"),
    ("images.bin", lambda d: d[:72] + b"\xff" + d[73:], "no text"),
    ("images.bin", lambda d: d[:12] + struct.pack("<d", 3.0) + d[20:], "unit quaternion"),
    ("images.bin", lambda d: d[:12] + struct.pack("<d", 1e200) + d[20:], "unit quaternion"),
    ("images.bin", lambda d: d[:68] + struct.pack("<i", 99) + d[72:], "camera 99 is not in the model"),
    ("images.bin", lambda d: struct.pack("<Q", 0), "holds no images"),
    ("cameras.bin", lambda d: d[:20], "truncated"),
    ("cameras.bin", lambda d: d[:12] + struct.pack("<i", 16) + d[16:], "lens model EUCM is not supported"),
    ("cameras.bin", lambda d: d[:32] + struct.pack("<d", np.inf) + d[40:], "finite parameters"),
    ("cameras.bin", lambda d: d[:32] + struct.pack("<d", -1.0) + d[40:], "focal lengths must be positive"),
    ("cameras.bin", lambda d: d[:16] + struct.pack("<Q", 0) + d[24:], "finite parameters"),
    ("cameras.bin", lambda d: d[:16] + struct.pack("<Q", 48) + d[24:], "expected an image of 48x16"),
])  # fmt: skip
def test_damaged_colmap_models_are_refused(tmp_path, name, change, sentence):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images())
    edit(tmp_path / "sparse" / "0" / name, change)
    with pytest.raises(InputError, match=sentence) as caught:
        load_dataset(tmp_path, "val")  # the damage is in the first camera and image, which are held out
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name,old,new,sentence", [
    ("cameras.txt", "OPENCV", "EUCM", "unknown lens model"), ("cameras.txt", " 24 ", " wide ", "expected CAMERA_ID"),
    ("images.txt", "view_000.png", "", "expected IMAGE_ID"), ("images.txt", "1 ", "1 x ", "expected IMAGE_ID"),
])  # fmt: skip
def test_damaged_text_models_are_refused(tmp_path, name, old, new, sentence):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), text=True)
    edit(tmp_path / "sparse" / "0" / name, lambda data: data.replace(old.encode(), new.encode(), 1))
    with pytest.raises(InputError, match=sentence):
        load_dataset(tmp_path)


def rows(folder):
    return np.load(folder / "poses_bounds.npy")


@pytest.mark.parametrize("make,sentence", [
    (lambda r: r[:5], "holds 5 poses, but images_4 holds 9 images"),
    (lambda r: r[:, :16], r"shape \(views, 17\), got \(9, 16\)"),
    (lambda r: np.where(np.arange(9)[:, None] < 5, np.nan, 1.0) * r, "finite"),
    (lambda r: r.astype(complex), "floating-point"),
    (lambda r: np.concatenate([r[:, :15], r[:, 16:], r[:, 15:16]], axis=1), "0 < near < far"),
    (lambda r: np.concatenate([r[:, :1] + r[:, 1:2], r[:, 1:]], axis=1), "rigid"),
    (lambda r: np.array([{"a": 1}]), "cannot be read"),
])  # fmt: skip
def test_damaged_llff_poses_are_refused(tmp_path, make, sentence):
    scenes.write_llff(tmp_path, scenes.ring(), scenes.random_images())
    np.save(tmp_path / "poses_bounds.npy", make(rows(tmp_path)), allow_pickle=True)
    with pytest.raises(InputError, match=sentence):
        load_dataset(tmp_path)


def test_poses_that_are_no_array_are_refused(tmp_path):
    scenes.write_llff(tmp_path, scenes.ring(), scenes.random_images())
    whole = (tmp_path / "poses_bounds.npy").read_bytes()
    huge = whole.replace(b"(9, 17), }               ", b"(9999999999999999, 17), }")
    assert len(huge) == len(whole) and huge != whole
    broken = [whole[:-8], whole.replace(b"}", b" "), whole.replace(b"<f8", b"<f?"), huge]
    for content in (b"\x80\x04not an array", b"", *broken):
        (tmp_path / "poses_bounds.npy").write_bytes(content)
        with pytest.raises(InputError, match="cannot be read"):
            load_dataset(tmp_path)
