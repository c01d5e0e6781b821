"""What cameras, exporters, editors and disks do to posed images: taken as meant, or refused, and told; never passed over."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures import scenes

LENS = Intrinsics(24, 16, 30.0, 30.0, 12.0, 8.0)


def scene(folder, n=12, change=None, images=None, cameras=None, **more):
    """One transforms.json with n views on a ring; ``change`` gets the document before it is written."""
    folder.mkdir(parents=True, exist_ok=True)
    images = scenes.random_images(n) if images is None else images
    names = [f"images/{name}" for name in scenes.save_images(folder / "images", images)]
    frames = [
        {"file_path": name, "transform_matrix": camera.c2w.tolist()}
        for name, camera in zip(names, cameras or scenes.ring(n), strict=True)
    ]
    document = {"w": 24, "h": 16, "fl_x": 30.0, "fl_y": 30.0, **more, "frames": frames}
    if change is not None:
        change(document)
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def said(dataset, *words):
    """The one message that has all words."""
    (message,) = [m for m in dataset.messages if all(word in m for word in words)]
    return message


# ------------------------------------------------------------------ one odd member
def lose(*indices, value=math.nan):
    def change(document):
        for i in indices:
            document["frames"][i]["transform_matrix"][0][3] = value

    return change


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_frames_without_a_pose_are_left_out_counted_and_named(tmp_path, value):
    dataset = load_dataset(scene(tmp_path, change=lose(3, 7, value=value)))
    assert len(dataset) == 8 and "view_003" not in dataset.names  # 10 are left, of which two are held out
    message = said(dataset, "2 of 12 frames have no finite pose", "left out")
    assert "view_003" in message and "view_007" in message


def test_a_set_that_lost_most_of_its_poses_is_refused(tmp_path):
    with pytest.raises(InputError, match="poses of 7 of 12 frames hold NaN"):
        load_dataset(scene(tmp_path, change=lose(*range(7))))


@pytest.mark.parametrize("far", [1e3, 1e8])
def test_one_camera_far_away_is_left_out_and_moves_nothing(tmp_path, far):
    plain = load_dataset(scene(tmp_path / "plain", change=lambda d: d["frames"].pop(5)))
    dataset = load_dataset(scene(tmp_path / "one", change=lose(5, value=far)))
    assert "view_005" in said(dataset, "1 of 10 cameras lie astray")
    np.testing.assert_allclose(dataset.scene.aabb, plain.scene.aabb, rtol=1e-9)


def test_one_camera_that_looks_elsewhere_does_not_move_the_point_that_all_look_at():
    cameras = scenes.ring(12)
    turned = [*cameras[:-1], replace(cameras[-1], c2w=look_at(cameras[-1].position, cameras[-1].position + [0, 3, 1]))]
    from nerfvol.cameras.focus import focus_point

    np.testing.assert_allclose(focus_point(turned).point, focus_point(cameras[:-1]).point, atol=1e-9)


def test_one_picture_of_another_size_is_left_out(tmp_path):
    folder = scene(
        tmp_path, 24, change=lambda d: [d.pop(k) for k in ("w", "h", "fl_x", "fl_y")] and d.update(camera_angle_x=0.8)
    )
    Image.new("RGB", (25, 16)).save(folder / "images" / "view_005.png")
    dataset = load_dataset(folder)
    assert "view_005" not in dataset.names and len(dataset) == 20
    said(dataset, "1 images do not fit the others", "view_005")


# ------------------------------------------------------------------ what kind of scene
def objects(alpha=True, backdrop=255, n=12):
    """A coloured square before nothing, or before a plain backdrop with JPEG's noise."""
    made = []
    for image in scenes.random_images(n, (24, 24)):
        picture = np.full((24, 24, 4), (backdrop, backdrop, backdrop, 0), np.uint8)
        picture[7:17, 7:17] = np.concatenate([image[7:17, 7:17], np.full((10, 10, 1), 255, np.uint8)], axis=2)
        noise = np.random.default_rng(0).integers(-4, 5, picture[..., :3].shape)
        made.append(picture if alpha else np.clip(picture[..., :3].astype(int) + noise, 0, 255).astype(np.uint8))
    return made


