"""What masks, lenses and cut-outs leave out takes no part in loss and scores, for octrees and splats alike."""

import json

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import Intrinsics
from nerfvol.cameras.lens import Fisheye
from nerfvol.datasets.averages import area_average, masked_average
from nerfvol.datasets.images import read_mask
from nerfvol.datasets.load import load_dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.datasets.tiles import Cursors, TileBank
from nerfvol.errors import InputError
from nerfvol.measure.metrics import ssim
from nerfvol.measure.scores import score_views
from tests.fixtures import scenes

OUT = np.zeros((16, 24), bool)
OUT[4:12, 8:16] = True
"""What each mask leaves out: one tile of 8x8 pixels spans two rows of tiles."""


def write(folder, convention, masked=range(9)):
    """A transforms.json with masks as ``convention`` writes them; magenta where they leave pixels out."""
    images = scenes.random_images()
    for i in masked:
        images[i][OUT] = (255, 0, 255)
    names = [f"images/{name}" for name in scenes.save_images(folder / "images", images)]
    frames = [scenes.frame(name, camera) for name, camera in zip(names, scenes.ring(), strict=True)]
    (folder / "masks").mkdir()
    for i in masked:
        kept = Image.fromarray(np.where(OUT, 0, 255).astype(np.uint8))
        dropped = Image.fromarray(np.where(OUT, 255, 0).astype(np.uint8))
        if convention == "mask_path":
            kept.save(folder / f"m_{i}.png")
            frames[i]["mask_path"] = f"m_{i}.png"
        elif convention == "dynamic":
            dropped.save(folder / "images" / f"dynamic_mask_view_{i:03d}.png")
        elif convention == "colmap":
            kept.save(folder / "masks" / f"view_{i:03d}.png.png")
        elif convention == "by stem":
            kept.save(folder / "masks" / f"view_{i:03d}.png")
    scenes.write_json(folder / "transforms.json", w=24, h=16, fl_x=30.0, fl_y=30.0, frames=frames)
    return folder


CONVENTIONS = ("mask_path", "dynamic", "colmap", "by stem")


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("split", ["train", "val"])
def test_masks_of_all_conventions_are_read(tmp_path, convention, split):
    dataset = load_dataset(write(tmp_path, convention), split)
    for i in range(len(dataset)):
        np.testing.assert_array_equal(dataset.mask(i), np.where(OUT, 0, 255))
    assert any("images have masks" in message for message in dataset.messages)


def test_what_is_masked_colours_no_average():
    """Area averages of a picture with magenta under its mask are those of the rest alone."""
    image, mask = np.full((8, 8, 3), 40, np.uint8), np.full((8, 8), 255, np.uint8)
    image[:, :2], mask[:, :2] = (255, 0, 255), 0
    colour, weight = masked_average(image, mask, 4)
    assert (colour == 40).all()
    np.testing.assert_array_equal(weight, [[128, 255], [128, 255]])  # 255 / 2 rounded half up
    assert not (area_average(image, 4) == 40).all()


@pytest.mark.parametrize("k", [1, 2])
def test_masked_rays_weigh_nothing_and_colour_nothing(tmp_path, k):
    dataset = load_dataset(write(tmp_path, "mask_path"))
    bank = TileBank(dataset, (1.0, 1.0, 1.0), k)
    batch = bank.batch(np.arange(bank.n_tiles), np.ones(bank.n_tiles, np.float32))
    magenta = np.abs(batch.target - (1, 0, 1)).max(axis=1) < 1e-6
    assert not (batch.weight[magenta] > 0).any()
    assert batch.weight.sum() == len(dataset) * (~OUT).sum() / k**2


