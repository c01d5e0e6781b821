"""One odd member of a set does not decide for all, and what nobody reads is said: entries, lenses, pictures, lists, files."""

import json
import math
import shutil

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.further_lenses import Rational
from nerfvol.cameras.lens import BrownConrady, Fisheye
from nerfvol.config.octree import OctreeConfig
from nerfvol.datasets.load import dataset_cameras, load_dataset
from nerfvol.errors import InputError
from nerfvol.training import surface_stages
from tests.datasets.test_whatever_people_bring import said, scene
from tests.fixtures import scenes


def of_third(**what):
    """Says more, or else, of the third frame."""
    return lambda document: document["frames"][3].update(what)


def mirrored(document):
    for row in document["frames"][3]["transform_matrix"][:3]:
        row[0] *= -1


# ------------------------------------------------------------------ entries
@pytest.mark.parametrize(("change", "why"), [
    (of_third(fl_x=math.nan), "fl_x must be a finite number"), (of_third(fl_x="unknown"), "fl_x must be a finite number"),
    (of_third(transform_matrix=None), "a camera pose must be"), (of_third(camera_model="PANORAMA"), "not supported"),
    (of_third(transform_matrix=[[0] * 4] * 4), "the last row"), (mirrored, "mirrored rotation"),
    (lambda d: d["frames"][3].pop("transform_matrix"), "transform_matrix is missing"),
    (lambda d: d["frames"].__setitem__(3, None), "expected an object"), (of_third(file_path=7), "expected file_path"),
])  # fmt: skip
def test_one_entry_that_cannot_be_used_is_left_out(tmp_path, change, why):
    dataset = load_dataset(scene(tmp_path, change=change))
    assert len(dataset) == 9
    said(dataset, "1 of 12 frames cannot be used and are left out", why)


def test_one_sheared_pose_is_no_odd_one(tmp_path):
    """Axes that are not at right angles are a convention misread, or an edited file: nothing is trained on the rest."""

    def change(document):
        document["frames"][3]["transform_matrix"][0][0] += 9

    with pytest.raises(InputError, match=r"frame 3 .*must be rigid .*orthonormal only to"):
        load_dataset(scene(tmp_path, change=change))


def test_entries_that_cannot_be_used_and_are_not_few_are_refused(tmp_path):
    def change(document):
        for frame in document["frames"][3:6]:
            frame["fl_x"] = math.nan

    with pytest.raises(InputError, match="frame 3 .*fl_x must be a finite number"):
        load_dataset(scene(tmp_path, change=change))


@pytest.mark.parametrize("line", ["4 0 0 0 0 0 0 4 4 view_003.png", "4 1 0 0 0 0 0 4 99 view_003.png"])
def test_one_image_of_a_model_that_cannot_be_used_is_left_out(tmp_path, line):
    scenes.write_colmap(tmp_path, scenes.ring(12), scenes.random_images(12), text=True)
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    lines[next(i for i, old in enumerate(lines) if old.endswith("view_003.png"))] = line
    path.write_text("\n".join(lines) + "\n")
    dataset = load_dataset(tmp_path)
    assert len(dataset) == 9 and not [m for m in dataset.messages if "photographs are not" in m]
    said(dataset, "1 of 12 frames cannot be used", "view_003.png")


def test_a_frame_twice_counts_once(tmp_path):
    dataset = load_dataset(scene(tmp_path, change=lambda d: d["frames"].append(dict(d["frames"][3]))))
    assert len(dataset) == 10
    said(dataset, "1 frames are in the file twice", "view_003")


# ------------------------------------------------------------------ lenses and poses
def test_a_focal_length_unlike_all_others_is_left_out(tmp_path):
    dataset = load_dataset(scene(tmp_path, change=of_third(fl_x=9000.0, fl_y=9000.0)))
    assert len(dataset) == 9 and {c.intrinsics.fx for c in dataset.cameras} == {30.0}
    said(dataset, "more than 20 times as long or short")


