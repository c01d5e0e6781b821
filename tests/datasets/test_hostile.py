"""Whatever bytes a format's files hold, loading gives a dataset or one InputError: nothing else is raised or run."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures import scenes

SETTINGS = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
ODD = st.one_of(
    st.none(), st.booleans(), st.text(max_size=3), st.just([]), st.just({}), st.just([[1]]),
    st.sampled_from([0, -1, 1e-320, 1e-30, 1e16, 1e30, 1e200, 1e308, -1e308, float("nan"), float("inf"), 10**400]),
)  # fmt: skip


def write_colmap_with_points(folder, cameras, images):
    scenes.write_colmap(folder, cameras, images)
    scenes.write_points(folder, cameras, np.random.default_rng(0).normal(size=(5, 3)))


FILES = {
    "llff": (scenes.write_llff, "poses_bounds.npy"),
    "colmap cameras": (scenes.write_colmap, "sparse/0/cameras.bin"),
    "colmap images": (scenes.write_colmap, "sparse/0/images.bin"),
    "colmap points": (write_colmap_with_points, "sparse/0/points3D.bin"),
    "nsvf intrinsics": (scenes.write_nsvf, "intrinsics.txt"),
    "nsvf pose": (scenes.write_nsvf, "pose/0_view_001.txt"),
    "transforms": (scenes.write_instant_ngp, "transforms.json"),
    "image": (scenes.write_instant_ngp, "images/view_003.png"),
}


def loads_or_refuses(folder):
    try:
        dataset = load_dataset(folder)
        points = dataset.points
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 600
        return
    assert len(dataset) == len(dataset.images) and np.isfinite(dataset.scene.aabb).all()
    assert points is None or np.isfinite(points.positions).all()


@pytest.fixture(scope="module")
def templates(tmp_path_factory):
    root = tmp_path_factory.mktemp("templates")
    for name, (writer, _) in FILES.items():
        (root / name).mkdir()
        writer(root / name, scenes.ring(3), scenes.random_images(3))
    return root


@pytest.mark.parametrize("name", [name for name in FILES if name != "image"])
@SETTINGS
@given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8), st.floats(0.3, 1.5))
def test_flipped_and_missing_bytes(templates, name, flips, kept):
    path = templates / name / FILES[name][1]
    whole = path.read_bytes()
    data = bytearray(whole[: int(kept * len(whole))])
    for place, value in flips:
        data[int(place * (len(data) - 1))] = value
    try:
        path.write_bytes(data)
        loads_or_refuses(templates / name)
    finally:
        path.write_bytes(whole)


@SETTINGS
@given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4), st.floats(0.3, 1.5))
def test_damaged_images(templates, flips, kept):
    path = templates / "image" / "images/view_002.png"
    whole = path.read_bytes()
    data = bytearray(whole[: int(kept * len(whole))])
    for place, value in flips:
        data[int(place * (len(data) - 1))] = value
    try:
        path.write_bytes(data)
        loads_or_refuses(templates / "image")
    finally:
        path.write_bytes(whole)


KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k4", "p1", "camera_angle_x", "x_fov", "camera_model", "is_fisheye",
        "aabb_scale", "aabb", "frames", "train_filenames")  # fmt: skip


@SETTINGS
@given(st.lists(st.tuples(st.sampled_from(KEYS), ODD), min_size=1, max_size=3))
def test_odd_values_at_the_top(templates, changes):
    check_json(templates, lambda data: data.update(dict(changes)))


@SETTINGS
@given(st.sampled_from(("file_path", "transform_matrix", "fl_x", "w", "k2")), ODD, st.integers(0, 3), st.integers(0, 3))
def test_odd_values_in_frames(templates, key, value, row, column):
    def change(data):
        if key == "transform_matrix":
            data["frames"][1][key][row][column] = value
        else:
            data["frames"][1][key] = value

    check_json(templates, change)


def check_json(templates, change):
    path = templates / "transforms" / "transforms.json"
    whole = path.read_text()
    data = json.loads(whole)
    change(data)
    try:
        path.write_text(json.dumps(data))
        loads_or_refuses(templates / "transforms")
    finally:
        path.write_text(whole)


@SETTINGS
@given(st.integers(0, 2), st.integers(0, 16), st.sampled_from([0, -1, 1e-30, 1e16, 1e200, 1e308, np.nan, np.inf]))
def test_odd_numbers_in_llff_poses(templates, row, column, value):
    path = templates / "llff" / "poses_bounds.npy"
    whole = path.read_bytes()
    poses = np.load(path)
    poses[row, column] = value
    try:
        np.save(path, poses)
        loads_or_refuses(templates / "llff")
    finally:
        path.write_bytes(whole)


def test_pickles_are_never_run(templates, tmp_path):
    shutil.copytree(templates / "llff", tmp_path / "scene")
    mark = tmp_path / "ran"

    class Trap:
        def __reduce__(self):
            return (open, (str(mark), "w"))

    np.save(tmp_path / "scene" / "poses_bounds.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        load_dataset(tmp_path / "scene")
    assert not mark.exists()
