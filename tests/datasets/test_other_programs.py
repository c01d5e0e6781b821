"""What other programs, disks and people make of a set: names in another spelling, masks by other rules, folders elsewhere."""

import struct
import unicodedata

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import Camera, look_at
from nerfvol.cameras.further_lenses import FieldOfView, Rational
from nerfvol.cameras.lens import Fisheye
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.datasets.test_whatever_people_bring import LENS, said, scene
from tests.fixtures import scenes


# ------------------------------------------------------------------ names
@pytest.mark.parametrize(("listed", "on_disk"), [
    (unicodedata.normalize("NFC", "images/Küche é {}.png"), unicodedata.normalize("NFD", "images/Küche é {}.png")),
    ("images/my%20photo%20{}.png", "images/my photo {}.png"),
    ("file:///home/me/shoot/images/my%20photo%20{}.png", "images/my photo {}.png"),
    ("images/100%_{}.png", "images/100%_{}.png"),
    ("images/{}.png", "{}.png"),
])  # fmt: skip
def test_names_in_another_spelling_find_their_pictures(tmp_path, listed, on_disk):
    def rename(document):
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = listed.format(i)

    scene(tmp_path, change=rename)
    for i, path in enumerate(sorted((tmp_path / "images").iterdir())):
        path.rename(tmp_path / on_disk.format(i))
    assert len(load_dataset(tmp_path)) == 10


def test_lists_of_bare_names_are_lists(tmp_path):
    def lists(document):
        names = [frame["file_path"].rpartition("/")[2] for frame in document["frames"]]
        document.update(train_filenames=names[:8], val_filenames=names[8:])

    scene(tmp_path, change=lists)
    assert len(load_dataset(tmp_path)) == 8 and len(load_dataset(tmp_path, "val")) == 4


def test_the_same_pictures_in_two_files_are_told(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(), splits=("train",))
    (tmp_path / "transforms_test.json").write_text((tmp_path / "transforms_train.json").read_text())
    said(load_dataset(tmp_path, "test"), "9 views are trained on and held out too")


# ------------------------------------------------------------------ masks
@pytest.mark.parametrize("name", [
    "mask/view_{:03d}.png", "masks/view_{:03d}_mask.png", "images/view_{:03d}.png.mask.png", "images/view_{:03d}_mask.png",
])  # fmt: skip
def test_masks_of_further_programs_are_read(tmp_path, name):
    scene(tmp_path)
    mask = np.full((16, 24), 255, np.uint8)
    mask[:4] = 0
    for i in range(12):
        path = tmp_path / name.format(i)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(path)
    dataset = load_dataset(tmp_path)
    said(dataset, "12 of 12 images have masks")
    assert dataset.masks is not None and all((m == mask).all() for m in dataset.masks)


def test_masks_that_are_named_like_no_image_are_told(tmp_path):
    scene(tmp_path)
    (tmp_path / "masks").mkdir()
    Image.new("L", (24, 16)).save(tmp_path / "masks" / "segments_7.png")
    said(load_dataset(tmp_path), "is not used", "named like an image")


# ------------------------------------------------------------------ cameras
@pytest.mark.parametrize("figures", [{"fl_x": 1.25, "fl_y": 1.875, "cx": 0.5, "cy": 0.5}, {"fl_x": 2.0, "fl_y": 2.0}])
def test_focal_lengths_in_other_units_are_refused(tmp_path, figures):
    with pytest.raises(InputError, match=r"field of view of 1\d\d\.\d degrees: is it in millimetres"):
        load_dataset(scene(tmp_path, **figures))


def test_poses_that_say_nothing_are_told(tmp_path):
    same = [scenes.ring()[0]] * 12
    said(load_dataset(scene(tmp_path / "same", cameras=same)), "all 10 poses are the same")
    turning = [Camera(LENS, look_at((1, 2, 3), (1 + np.cos(a), 2 + np.sin(a), 3))) for a in np.arange(12) / 2]
    said(load_dataset(scene(tmp_path / "panorama", cameras=turning)), "all cameras stand at one point")


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "FISHEYE", "simple_fisheye"])
def test_fisheye_lenses_by_their_other_names(tmp_path, model):
    dataset = load_dataset(scene(tmp_path, camera_model=model, k1=0.01))
    assert dataset.cameras[0].intrinsics.lens == Fisheye(k1=0.01)


def test_opencvs_full_model_without_rational_terms(tmp_path):
    assert (
        load_dataset(scene(tmp_path / "a", camera_model="FULL_OPENCV", k1=0.01, k4=0)).cameras[0].intrinsics.k1 == 0.01
    )
    lens = load_dataset(scene(tmp_path / "b", camera_model="FULL_OPENCV", k6=0.01)).cameras[0].intrinsics.lens
    assert lens == Rational(k6=0.01)