def object_scene(folder, images, **more):
    return scene(folder, images=images, w=24, h=24, **more)


@pytest.mark.parametrize("backdrop", [255, 0, 128])
def test_a_plain_backdrop_makes_an_object_as_transparency_does(tmp_path, backdrop):
    alpha = load_dataset(object_scene(tmp_path / "a", objects()))
    plain = load_dataset(object_scene(tmp_path / "b", objects(alpha=False, backdrop=backdrop)))
    assert alpha.kind == plain.kind == "object" and not plain.scene.is_unbounded and not plain.scene.has_alpha
    np.testing.assert_array_equal(plain.scene.aabb, alpha.scene.aabb)
    assert alpha.backdrop is None and np.allclose(plain.backdrop, backdrop / 255, atol=2 / 255)
    said(plain, "taken for an object", "backdrop", "--scene object|surroundings|room|forward overrules")


def test_the_kind_of_scene_can_be_said(tmp_path):
    folder = object_scene(tmp_path, objects(alpha=False))
    dataset = load_dataset(folder, scene="surroundings")
    assert dataset.scene.is_unbounded and dataset.backdrop is None and "as asked" in said(dataset, "scene: taken for")
    with pytest.raises(InputError, match="kind of scene must be auto or one of"):
        load_dataset(folder, scene="house")


def test_backdrops_of_different_colours_are_no_backdrop(tmp_path):
    half = objects(alpha=False, backdrop=255)[:6] + objects(alpha=False, backdrop=40)[:6]
    assert load_dataset(object_scene(tmp_path, half)).kind == "surroundings"


def with_alpha(images, where):
    made = [np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=2) for image in images]
    where(made)
    return made


def test_one_pixel_of_alpha_makes_no_object(tmp_path):
    def one(images):
        images[5][0, 0, 3] = 254

    plain = load_dataset(scene(tmp_path / "plain"))
    for split in ("train", "val"):
        dataset = load_dataset(scene(tmp_path / "one", images=with_alpha(scenes.random_images(12), one)), split)
        assert dataset.scene.is_unbounded and all(image.shape[2] == 3 for image in dataset.images)
        np.testing.assert_array_equal(dataset.scene.aabb, plain.scene.aabb)


def test_transparent_rims_of_photographs_are_not_seen(tmp_path):
    """As undistortion leaves them: no object, and no part of loss and scores."""

    def rims(images):
        for image in images:
            image[:, 0] = 0

    dataset = load_dataset(scene(tmp_path, images=with_alpha(scenes.random_images(12), rims)))
    assert dataset.scene.is_unbounded and dataset.mask(0)[:, 0].max() == 0 and dataset.mask(0)[:, 1:].min() == 255
    said(dataset, "10 of 10 photographs have transparent pixels")


def test_parallel_axes_are_a_scene_that_looks_one_way(tmp_path):
    cameras = [Camera(LENS, look_at([x, y, 4], [x, y, 0], [0, 1, 0])) for x in range(4) for y in range(3)]
    dataset = load_dataset(scene(tmp_path, cameras=cameras))
    assert dataset.kind == "forward" and dataset.scene.is_guess


def test_cameras_that_look_outwards_are_a_room_and_opencv_axes_are_suspected(tmp_path):
    outward = [replace(c, c2w=c.c2w @ np.diag([1.0, -1, -1, 1])) for c in scenes.ring(12)]
    dataset = load_dataset(scene(tmp_path, cameras=outward))
    assert dataset.kind == "room"
    said(dataset, "look away from one point", "OpenCV axes")
    assert not any("OpenCV" in m for m in load_dataset(scene(tmp_path / "right")).messages)


