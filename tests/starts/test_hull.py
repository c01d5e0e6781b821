"""The visual hull of a cut-out object: a ball's silhouettes are carved to it, and one bad mask changes nothing."""

import dataclasses

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds
from nerfvol.starts import hull
from nerfvol.starts.choose import choose_start

LENS = Intrinsics(60, 50, 62.0, 62.0, 30.0, 25.0)
BOX = np.array([[-1.0] * 3, [1.0] * 3])
MIDDLE, RADIUS = np.array([0.2, -0.1, 0.1]), 0.5
CELL = 2 / hull.CELLS


def around(n=20, radius=3.0) -> list[Camera]:
    """On a Fibonacci sphere: from all sides."""
    z = 1 - 2 * (np.arange(n) + 0.5) / n
    angle = np.pi * (1 + 5**0.5) * np.arange(n)
    places = radius * np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return [Camera(LENS, look_at(tuple(p), (0, 0, 0))) for p in places]


def ball(camera: Camera) -> np.ndarray:
    """Red where x > the ball's middle, blue elsewhere; transparent beside it."""
    directions = LENS.directions().reshape(-1, 3).astype(float) @ camera.c2w[:3, :3].T
    to = MIDDLE - camera.position
    along = directions @ to
    square = RADIUS**2 - (to @ to - along**2)
    hit = square > 0
    at = camera.position + (along - np.sqrt(np.maximum(square, 0)))[:, None] * directions
    red = at[:, 0] > MIDDLE[0]
    picture = np.zeros((len(at), 4), np.uint8)
    picture[hit] = np.where(red[:, None], (200, 40, 40, 255), (40, 40, 200, 255))[hit]
    return picture.reshape(LENS.height, LENS.width, 4)


def dataset(images=None) -> Dataset:
    cameras = around()
    images = [ball(c) for c in cameras] if images is None else images
    return Dataset(cameras, images, [str(i) for i in range(len(cameras))], SceneBounds(BOX, None, True), "x.json")


def test_a_ball_is_carved_and_coloured():
    cloud = hull.hull_points(dataset(), 700)
    away = np.linalg.norm(cloud.positions - MIDDLE, axis=1)
    pixel = 3 / LENS.fx  # a cell stays where any of its pixel shows the ball, and 20 silhouettes leave corners
    assert len(cloud) == 700 and (away > RADIUS - 2 * CELL).all()
    assert (away < RADIUS + pixel + 3 * CELL).all() and np.median(away) < RADIUS + pixel
    clear = np.abs(cloud.positions[:, 0] - MIDDLE[0]) > 2 * CELL + pixel
    is_red = cloud.colours[:, 0] > cloud.colours[:, 2]
    assert (is_red == (cloud.positions[:, 0] > MIDDLE[0]))[clear].mean() > 0.99
    np.testing.assert_allclose(cloud.colours[clear & is_red].mean(axis=0), np.array([200, 40, 40]) / 255, atol=0.03)


def test_the_same_seed_gives_the_same_points_and_fewer_cells_all_of_them():
    data = dataset()
    a, b, other = hull.hull_points(data, 300, seed=1), hull.hull_points(data, 300, seed=1), hull.hull_points(data, 300)
    np.testing.assert_array_equal(a.positions, b.positions)
    np.testing.assert_array_equal(a.colours, b.colours)
    assert not np.array_equal(a.positions, other.positions)
    every = hull.hull_points(data, 10**6)
    assert len({tuple(c) for c in np.floor((every.positions + 1) / CELL).astype(int)}) == len(every) > 700


def test_a_small_thing_in_a_large_box_has_several_points_in_each_cell(monkeypatch):
    monkeypatch.setattr("tests.starts.test_hull.RADIUS", 0.06)
    cloud = hull.hull_points(dataset())
    cells = {tuple(c) for c in np.floor((cloud.positions + 1) / CELL).astype(int)}
    assert 0 < len(cells) < 100 and hull.FEWEST <= len(cloud) < hull.FEWEST + len(cells)
    assert len(np.unique(cloud.positions, axis=0)) == len(cloud)
    assert np.linalg.norm(cloud.positions - MIDDLE, axis=1).max() < 0.06 + 3 / LENS.fx + 3 * CELL