@pytest.mark.parametrize(("number", "parameters", "lens"), [
    (14, (30, 12, 8), Fisheye()), (15, (30, 30, 12, 8), Fisheye()),
    (10, (30, 30, 12, 8, 0.01, 0, 0, 0, 0.002, 0, 0, 0), Fisheye(k1=0.01, k3=0.002)),
    (10, (30, 30, 12, 8, 0.01, 0, 0, 0, 0, 0, 0, 0.1), "the term sy1 of THIN_PRISM_FISHEYE"),
    (6, (30, 30, 12, 8, 0.01, 0, 0, 0, 0, 0.02, 0, 0), Rational(k1=0.01, k4=0.02)),
    (7, (30, 30, 12, 8, 0.1), FieldOfView(0.1)), (16, (30, 30, 12, 8, 0.1, 0.1), "lens model EUCM is not supported"),
])  # fmt: skip
def test_further_lenses_of_colmap(tmp_path, number, parameters, lens):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), model="PINHOLE")
    path = tmp_path / "sparse/0/cameras.bin"
    record = struct.Struct("<iiQQ4d")
    count, *_ = struct.unpack_from("<Q", data := path.read_bytes())
    out = data[:8]
    for i in range(count):
        camera, _, width, height, *_ = record.unpack_from(data, 8 + i * record.size)
        out += struct.pack(f"<iiQQ{len(parameters)}d", camera, number, width, height, *parameters)
    path.write_bytes(out)
    if isinstance(lens, str):
        with pytest.raises(InputError, match=lens):
            load_dataset(tmp_path)
    else:
        assert load_dataset(tmp_path).cameras[0].intrinsics.lens == lens


@pytest.mark.parametrize(("orientation", "is_told"), [(1, False), (3, True), (6, False)])
def test_an_orientation_that_nothing_settles_is_told(tmp_path, orientation, is_told):
    scene(tmp_path)
    for path in (tmp_path / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.open(path).save(path, exif=exif.tobytes())
    told = [m for m in load_dataset(tmp_path).messages if "EXIF orientation" in m]
    assert bool(told) == is_told  # 6 would be 16x24, which the stated 24x16 excludes


# ------------------------------------------------------------------ one odd member
def test_a_row_of_llff_without_depths_or_pose_is_left_out(tmp_path):
    scenes.write_llff(tmp_path, scenes.ring(), scenes.random_images())
    path = tmp_path / "poses_bounds.npy"
    rows = np.load(path)
    rows[2, 15] = -0.01
    rows[5, :15] = np.nan
    np.save(path, rows)
    dataset = load_dataset(tmp_path)
    said(dataset, "1 of 9 rows of poses_bounds.npy state no depths")
    said(dataset, "1 of 9 frames have no finite pose")
    assert len(dataset) == 7  # of the eight that are left every eighth is held out


def test_an_image_of_nsvf_without_a_pose_is_left_out(tmp_path):
    scenes.write_nsvf(tmp_path, scenes.ring(), scenes.random_images())
    poses = sorted((tmp_path / "pose").iterdir())
    poses[3].unlink()
    said(load_dataset(tmp_path), "1 of 9 images have no pose", poses[3].stem)
    for pose in poses[4:]:
        pose.unlink()
    with pytest.raises(InputError, match="6 of 9 images have no pose there"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("text", ["30, 0, 12\n0, 30, 8\n0, 0, 1\n", "30 0 12 0 30 8 0 0 1\n"])
def test_intrinsics_with_commas_or_in_one_line(tmp_path, text):
    scenes.write_nsvf(tmp_path, scenes.ring(), scenes.random_images())
    (tmp_path / "intrinsics.txt").write_text(text)
    assert load_dataset(tmp_path).cameras[0].intrinsics == LENS


def test_an_image_twice_in_a_model_is_told(tmp_path):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), text=True)
    path = tmp_path / "sparse/0/images.txt"
    first = next(line for line in path.read_text().splitlines() if line and not line.startswith("#"))
    path.write_text(path.read_text() + first + "\n\n")
    said(load_dataset(tmp_path), "1 images are in the model more than once")


# ------------------------------------------------------------------ folders
@pytest.mark.parametrize(("images", "asked"), [
    ("input", "."), ("Images", "."), ("images", "sparse/0"), ("input", "sparse/0"),
])  # fmt: skip
def test_photographs_of_a_model_lie_where_programs_put_them(tmp_path, images, asked):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images())
    (tmp_path / "images").rename(tmp_path / images)
    assert len(load_dataset(tmp_path / asked)) == 7


@pytest.mark.parametrize(("make", "asked", "sentence"), [
    (lambda t: scene(t / "a/lego"), "a", "a/lego is one"),
    (lambda t: scene(t / "a/b/scan"), "a", "a/b/scan is one"),
    (lambda t: scene(t / "a"), "a/images", "a is one"),
    (lambda t: scenes.save_images(t / "a", scenes.random_images(2)), "a", "nerfvol capture"),
    (lambda t: (t / "a/keyframes").mkdir(parents=True), "a", "ns-process-data polycam"),
    (lambda t: (t / "a.mp4").write_bytes(b"video"), "a.mp4", "nerfvol capture"),
])  # fmt: skip
def test_a_folder_that_is_no_set_says_what_it_is(tmp_path, make, asked, sentence):
    make(tmp_path)
    with pytest.raises(InputError, match="expected posed images") as caught:
        load_dataset(tmp_path / asked)
    assert sentence in str(caught.value)


@pytest.mark.parametrize(("content", "sentence"), [
    (b"", "nothing, it is empty"), (b"\0\0\0\x1cftypavif" + bytes(99), "AVIF"), (b"\x76\x2f\x31\x01" + bytes(99), "OpenEXR"),
])  # fmt: skip
def test_what_is_no_picture_is_named(tmp_path, content, sentence):
    scene(tmp_path)
    for path in (tmp_path / "images").iterdir():
        path.write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        load_dataset(tmp_path)