def test_world_to_camera_matrices_are_suspected(tmp_path):
    def invert(document):
        for frame in document["frames"]:
            frame["transform_matrix"] = np.linalg.inv(frame["transform_matrix"]).tolist()

    said(load_dataset(scene(tmp_path, change=invert)), "world-to-camera")


# ------------------------------------------------------------------ poses and calibration as programs write them
def poses(change):
    def apply(document):
        for frame in document["frames"]:
            matrix = np.array(frame["transform_matrix"])
            frame["transform_matrix"] = change(matrix)

    return apply


def scaled(matrix, by):
    matrix[:3, :3] *= by
    return matrix.tolist()


@pytest.mark.parametrize("by", [0.33, 100.0, (2.0, 2.0, 1.0)])
def test_the_lengths_of_a_cameras_axes_are_taken_out(tmp_path, by):
    plain = load_dataset(scene(tmp_path / "plain"))
    dataset = load_dataset(scene(tmp_path / "scaled", change=poses(lambda m: scaled(m, by))))
    said(dataset, "axes of 12 of 12 poses are not of unit length")
    for a, b in zip(dataset.cameras, plain.cameras, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-12)


@pytest.mark.parametrize("digits, by", [(3, 1.0), (3, 0.33)])
def test_three_decimals_are_enough(tmp_path, digits, by):
    plain = load_dataset(scene(tmp_path / "plain"))

    def rounded(matrix):
        matrix[:3, :3] = np.round(matrix[:3, :3] * by, digits)
        return matrix.tolist()

    for a, b in zip(load_dataset(scene(tmp_path / "r", change=poses(rounded))).cameras, plain.cameras, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=2 * 10.0**-digits / by)


@pytest.mark.parametrize("change, sentence", [
    (lambda m: (m @ np.diag([-1.0, 1, 1, 1])).tolist(), "left-handed|mirror"),
    (lambda m: (m @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])).tolist(), "must be rigid"),
    (lambda m: m.T.tolist(), "is the matrix transposed"),
])  # fmt: skip
def test_mirrors_shear_and_transposes_stay_refused(tmp_path, change, sentence):
    with pytest.raises(InputError, match=sentence):
        load_dataset(scene(tmp_path, change=poses(change)))


def test_numbers_in_quotes_and_flat_matrices_are_numbers(tmp_path):
    plain = load_dataset(scene(tmp_path / "plain"))
    quoted = load_dataset(scene(tmp_path / "q", fl_x="30.0", change=poses(lambda m: [str(x) for x in m.ravel()])))
    assert quoted.cameras[0].intrinsics == plain.cameras[0].intrinsics
    np.testing.assert_array_equal(quoted.cameras[3].c2w, plain.cameras[3].c2w)


@pytest.mark.parametrize("factor", [2, 4])
def test_a_calibration_for_larger_pictures_is_scaled(tmp_path, factor):
    plain = load_dataset(scene(tmp_path / "plain"))
    keys = {"w": 24 * factor, "h": 16 * factor, "fl_x": 30.0 * factor, "fl_y": 30.0 * factor}
    dataset = load_dataset(scene(tmp_path / "stated", **keys))
    assert dataset.cameras[0].intrinsics == plain.cameras[0].intrinsics
    said(dataset, f"is for {24 * factor}x{16 * factor}", "scaled")
    centre = {"cx": 12.0 * factor, "cy": 8.0 * factor}
    bare = load_dataset(scene(tmp_path / "bare", **keys, **centre, change=lambda d: [d.pop("w"), d.pop("h")]))
    assert bare.cameras[0].intrinsics == plain.cameras[0].intrinsics
    said(bare, "principal point (cx, cy)", "scaled")