def test_zooms_and_two_phones_are_no_mistake(tmp_path):
    dataset = load_dataset(scene(tmp_path, change=of_third(fl_x=240.0, fl_y=240.0)))
    assert len(dataset) == 10 and not [m for m in dataset.messages if "as long" in m]


@pytest.mark.parametrize(("lost", "left", "words"), [
    ([3, 4, 5], 7, "3 of 10 images have one pose, the identity"), ([4], 10, "is the identity: was its camera found"),
])  # fmt: skip
def test_poses_that_a_tracker_lost_are_told_by_the_identity(tmp_path, lost, left, words):
    def change(document):
        for i in lost:
            document["frames"][i]["transform_matrix"] = np.eye(4).tolist()

    dataset = load_dataset(scene(tmp_path, change=change))
    assert len(dataset) == left
    said(dataset, words)


# ------------------------------------------------------------------ pictures
@pytest.mark.parametrize("channels", [3, 4])
def test_one_picture_that_shows_nothing_is_left_out(tmp_path, channels):
    images = scenes.random_images(12, channels=channels)
    images[3][:] = 0
    images[5][:4] = 0
    dataset = load_dataset(scene(tmp_path, images=images))
    assert len(dataset) == 9 and len(dataset.images) == 9 and "view_003" not in dataset.names
    said(dataset, "1 of 10 images show nothing")
    assert len(load_dataset(tmp_path, "val")) == 2


