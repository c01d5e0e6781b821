"""The loaders on real scenes made by others, where NERFVOL_DATA says they are."""

import json

import numpy as np
import pytest

from nerfvol.cameras.focus import focus_point
from nerfvol.datasets.load import load_dataset
from tests.fixtures.real import real_data


def visual_hull(dataset, half, n=48):
    """Corners (2, 3) of the cells of a cube of half side ``half`` that every image sees, and none as empty."""
    middles = (np.arange(n) + 0.5) / n * 2 * half - half
    points = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), axis=-1).reshape(-1, 3)
    for camera, image in zip(dataset.cameras, dataset.images, strict=True):
        alpha = np.pad(image[..., 3], 1)
        pixels = np.clip(np.floor(camera.project(points)).astype(int) + 1, 0, (alpha.shape[1] - 1, alpha.shape[0] - 1))
        points = points[alpha[pixels[:, 1], pixels[:, 0]] > 0]
    return points.min(axis=0) - half / n, points.max(axis=0) + half / n


@pytest.mark.parametrize("name,size", [("lego", 800), ("chair_400", 400)])
def test_nerf_synthetic(name, size):
    dataset = load_dataset(real_data(name), "train", downscale=size // 100)
    assert len(dataset) == 100 and dataset.names[:2] == ["r_0", "r_1"]
    assert dataset.images[0].shape == (100, 100, 4) and dataset.scene.has_alpha
    half = dataset.scene.aabb[1, 0]
    assert 1.45 < half < 1.55 and not dataset.scene.is_unbounded
    np.testing.assert_allclose(dataset.scene.aabb, [[-half] * 3, [half] * 3], atol=1e-3)
    assert not any(image[[0, -1], :, 3].any() or image[:, [0, -1], 3].any() for image in dataset.images)  # nothing cut
    low, high = visual_hull(dataset, half=1.3 * half)
    assert (low > dataset.scene.aabb[0]).all() and (high < dataset.scene.aabb[1]).all()  # the object is inside
    held = load_dataset(real_data(name), "test", downscale=size // 100)
    assert len(held) == 20 and "val views are used instead" in held.messages[0]


def test_fox_reports_the_photographs_that_are_missing():
    train, held = (load_dataset(real_data("fox"), split, downscale=8) for split in ("train", "val"))
    listed = json.loads((real_data("fox") / "transforms.json").read_text())["frames"]
    assert len(listed) == 67 and len(train) + len(held) == 50
    assert any("lists 17 images that are not on disk" in message for message in train.messages)
    assert not set(train.names) & set(held.names) and len(held) == 7
    lens = train.cameras[0].intrinsics
    assert (lens.width, lens.height) == (135, 240) and lens.k1 == 0.0578421 and lens.p2 == 0.00015575
    assert lens.fx == 1375.52 / 8 and lens.cy == 965.268 / 8
    assert not train.scene.has_alpha and train.scene.is_unbounded
    focus = focus_point(train.cameras)
    assert focus.certainty > 0.3
    for camera in train.cameras:  # the fox is in every picture
        x, y = camera.project([focus.point])[0]
        assert 0 < x < 135 and 0 < y < 240
    np.testing.assert_array_equal(train.scene.aabb, held.scene.aabb)


def test_fern():
    dataset = load_dataset(real_data("fern"))
    assert len(dataset) == 17 and dataset.images[0].shape == (378, 504, 3)
    assert dataset.cameras[0].intrinsics.cx == 252
    assert "between near 16.9" in dataset.messages[-1]
    forward = np.stack([camera.forward for camera in dataset.cameras])
    assert (forward @ forward[0] > 0.9).all()  # forward-facing


def test_cup():
    train, held = (load_dataset(real_data("cup"), split) for split in ("train", "val"))
    assert len(train) == 67 and len(held) == 10 and train.images[0].shape == (600, 800, 3)
    (lens,) = {camera.intrinsics for camera in train.cameras + held.cameras}
    assert lens.fx == lens.fy and lens.k1 != 0 and lens.k2 == 0  # SIMPLE_RADIAL
    assert focus_point(train.cameras).certainty > 0.3
    points = train.points
    assert len(points) == 2274 and 0.3 < points.errors.mean() < 1 and points.track_lengths.min() >= 2
    assert points.colours.std() > 10
    assert not any("tracks" in message for message in train.messages)  # the points are where the photographs show them
