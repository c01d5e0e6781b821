"""Starting points: which a dataset gets, and the limits that keep a start alive."""

from pathlib import Path

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.load import load_dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds
from nerfvol.splats import neighbours
from nerfvol.splats.neighbours import nearest
from nerfvol.splats.points import PointCloud
from nerfvol.starts.choose import choose_start
from nerfvol.starts.cloud import LARGEST_SHARE, NEAREST_SHARE, camera_distance, splats_of_cloud
from nerfvol.starts.model_points import model_points
from nerfvol.starts.random import random_points
from nerfvol.starts.subject import subject_of
from tests.fixtures import scenes

LENS = Intrinsics(40, 30, 35.0, 35.0, 20.0, 15.0)


def ring(n=8, radius=3.0):
    angles = 2 * np.pi * np.arange(n) / n
    return [Camera(LENS, look_at((radius * np.cos(a), radius * np.sin(a), 0.5), (0, 0, 0))) for a in angles]


def cloud_of(positions, seed=0):
    colours = np.random.default_rng(seed).random((len(positions), 3)).astype(np.float32)
    return PointCloud(np.asarray(positions, np.float64), colours)


# ------------------------------------------------------------------ neighbours
@pytest.mark.parametrize("points", [
    np.random.default_rng(0).normal(size=(700, 3)),
    np.random.default_rng(1).integers(0, 4, (300, 3)).astype(float),  # many at one place, many equal distances
    np.concatenate([np.zeros((50, 3)), [[1e9, 0, 0], [1e9, 1e-3, 0]]]),
    np.random.default_rng(2).normal(size=(200, 3)) ** 5 * 1e4,
], ids=["normal", "lattice", "heap", "spread"])  # fmt: skip
def test_neighbours_are_exact(points, monkeypatch):
    queries = np.concatenate([points[::7] + 0.25, [[5.0, -3, 2]]])
    found = nearest(points, 4), nearest(points, 4, queries)
    monkeypatch.setattr(neighbours, "native", lambda: None)
    expected = nearest(points, 4), nearest(points, 4, queries)
    for (squared, index), (want, of) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(squared, want)
        np.testing.assert_array_equal(index, of)


def test_neighbours_where_there_are_few():
    squared, index = nearest([[0.0, 0, 0], [0, 3, 4]], 3)
    assert squared[:, 0].tolist() == [25, 25] and np.isinf(squared[:, 1:]).all()
    assert index.tolist() == [[1, -1, -1], [0, -1, -1]]
    assert nearest(np.zeros((0, 3)), 2, [[0.0, 0, 0]])[1].tolist() == [[-1, -1]]
    for bad in ([[np.nan, 0, 0]], [[0.0, 0]]):
        with pytest.raises(ValueError, match="finite numbers of shape"):
            nearest(bad, 1)


def test_neighbours_do_not_depend_on_threads():
    kernels = pytest.importorskip("_nerfvol_kernels")
    points, before, seen = np.random.default_rng(3).normal(size=(5000, 3)), kernels.get_threads(), set()
    try:
        for threads in (1, 2, 5):
            kernels.set_threads(threads)
            seen.add(tuple(a.tobytes() for a in nearest(points, 3)))
    finally:
        kernels.set_threads(before)
    assert len(seen) == 1