def test_a_tile_that_is_masked_whole_is_never_drawn(tmp_path):
    folder = write(tmp_path, "mask_path")
    for path in folder.glob("m_*.png"):
        mask = np.full((16, 24), 255, np.uint8)
        mask[:8, :8] = 0
        Image.fromarray(mask).save(path)
    bank = TileBank(load_dataset(folder), (1.0, 1.0, 1.0), 1)
    drawn = bank.draw(5 * 7, 1.0, 0, Cursors())
    assert len(bank.foreground_tiles) == 5 * 7 and (drawn.weight.reshape(-1, 64) == 1).all()


def test_splats_get_masks_as_weights(tmp_path):
    view = Photographs(load_dataset(write(tmp_path, "dynamic"))).view(0, 1)
    np.testing.assert_array_equal(view.image[: view.height, : view.width, 3], np.where(OUT, 0, 255))


def test_scores_are_of_what_is_seen(tmp_path):
    dataset = load_dataset(write(tmp_path, "mask_path"))
    truth = {id(camera): dataset.composited(i, (1, 1, 1)) for i, camera in enumerate(dataset.cameras)}

    def render(camera):
        image = truth[id(camera)].copy()
        image[OUT] = 0.5
        image[0, 0] += 0.125
        return image.clip(0, 1)

    rows = score_views(render, dataset, (1, 1, 1))["rows"]
    for i, row in enumerate(rows):
        error = ((render(dataset.cameras[i]) - truth[id(dataset.cameras[i])]) ** 2)[~OUT].mean()
        assert row["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4) and row["ssim"] > 0.99


def test_ssim_where_all_is_seen_is_ssim():
    a, b = np.random.default_rng(0).random((2, 20, 30, 3))
    assert ssim(a, b, np.ones((20, 30), bool)) == pytest.approx(ssim(a, b), abs=1e-12)


def test_masks_that_do_not_fit_are_told_or_refused(tmp_path):
    folder = write(tmp_path, "mask_path")
    Image.fromarray(np.zeros((16, 24), np.uint8)).save(folder / "m_3.png")
    (folder / "m_4.png").unlink()
    dataset = load_dataset(folder)
    assert any("the masks of 1 images leave nothing" in m and "view_003" in m for m in dataset.messages)
    assert any("1 masks that are named are not on disk" in m and "m_4.png" in m for m in dataset.messages)
    Image.fromarray(np.zeros((16, 16), np.uint8)).save(folder / "m_3.png")
    with pytest.raises(InputError, match="m_3.png: expected a mask of 24x16 pixels"):
        load_dataset(folder)


@pytest.mark.parametrize("values, mode", [((0, 255), "L"), ((0, 1), "L"), ((0, 255), "1"), ((0, 7), "P")])
def test_masks_of_any_depth_and_of_half_size(tmp_path, values, mode):
    small = np.where(OUT[::2, ::2], *values).astype(np.uint8)
    image = Image.fromarray(small, "L") if mode != "P" else Image.fromarray(small, "P")
    if mode == "P":
        image.putpalette([0] * 3 + [255] * 765)
    (image.convert("1") if mode == "1" else image).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png", (24, 16)) > 0, ~OUT)


# ------------------------------------------------------------------ the reach of lenses
FOLDING = Intrinsics(64, 64, 20.0, 20.0, 32.0, 32.0, Fisheye(k1=-0.15))
"""theta (1 - 0.15 theta^2) turns back at theta = 1 / sqrt(0.45), 0.994 focal lengths from the axis: a disc of 19.9 pixels."""


def test_pixels_beyond_a_lenss_reach_have_no_ray():
    theta = 1 / np.sqrt(3 * 0.15)
    radius = 20.0 * theta * (1 - 0.15 * theta**2)
    far = np.hypot(np.arange(64) + 0.5 - 32, (np.arange(64) + 0.5 - 32)[:, None])
    np.testing.assert_array_equal(FOLDING.seen(), far <= radius)
    directions = FOLDING.directions()
    assert np.isfinite(directions).all() and np.allclose(np.linalg.norm(directions, axis=2), 1, atol=1e-6)
    assert Intrinsics(64, 64, 80.0, 80.0, 32.0, 32.0, Fisheye(k1=-0.15)).seen() is None


def test_the_second_branch_of_a_lens_is_no_picture():
    """theta (1 - 0.3 theta^2 + 0.04 theta^4) turns back at 1.25, and rises again from 1.79 on, to radii that it had before:
    what lies beyond the first maximum has no ray, though the polynomial has a root there."""
    lens = Fisheye(k1=-0.3, k2=0.04)
    turns = float(np.sqrt((0.9 - np.sqrt(0.81 - 0.8)) / 0.4))
    most = turns * (1 - 0.3 * turns**2 + 0.04 * turns**4)
    radii = np.array([0.5 * most, 0.999 * most, 1.001 * most, 1.5 * most, 3 * most])
    directions, found = lens.undistort_where(np.stack([radii, 0 * radii], axis=1))
    np.testing.assert_array_equal(found, [True, True, False, False, False])
    assert (np.arctan2(directions[:2, 0], directions[:2, 2]) <= turns).all()


def fisheye(folder, images, k1=-0.15, focal=20.0):
    folder.mkdir(exist_ok=True)
    names = scenes.save_images(folder, images)
    frames = [scenes.frame(name, camera) for name, camera in zip(names, scenes.ring(len(names)), strict=True)]
    keys = {"w": 64, "h": 64, "fl_x": focal, "fl_y": focal, "camera_model": "OPENCV_FISHEYE", "k1": k1}
    scenes.write_json(folder / "transforms.json", **keys, frames=frames)
    return folder


def test_a_fisheye_that_does_not_fill_its_frame_is_read(tmp_path):
    dataset = load_dataset(fisheye(tmp_path, scenes.random_images(9, (64, 64))))
    assert any("lens reaches 30 %" in message or "lens reaches 31 %" in message for message in dataset.messages)
    np.testing.assert_array_equal(dataset.mask(0) > 0, FOLDING.seen())
    view = Photographs(dataset).view(0, 1)
    assert 0 < (view.image[..., 3] > 0).mean() < 1


def test_a_lens_that_reaches_next_to_nothing_is_refused(tmp_path):
    with pytest.raises(InputError, match="turns back on itself"):
        load_dataset(fisheye(tmp_path, scenes.random_images(9, (64, 64)), k1=-1.5))


@pytest.mark.parametrize("dark", [0, 14])
def test_the_disc_that_a_fisheye_lights_is_found(tmp_path, dark):
    """A lens without a fold whose corners are black in all pictures: they were never lit, and are no black things."""
    far = np.hypot(np.arange(64) + 0.5 - 32, (np.arange(64) + 0.5 - 32)[:, None])
    images = scenes.random_images(12, (64, 64))
    for image in images:
        image[far > 26] = dark
    dataset = load_dataset(fisheye(tmp_path, images, k1=0.0, focal=30.0))
    assert any("fisheye lens" in message and "disc" in message for message in dataset.messages)
    assert not (dataset.mask(0)[far > 26] > 0).any() and (dataset.mask(0)[far < 25] > 0).all()
    plain = load_dataset(fisheye(tmp_path / "full", scenes.random_images(12, (64, 64)), k1=0.0, focal=30.0))
    assert plain.masks is None


def test_a_mask_that_all_training_views_share_is_the_cameras(tmp_path):
    folder = write(tmp_path, "none", masked=())
    Image.fromarray(np.where(OUT, 0, 255).astype(np.uint8)).save(folder / "camera.png")
    document = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(document["frames"]):
        if i % 8:  # every 8th is held out
            frame["mask_path"] = "camera.png"
    (folder / "transforms.json").write_text(json.dumps(document))
    held = load_dataset(folder, "val")
    np.testing.assert_array_equal(held.mask(0), np.where(OUT, 0, 255))
    assert any("share one mask" in message for message in held.messages)