def test_a_principal_point_far_off_is_told(tmp_path):
    said(load_dataset(scene(tmp_path, cx=20.0, cy=8.0)), "principal point (cx, cy)", "more than a quarter")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_are_turned_where_their_calibration_is_for_upright_ones(tmp_path, orientation):
    """Pillow's own transposition is the reference; pictures lie on their side where the orientation is 5 or more."""
    from PIL import ImageOps

    folder = scene(tmp_path)
    for path in (folder / "images").iterdir():
        image = Image.fromarray(
            np.random.default_rng(3).integers(0, 255, (16, 24, 3) if orientation < 5 else (24, 16, 3), np.uint8)
        )
        exif = image.getexif()
        exif[0x0112] = orientation
        image.save(path, exif=exif)
        upright = np.asarray(ImageOps.exif_transpose(image))
        stored = np.asarray(image)
    dataset = load_dataset(folder)
    turns = orientation >= 5
    np.testing.assert_array_equal(dataset.images[0], upright if turns else stored)
    assert any("are turned as their EXIF orientation" in message for message in dataset.messages) == turns
    assert any("are taken as stored" in message for message in dataset.messages) == (1 < orientation < 5)


# ------------------------------------------------------------------ lists and files
def test_a_list_of_training_views_alone_is_kept_to(tmp_path):
    def lists(document):
        document["train_filenames"] = [
            f["file_path"].replace("images/", "./images\\") for f in document["frames"][::2]
        ] + ["no.png"]

    folder = scene(tmp_path, change=lists)
    train, held = load_dataset(folder), load_dataset(folder, "val")
    assert len(train) == 6 and len(held) == 6 and not set(train.names) & set(held.names)
    said(train, "lists views to train on and none to hold out")
    assert "no.png" in said(train, "1 names in the lists")


def test_frames_in_no_list_and_views_in_both_are_told(tmp_path):
    def lists(document):
        names = [frame["file_path"] for frame in document["frames"]]
        document.update(train_filenames=names[:6], val_filenames=names[5:8])

    dataset = load_dataset(scene(tmp_path, change=lists))
    said(dataset, "4 frames are in no list")
    said(dataset, "1 views are trained on and held out too")


def test_test_cameras_without_pictures_are_left_out(tmp_path):
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(), splits=("train", "test"))
    plain = json.loads((tmp_path / "transforms_test.json").read_text())
    for path in (tmp_path / "test").iterdir():
        path.unlink()
    train, held = load_dataset(tmp_path), load_dataset(tmp_path, "val")
    assert len(train) + len(held) == 9 and len(held) == 2
    said(train, f"transforms_test.json lists {len(plain['frames'])} cameras without pictures")


@pytest.mark.parametrize("gone, lists, held", [
    (("val",), "transforms_val.json lists 9", 9), (("val", "test"), "transforms_test.json lists 9", 2),
])  # fmt: skip
def test_where_one_of_two_splits_has_no_pictures_the_other_is_scored(tmp_path, gone, lists, held):
    """With pictures in neither, every 8th training view is."""
    scenes.write_blender(tmp_path, scenes.ring(), scenes.random_images(), splits=("train", "val", "test"))
    for split in gone:
        for path in (tmp_path / split).iterdir():
            path.unlink()
    dataset = load_dataset(tmp_path, "val")
    assert len(dataset) == held and any(f"{lists} cameras without pictures" in m for m in dataset.messages)


def test_whatever_a_file_says_and_nobody_uses_gets_one_sentence(tmp_path):
    def extra(document):
        document.update(applied_scale=2.0, wibble={"a": 1}, nothing=None)
        document["frames"][2]["depth_file_path"] = "d.png"

    dataset = load_dataset(scene(tmp_path, change=extra))
    message = said(dataset, "states what is not used")
    assert "applied_scale" in message and "wibble" in message and "depth_file_path (of frames)" in message
    assert "nothing" not in message and "fl_x" not in message


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_saved_on_windows_is_text(tmp_path, encoding):
    folder = scene(tmp_path / "json")
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace(", ", ",\r\n"), encoding=encoding)
    assert len(load_dataset(folder)) == 10
    scenes.write_colmap(tmp_path / "colmap", scenes.ring(), scenes.random_images(), text=True)
    for name in ("cameras.txt", "images.txt"):
        path = tmp_path / "colmap/sparse/0" / name
        path.write_text(path.read_text().replace("\n", "\r\n"), encoding=encoding)
    assert len(load_dataset(tmp_path / "colmap")) == 7