def test_one_empty_mask_does_not_carve_all_away_but_two_things_leave_nothing():
    images = [ball(c) for c in around()]
    images[0] = np.zeros_like(images[0])
    assert len(hull.hull_points(dataset(images), 10**6)) > 700
    corner = np.zeros_like(images[0])
    corner[:5, :5] = 255
    assert len(hull.hull_points(dataset([corner] * len(images)))) == 0


def test_one_bad_mask_of_ten_is_what_a_tenth_allows():
    data = dataset()
    ten = data.chosen(range(0, 20, 2))
    images = [np.zeros_like(ten.images[0]), *ten.images[1:]]
    assert len(hull.hull_points(dataclasses.replace(ten, images=images), 10**6)) > 700


def test_pictures_of_several_sizes_carve_each_at_its_own():
    """A first picture of 400 pixels and others of 50: the same ball, within a pixel of the small ones."""
    data = dataset()
    large = LENS.resized(480, 400)
    images = [np.repeat(np.repeat(data.images[0], 8, axis=0), 8, axis=1), *data.images[1:]]
    cameras = [data.cameras[0].through(large), *data.cameras[1:]]
    cloud = hull.hull_points(dataclasses.replace(data, images=images, cameras=cameras), 10**6)
    alike = hull.hull_points(data, 10**6)
    assert abs(len(cloud) - len(alike)) < 0.05 * len(alike)
    narrow = dataclasses.replace(LENS, width=3, cx=1.5)  # of which a factor for the first would leave nothing
    images[1], cameras[1] = images[1][:, 29:32], cameras[1].through(narrow)
    assert len(hull.hull_points(dataclasses.replace(data, images=images, cameras=cameras), 10**6))


def test_what_few_pictures_hold_is_left_out():
    """Cells beside most pictures are nothing that all agree on."""
    near = [Camera(dataclasses.replace(LENS, fx=400.0, fy=400.0), c.c2w) for c in around()]
    full = [np.full((LENS.height, LENS.width, 4), 255, np.uint8)] * len(near)
    data = dataclasses.replace(dataset(full), cameras=near)
    assert np.abs(hull.hull_points(data, 10**6).positions).max() < 0.5


def test_cut_out_objects_begin_with_it():
    data = dataset()
    start = choose_start(data, Photographs(data))
    assert (
        start.name == "hull"
        and "on the hull of the silhouettes (an object whose pictures are cut out)" in start.sentence
    )
    opaque = dataset([np.ascontiguousarray(i[..., :3]) for i in data.images])
    assert choose_start(opaque, Photographs(opaque)).name == "random"
    with pytest.raises(InputError, match="'hull' cannot be used: its pictures have no silhouettes"):
        choose_start(opaque, Photographs(opaque), "hull")
    alphas = dataset([np.dstack([i[..., :3], np.full(i.shape[:2], 255, np.uint8)]) for i in data.images])
    assert choose_start(alphas, Photographs(alphas)).name == "random"  # its hull would be the box
    corner = np.zeros_like(data.images[0])
    corner[:5, :5] = 255
    apart = dataset([corner] * len(data))
    start = choose_start(apart, Photographs(apart))  # which is how objects begin that are not cut out
    assert start.name == "random" and start.sentence.endswith("box instead (an object whose pictures are cut out)")
    few = dataset([*data.images[:8], *alphas.images[8:]])
    most = dataset([*data.images[:12], *alphas.images[12:]])
    assert not hull.has_silhouettes(few) and hull.has_silhouettes(most)
    masked = dataclasses.replace(data, masks=[None] * len(data))
    assert not hull.has_silhouettes(masked)
