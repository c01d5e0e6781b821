"""Further habits of programs, scripts and disks: names in other letters, keys by other names, files twice, poses inverted."""

import shutil

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import orbit
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.datasets.test_whatever_people_bring import LENS, said, scene
from tests.fixtures import scenes


def ring_aside(n=12):
    """Cameras that look at a point beside the origin."""
    return [camera for elevation in (15, 50) for camera in
            orbit(n // 2, center=(3.0, -1.0, 2.0), radius=4, elevation_deg=elevation, intrinsics=LENS)]  # fmt: skip


def without_focal(document):
    del document["fl_x"], document["fl_y"]


# ------------------------------------------------------------------ names
def test_files_in_other_letters_are_found(tmp_path):
    (scene(tmp_path / "ngp") / "transforms.json").rename(tmp_path / "ngp" / "Transforms.JSON")
    assert len(load_dataset(tmp_path / "ngp")) == 10
    blender = scenes.write_blender(tmp_path / "b", scenes.ring(), scenes.random_images(), splits=("train", "val"))
    (blender / "transforms_train.json").rename(blender / "Transforms_Train.json")
    assert len(load_dataset(blender)) == 9
    llff = scenes.write_llff(tmp_path / "llff", scenes.ring(), scenes.random_images())
    (llff / "poses_bounds.npy").rename(llff / "Poses_Bounds.npy")
    assert len(load_dataset(llff)) == 7
    for text in (False, True):
        model = scenes.write_colmap(tmp_path / f"colmap{text}", scenes.ring(), scenes.random_images(), text=text)
        for file in (model / "sparse" / "0").iterdir():
            file.rename(file.with_name(file.name.capitalize()))
        (model / "sparse").rename(model / "Sparse")
        assert len(load_dataset(model)) == 7


@pytest.mark.parametrize("kept", ["cameras", "images"])
def test_a_model_half_in_text(tmp_path, kept):
    model = scenes.write_colmap(tmp_path / "m", scenes.ring(), scenes.random_images())
    text = scenes.write_colmap(tmp_path / "t", scenes.ring(), scenes.random_images(), text=True)
    whole = load_dataset(model)
    (model / "sparse" / "0" / f"{kept}.bin").unlink()
    shutil.copy(text / "sparse" / "0" / f"{kept}.txt", model / "sparse" / "0")
    for a, b in zip(load_dataset(model).cameras, whole.cameras, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-12)
        assert a.intrinsics == b.intrinsics


@pytest.mark.parametrize(("name", "sentence"), [
    ("scan.zip", "scan.zip is an archive: unpack it"), ("transforms_all.json", "is transforms_all.json meant"),
    ("database.db", "COLMAP's of features"),
])  # fmt: skip
def test_what_lies_there_instead_is_named(tmp_path, name, sentence):
    (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(InputError, match=sentence):
        load_dataset(tmp_path)


def test_an_archive_is_to_be_unpacked(tmp_path):
    (tmp_path / "scan.ZIP").write_bytes(b"PK\3\4")
    with pytest.raises(InputError, match="it is an archive"):
        load_dataset(tmp_path / "scan.ZIP")


def test_photographs_of_llff_under_two_suffixes(tmp_path):
    images = scenes.random_images()
    folder = scenes.write_llff(tmp_path, scenes.ring(), images)
    for path in sorted((folder / "images_4").iterdir()):
        Image.open(path).save(path.with_suffix(".jpg"))
    dataset = load_dataset(folder)
    assert (dataset.images[0] == images[1]).all()
    said(dataset, "each photograph as .jpg, .png", ".png is used")
    sorted((folder / "images_4").glob("*.jpg"))[0].rename(folder / "images_4" / "other.jpg")
    with pytest.raises(InputError, match="holds 9 poses"):
        load_dataset(folder)


# ------------------------------------------------------------------ calibration
MATRIX = [[30.0, 0, 11.0], [0, 29.0, 9.0], [0, 0, 1]]
OF_MATRIX = (30.0, 29.0, 11.0, 9.0)


def of_frames(**what):
    return lambda document: [frame.update(what) for frame in document["frames"]]


@pytest.mark.parametrize(("more", "change", "found"), [
    ({"fx": 30.0, "fy": 29.0, "cx": 11.0, "cy": 9.0, "width": 24, "height": 16}, None, OF_MATRIX),
    ({"K": MATRIX}, None, OF_MATRIX), ({"intrinsic_matrix": [v for row in MATRIX for v in row]}, None, OF_MATRIX),
    ({}, of_frames(intrinsics=MATRIX), OF_MATRIX),
    ({"camera_matrix": np.pad(MATRIX, (0, 1)).tolist()}, None, OF_MATRIX),
    ({"fx": 31.0, "fy": 31.0, "cx": 11.0}, None, (31.0, 31.0, 11.0, 8.0)),
])  # fmt: skip
def test_a_calibration_by_other_names(tmp_path, more, change, found):
    def both(document):
        without_focal(document)
        if change is not None:
            change(document)

    lens = load_dataset(scene(tmp_path, change=both, **more)).cameras[0].intrinsics
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == found


def test_other_names_beside_ours_are_told(tmp_path):
    dataset = load_dataset(scene(tmp_path, K=MATRIX, fx=60.0, width=24))
    assert dataset.cameras[0].intrinsics.fx == 30
    said(dataset, "fx, K (other keys for the same come first)")


@pytest.mark.parametrize("matrix", ["wide", [[1, 2], [3, 4]], [[30, 0, 12], [5, 30, 8], [0, 0, 1]]])
def test_a_matrix_that_is_no_calibration_is_refused(tmp_path, matrix):
    with pytest.raises(InputError, match="K must be a calibration matrix"):
        load_dataset(scene(tmp_path, change=without_focal, K=matrix))


def test_degrees_for_radians_are_guessed_at(tmp_path):
    with pytest.raises(InputError, match="is it in degrees, which x_fov states"):
        load_dataset(scene(tmp_path, change=without_focal, camera_angle_x=43.6))


# ------------------------------------------------------------------ bounds and poses
@pytest.mark.parametrize(("scale", "half"), [(None, 0.5 / 0.33), (0.33, 0.5 / 0.33), (0.2, 2.5), (0.05, 4.0)])
def test_aabb_scale_is_in_the_units_that_the_file_states(tmp_path, scale, half):
    """instant-ngp maps x to scale x + offset and models a cube of side aabb_scale there."""
    dataset = load_dataset(scene(tmp_path, aabb_scale=1, **({} if scale is None else {"scale": scale})))
    np.testing.assert_allclose(dataset.scene.side, 2 * half, rtol=1e-9)


@pytest.mark.parametrize("opencv", [False, True])
def test_world_to_camera_matrices_are_suspected_in_either_axes(tmp_path, opencv):
    def invert(document):
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1] if opencv else [1.0] * 4)
            frame["transform_matrix"] = np.linalg.inv(pose).tolist()

    sentence = said(load_dataset(scene(tmp_path, change=invert, cameras=ring_aside())), "world-to-camera")
    assert ("OpenCV" in sentence) == opencv


def test_cameras_at_one_point_may_be_inverted_ones(tmp_path):
    """Inverted, cameras that look at the origin from one distance all stand there: what NSVF's poses are, as it happens."""
    folder = scenes.write_nsvf(tmp_path, scenes.ring(), scenes.random_images())
    assert not any("world-to-camera" in m for m in load_dataset(folder).messages)
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.linalg.inv(np.loadtxt(path)))
    said(load_dataset(folder), "all cameras stand at one point", "world-to-camera")


def test_pictures_of_fewer_bits_than_their_files_are_told(tmp_path):
    folder = scene(tmp_path)
    assert not any("brightest" in m for m in load_dataset(folder).messages)
    rng = np.random.default_rng(0)
    for path in (folder / "images").iterdir():
        path.write_bytes(scenes.png_bytes(rng.integers(0, 4096, (16, 24, 1)).astype(np.uint16)))
    said(load_dataset(folder), "the brightest of 10 images has level 16 of 255", "fewer bits")