# ------------------------------------------------------------------ a cloud becomes Gaussians
def test_sizes_are_the_distances_of_neighbours():
    step = 0.02
    places = step * np.stack(np.meshgrid(*[np.arange(6)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cloud = cloud_of(places)
    splats = splats_of_cloud(cloud, ring(), 3.0, degree=2)
    splats.validate()
    np.testing.assert_allclose(np.exp(splats.log_scales), step, rtol=1e-5)
    np.testing.assert_allclose(splats.means + splats.origin, places, atol=1e-7)
    assert (splats.logits == 0).all() and splats.sh.shape == (216, 3, 9) and not splats.sh[:, :, 1:].any()
    np.testing.assert_allclose(0.5 + 0.28209479177 * splats.sh[:, :, 0], cloud.colours, atol=1e-6)
    assert (splats.quats == [1, 0, 0, 0]).all() and splats.mode == "mip"
    three = splats_of_cloud(cloud_of([[0, 0, 0], [0.1, 0, 0], [0, 0.05, 0], [0, 0, 0.01]]), ring(), 3.0)
    np.testing.assert_allclose(np.exp(three.log_scales[0]), np.sqrt((0.1**2 + 0.05**2 + 0.01**2) / 3), rtol=1e-5)


def test_nothing_begins_large_or_right_before_a_lens():
    rng = np.random.default_rng(0)
    cameras, places = ring(), rng.uniform(-4, 4, (500, 3))
    places[:60] = cameras[2].position + rng.normal(0, 0.15, (60, 3))
    places[60:80] = places[60]  # at one place: still of some size
    splats = splats_of_cloud(cloud_of(places), cameras, 3.0)
    kept = splats.means + splats.origin
    to = np.min([np.linalg.norm(kept - c.position, axis=1) for c in cameras], axis=0)
    assert to.min() >= NEAREST_SHARE * 3.0 - 1e-6 and 400 < len(kept) < 500
    size = np.exp(splats.log_scales[:, 0].astype(float))
    assert (size <= LARGEST_SHARE * to * (1 + 1e-5)).all() and (size > 0.9e-4 * to).all()
    assert np.mean(size > 0.99 * LARGEST_SHARE * to) > 0.3  # few points far apart: the limit matters here
    np.testing.assert_allclose(camera_distance(kept, cameras), to)
    with pytest.raises(InputError, match="nearer to a camera than 0.08"):
        splats_of_cloud(cloud_of([cameras[0].position]), cameras, 3.0)
    alone = splats_of_cloud(cloud_of([[0.0, 0, 0]]), cameras, 3.0)
    np.testing.assert_allclose(np.exp(alone.log_scales[0, 0]), 0.06 * np.hypot(3, 0.5), rtol=1e-5)


def test_random_points_fill_the_box():
    box = np.array([[-1.0, 2, 5], [1, 2.5, 9]])
    scene = SceneBounds(box, None, True)
    cloud = random_points(scene, 2000, seed=3)
    assert (cloud.positions >= box[0]).all() and (cloud.positions <= box[1]).all()
    np.testing.assert_allclose(cloud.positions.mean(axis=0), box.mean(axis=0), atol=0.03 * 4)
    np.testing.assert_array_equal(cloud.positions, random_points(scene, 2000, seed=3).positions)
    assert not np.array_equal(cloud.positions, random_points(scene, 2000, seed=4).positions)
    with pytest.raises(InputError, match="at least one"):
        random_points(scene, 0)


# ------------------------------------------------------------------ COLMAP's points
ROWS = [  # x y z, r g b, error, observations
    ((0.0, 1, 2), (255, 0, 51), 0.5, 3), ((1, 1, 1), (1, 2, 3), 1.99, 4), ((2, 2, 2), (9, 9, 9), 2.01, 9),
    ((3, 3, 3), (9, 9, 9), 0.1, 2), ((np.nan, 0, 0), (9, 9, 9), 0.1, 5), ((4, 5, 6), (0, 255, 0), 0.0, 3),
]  # fmt: skip


def write_points(folder: Path, text: bool):
    if text:
        lines = ["# points", ""]
        for i, (place, colour, error, n) in enumerate(ROWS):
            lines.append(" ".join(map(str, (i, *place, *colour, error, *(k for j in range(n) for k in (j, 7))))))
        (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
        return folder / "points3D.txt"
    import struct

    data = struct.pack("<Q", len(ROWS))
    for i, (place, colour, error, n) in enumerate(ROWS):
        data += struct.pack("<Q3d3BdQ", i, *place, *colour, error, n) + struct.pack(f"<{2 * n}i", *range(2 * n))
    (folder / "points3D.bin").write_bytes(data)
    return folder / "points3D.bin"


def colmap_dataset(folder, text):
    scenes.write_colmap(folder, scenes.ring(), scenes.random_images(), text=text)
    path = write_points(folder / "sparse" / "0", text)
    return load_dataset(folder), path


@pytest.mark.parametrize("text", [False, True])
def test_good_points_of_a_model(tmp_path, text):
    data, path = colmap_dataset(tmp_path, text)
    cloud, sentence = model_points(data)
    np.testing.assert_array_equal(cloud.positions, [[0, 1, 2], [1, 1, 1], [4, 5, 6]])
    np.testing.assert_allclose(cloud.colours[0], [1, 0, 0.2], atol=1e-7)
    assert "3 of the 5 points" in sentence and str(path) in sentence


def test_points_that_a_transforms_json_names(tmp_path):
    for number, named in enumerate(("sparse_pc.ply", "none.ply", 7, "transforms.json", "a\0.ply", None)):
        folder = tmp_path / str(number)
        folder.mkdir()
        scenes.write_nerfstudio(folder, scenes.ring(), scenes.random_images(), ply_file_path=named)
        head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        head += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        (folder / "sparse_pc.ply").write_text(head + "0 1 2 255 0 51\n3 4 5 0 0 0\n")
        cloud, sentence = model_points(load_dataset(folder))
        assert len(cloud) == (2 if named == "sparse_pc.ply" else 0), sentence
        if len(cloud):
            np.testing.assert_array_equal(cloud.positions, [[0, 1, 2], [3, 4, 5]])
            np.testing.assert_allclose(cloud.colours[0], [1, 0, 0.2], atol=1e-7)


def test_damaged_points_of_a_model(tmp_path):
    data, path = colmap_dataset(tmp_path, text=False)
    whole = path.read_bytes()
    for damaged in (b"", whole[:4], whole[:-1], whole[:60], (10**12).to_bytes(8, "little") + whole[8:],
                    whole[:51] + (2**63).to_bytes(8, "little") + whole[59:]):  # fmt: skip
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="points3D.bin: the file is truncated"):
            model_points(data)
    path.unlink()
    cloud, sentence = model_points(load_dataset(tmp_path))
    assert len(cloud) == 0 and "without the points" in sentence


# ------------------------------------------------------------------ the choice
def photographs_of(n=6, bounded=False):
    cameras = ring(n)
    images = [np.full((30, 40, 3), 128, np.uint8) for _ in cameras]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    scene = SceneBounds(box, None if bounded else 16 * box, False)
    data = Dataset(cameras, images, [str(i) for i in range(n)], scene, "transforms.json")
    return data, Photographs(data)


def test_objects_begin_at_random_and_grey_photographs_fall_back():
    start = choose_start(*photographs_of(bounded=True))
    assert start.name == "random" and len(start.cloud) == 3000 and "seen whole" in start.sentence
    start = choose_start(*photographs_of())
    assert start.name == "random" and len(start.cloud) and "too little texture" in start.sentence
    with pytest.raises(InputError, match="'sweep' cannot be used: .*texture"):
        choose_start(*photographs_of(), name="sweep")
    with pytest.raises(InputError, match="'points' cannot be used: transforms.json"):
        choose_start(*photographs_of(), name="points")
    with pytest.raises(InputError, match="one of points, sweep, points.sweep, hull, random, got 'fog'"):
        choose_start(*photographs_of(), name="fog")


def test_models_begin_from_their_points(tmp_path, monkeypatch):
    from nerfvol.starts import choose

    data, _ = colmap_dataset(tmp_path, text=False)
    start = choose_start(data, Photographs(data))
    assert start.name == "points+sweep" and len(start.cloud) == 3 and "3 good points are few" in start.sentence
    monkeypatch.setattr(choose, "FEW_POINTS", 3)
    start = choose_start(data, Photographs(data))
    assert start.name == "points" and "3 of the 5 points" in start.sentence


def test_the_subject_is_where_axes_meet(tmp_path):
    data, _ = photographs_of()
    subject = subject_of(data)
    distance = np.hypot(3, 0.5)
    np.testing.assert_allclose([subject.distance, subject.near, subject.far], [distance, 0.3 * distance, 4 * distance])
    scenes.write_llff(tmp_path, scenes.ring(), scenes.random_images())
    subject = subject_of(load_dataset(tmp_path))
    assert (subject.near, subject.far) == (2.0, 9.0) and subject.distance == 2 / (1 / 2 + 1 / 9)