@pytest.mark.parametrize("listed", [
    "./images/view_{:03d}.png", "images\\view_{:03d}", "/home/me/photos/images/view_{:03d}.png",
    "C:\\photos\\images\\view_{:03d}.PNG", "../shoot/images/view_{:03d}.png",
])  # fmt: skip
def test_paths_of_other_machines_find_their_pictures(tmp_path, listed):
    def rename(document):
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = listed.format(i)

    assert len(load_dataset(scene(tmp_path, change=rename))) == 10


def test_what_macos_leaves_behind_is_no_photograph(tmp_path):
    scenes.write_llff(tmp_path, scenes.ring(), scenes.random_images())
    for path in list((tmp_path / "images_4").iterdir()):
        (path.parent / f"._{path.name}").write_bytes(b"\x00\x05\x16\x07 a resource fork")
    assert len(load_dataset(tmp_path)) == 7


def test_llff_poses_of_fewer_photographs_are_told_apart_by_the_model(tmp_path):
    cameras, images = scenes.ring(), scenes.random_images()
    scenes.write_llff(tmp_path, cameras, images)
    np.save(tmp_path / "poses_bounds.npy", np.load(tmp_path / "poses_bounds.npy")[1:])
    with pytest.raises(InputError, match="holds 8 poses, but images_4 holds 9 images.*sparse/0"):
        load_dataset(tmp_path)
    names = sorted(path.name for path in (tmp_path / "images_4").iterdir())
    lines = [f"{i} 1 0 0 0 0 0 0 1 {name}\n\n" for i, name in enumerate(names[1:])]
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/images.txt").write_text("".join(lines))
    dataset = load_dataset(tmp_path, "val")
    assert names[0] in said(dataset, "1 images have no pose")
    (tmp_path / "sparse/0/images.txt").rename(tmp_path / "sparse/0/Images.TXT")
    (tmp_path / "sparse").rename(tmp_path / "Sparse")
    assert names[0] in said(load_dataset(tmp_path, "val"), "1 images have no pose")


def test_the_largest_colmap_model_is_read_whatever_its_number(tmp_path):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images())
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/2")
    other = tmp_path / "other"
    scenes.write_colmap(other, scenes.ring(3), scenes.random_images(3))
    (other / "sparse/0").rename(tmp_path / "sparse/0")
    dataset = load_dataset(tmp_path)
    assert len(dataset) == 7
    said(dataset, "2 COLMAP models: sparse/2 with 9 images is used, not sparse/0 (3)")


def test_photographs_in_no_model_are_counted(tmp_path):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images())
    Image.new("RGB", (24, 16)).save(tmp_path / "images" / "zz_blurred.png")
    assert "zz_blurred.png" in said(load_dataset(tmp_path), "1 of 10 photographs are not in the model")


@pytest.mark.parametrize("features", [True, False])
def test_lines_of_features_may_be_left_out(tmp_path, features):
    scenes.write_colmap(tmp_path, scenes.ring(), scenes.random_images(), text=True)
    path = tmp_path / "sparse/0/images.txt"
    images = [line for line in path.read_text().splitlines() if len(line.split()) == 10]
    mixed = [line + ("\n12.5 7.25 -1 3.0 4.0 17" if features and i % 2 else "") for i, line in enumerate(images)]
    path.write_text("\n".join(mixed) + "\n")
    assert len(load_dataset(tmp_path)) == 7 and len(load_dataset(tmp_path, "val")) == 2