@pytest.mark.parametrize(("downscale", "size", "left"), [
    (1, (4, 3), 7), (1, (41, 31), 7), (1, (43, 32), 8), (2, (40, 30), 7), (2, (43, 32), 8), (4, (60, 45), 7), (4, (88, 66), 8),
])  # fmt: skip
def test_a_thumbnail_among_photographs_is_left_out_and_the_others_can_be_reduced(tmp_path, downscale, size, left):
    """800 pixels wide: 32 are a 25th, and half as large 16, as few as there may be."""
    images = [np.broadcast_to((np.arange(800) + i).astype(np.uint8)[:, None], (600, 800, 3)) for i in range(10)]
    images[9] = images[9][: size[1], : size[0]]
    lens = {"w": 800, "h": 600, "fl_x": 700.0, "fl_y": 700.0}

    def change(document):
        document["frames"][9].update(w=size[0], h=size[1], fl_x=0.9 * size[0], fl_y=0.9 * size[0])

    dataset = load_dataset(scene(tmp_path, 10, change=change, images=images, **lens), downscale=downscale)
    assert len(dataset) == len(dataset.images) == left
    cameras, bounds = dataset_cameras(tmp_path, downscale=downscale)
    assert [camera.intrinsics for camera in cameras] == [camera.intrinsics for camera in dataset.cameras]
    np.testing.assert_array_equal(bounds.aabb, dataset.scene.aabb)
    if left == 7:
        plain = scene(tmp_path / "plain", 9, images=images[:9], cameras=scenes.ring(10)[:9], **lens)
        np.testing.assert_array_equal(load_dataset(plain, downscale=downscale).scene.aabb, bounds.aabb)
        assert "view_009" in said(dataset, "1 of 8 images are thumbnails")
    factor = surface_stages.image_factor(dataset.cameras, rays=1)
    smallest = max(factor, *OctreeConfig().for_pictures(600 // downscale).downscales)
    assert factor > 1
    assert all(camera.scaled(smallest) for camera in dataset.cameras)


def test_a_split_of_thumbnails_alone_stays(tmp_path):
    """Every eighth view is held out: those are the small ones, and what they show is still compared."""
    images = scenes.random_images(9, (240, 180))
    images[0] = images[8] = images[0][:15, :20]

    def change(document):
        for i in (0, 8):
            document["frames"][i].update(w=20, h=15, fl_x=20.0, fl_y=20.0)

    scene(tmp_path, 9, change=change, images=images, w=240, h=180, fl_x=240.0, fl_y=240.0)
    assert len(load_dataset(tmp_path)) == 7
    assert [image.shape for image in load_dataset(tmp_path, "val").images] == [(15, 20, 3)] * 2


def test_pictures_that_were_converted_are_found(tmp_path):
    scene(tmp_path)
    for path in sorted((tmp_path / "images").iterdir())[:6]:
        Image.open(path).save(path.with_suffix(".JPG"), "JPEG")
        path.unlink()
    assert len(load_dataset(tmp_path)) == 10
    for suffix in (".webp", ".bmp"):  # two of them: which is meant is not known
        Image.new("RGB", (24, 16)).save(tmp_path / "images" / f"view_011{suffix}")
    (tmp_path / "images/view_011.png").unlink()
    said(load_dataset(tmp_path), "1 images that are not on disk")


@pytest.mark.parametrize("listed", [
    "IMAGES/VIEW_{:03d}.PNG", " images/view_{:03d}.png", "images/view_{:03d}.png\n", "images_2/view_{:03d}.png",
    ".\\Images\\view_{:03d}",
])  # fmt: skip
def test_pictures_that_are_listed_in_another_spelling_or_size_are_found(tmp_path, listed):
    def rename(document):
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = listed.format(i)

    scene(tmp_path, change=rename)
    (tmp_path / "masks").mkdir()
    assert len(load_dataset(tmp_path)) == 10
    shutil.copytree(tmp_path / "images", tmp_path / "images_8")  # the least reduced is taken
    assert len(load_dataset(tmp_path)) == 10


@pytest.mark.parametrize("mask", [b"", scenes.png_bytes(np.zeros((5, 24, 1), np.uint8))])
def test_one_mask_that_cannot_be_used_takes_its_picture_with_it(tmp_path, mask):
    scene(tmp_path)
    (tmp_path / "masks").mkdir()
    whole = np.full((16, 24, 1), 255, np.uint8)
    whole[:5] = 0
    for i in range(12):
        (tmp_path / f"masks/view_{i:03d}.png").write_bytes(mask if i == 3 else scenes.png_bytes(whole))
    dataset = load_dataset(tmp_path)
    assert len(dataset) == 9 and all(dataset.mask(i) is not None for i in range(9))
    said(dataset, "1 images cannot be read and are left out", "masks/view_003.png")


@pytest.mark.parametrize("column", [4, 14])
def test_one_row_of_llff_without_a_lens_is_left_out(tmp_path, column):
    scenes.write_llff(tmp_path, scenes.ring(12), scenes.random_images(12))
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[3, column] = np.nan
    np.save(tmp_path / "poses_bounds.npy", rows)
    dataset = load_dataset(tmp_path)
    assert len(dataset) == 9
    said(dataset, "1 of 12 frames cannot be used", "expected a finite size and focal length")


@pytest.mark.parametrize("folder", ["frames", "Undistorted"])
def test_photographs_of_a_model_lie_in_whatever_folder_has_them(tmp_path, folder):
    scenes.write_colmap(tmp_path, scenes.ring(12), scenes.random_images(12))
    (tmp_path / "images").rename(tmp_path / folder)
    assert len(load_dataset(tmp_path)) == 10


# ------------------------------------------------------------------ calibrations
@pytest.mark.parametrize(("keys", "lens"), [
    ({"is_fisheye": "true", "k1": 0.01}, Fisheye(k1=0.01)), ({"is_fisheye": 1}, Fisheye()),
    ({"camera_model": None, "k1": 0.01}, BrownConrady(k1=0.01)), ({"camera_model": " pinhole "}, BrownConrady()),
    ({"k1": 0.01, "k4": 0.02, "k6": 0.03}, Rational(k1=0.01, k4=0.02, k6=0.03)),
])  # fmt: skip
def test_lenses_as_exporters_spell_them(tmp_path, keys, lens):
    assert load_dataset(scene(tmp_path, **keys)).cameras[0].intrinsics.lens == lens


@pytest.mark.parametrize(("keys", "words"), [
    ({"camera_model": "OPENCV_FISHEYE", "p1": 0.01}, ("p1", "not used")),
    ({"camera_model": "SIMPLE_RADIAL", "k1": 0.01, "k2": 0.02}, ("SIMPLE_RADIAL", "k2", "they are used")),
    ({"camera_angle_x": 0.5}, ("camera_angle_x 0.5", "0.761 radians", "fl_x counts")),
    ({"y_fov": 10.0}, ("y_fov 10", "29.86 degrees", "fl_y counts")),
    ({"ply_file_path": "sparse_pc.ply"}, ("names points in 'sparse_pc.ply', which is not on disk",)),
    ({"aabb": [[3, 3, 3], [4, 4, 4]]}, ("the aabb of the file", "beside the point that all cameras look at")),
])  # fmt: skip
def test_what_a_calibration_says_twice_or_for_nobody_is_told(tmp_path, keys, words):
    said(load_dataset(scene(tmp_path, **keys)), *words)


def test_what_agrees_is_not_told(tmp_path):
    angle = 2 * math.atan(0.5 * 24 / 30)
    dataset = load_dataset(
        scene(tmp_path, camera_angle_x=angle, x_fov=math.degrees(angle), camera_model="OPENCV", k1=0.01)
    )
    assert not [m for m in dataset.messages if "states" in m]


def test_sizes_and_models_of_a_text_model_in_other_spellings(tmp_path):
    scenes.write_colmap(tmp_path, scenes.ring(12), scenes.random_images(12), text=True)
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace("OPENCV 24 16 ", "opencv 24.0 16.0 "))
    assert len(load_dataset(tmp_path)) == 10
    path.write_text(path.read_text().replace("24.0 16.0 ", "24.5 16.0 "))
    with pytest.raises(InputError, match="expected CAMERA_ID"):
        load_dataset(tmp_path)


# ------------------------------------------------------------------ lists and other files
NAMES = [f"view_{i:03d}.png" for i in range(12)]


@pytest.mark.parametrize(("place", "content"), [
    ("test.txt", "\n".join(NAMES[9:])), ("sparse/0/test.txt", "\r\n".join(NAMES[9:])),
    ("test_list.txt", "\n".join(f"images/{name}" for name in NAMES[9:])),
    ("train_test_lists.json", json.dumps({"train": NAMES[:9], "test": NAMES[9:], "has_masks": False})),
    ("dataset.json", json.dumps({"train_ids": [n[:-4] for n in NAMES[:9]], "val_ids": [n[:-4] for n in NAMES[9:]]})),
])  # fmt: skip
def test_lists_that_other_programs_leave_are_kept_to(tmp_path, place, content):
    scenes.write_colmap(tmp_path, scenes.ring(12), scenes.random_images(12))
    (tmp_path / place).write_bytes(content.encode())
    dataset = load_dataset(tmp_path)
    assert dataset.names == [name[:-4] for name in NAMES[:9]]
    said(dataset, f"split: as {place.rpartition('/')[2]} says")
    for split in ("val", "test"):
        assert load_dataset(tmp_path, split).names == [name[:-4] for name in NAMES[9:]]


def test_a_list_of_something_else_is_told(tmp_path):
    scene(tmp_path)
    (tmp_path / "train.txt").write_text("cat\ndog\n")
    dataset = load_dataset(tmp_path)
    assert len(dataset) == 10
    said(dataset, "train.txt is not used: none of its names is an image's")


def test_test_frames_are_held_out(tmp_path):
    def change(document):
        document["test_frames"] = document["frames"][9:]
        document["frames"] = document["frames"][:9]

    assert len(load_dataset(scene(tmp_path, change=change))) == 9
    assert load_dataset(tmp_path, "val").names == [name[:-4] for name in NAMES[9:]]


def test_other_formats_and_leftovers_in_the_folder_are_told(tmp_path):
    scene(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((2, 17)))
    (tmp_path / "Depth").mkdir()
    (tmp_path / "points.ply").write_text("ply")
    shutil.copy(tmp_path / "transforms.json", tmp_path / "transforms_train.json")
    dataset = load_dataset(tmp_path)
    said(dataset, "poses_bounds.npy too, which is not read")
    said(dataset, "not used: Depth/, points.ply")
    said(dataset, "transforms.json is not read")
