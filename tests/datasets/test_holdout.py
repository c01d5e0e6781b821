"""An arc of views held out together."""

import json

import numpy as np
import pytest

from nerfvol.cameras.camera import orbit
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures.scenes import LENS, calibration, frame, random_images, save_images, write_blender, write_json


@pytest.fixture
def circle(tmp_path):
    """40 cameras on a circle, nine degrees apart; every 8th is held out by itself."""
    cameras = orbit(40, center=(0, 0, 0), radius=4.0, elevation_deg=20, intrinsics=LENS)
    names = save_images(tmp_path / "images", random_images(40))
    frames = [frame(f"images/{n}", c) for n, c in zip(names, cameras, strict=True)]
    write_json(tmp_path / "transforms.json", frames=frames, **calibration(LENS))
    return tmp_path


def test_neighbours_are_held_out_and_nothing_else_changes_sides(circle):
    train, held = (load_dataset(circle, split, holdout="arc") for split in ("train", "val"))
    own, test = load_dataset(circle, "train"), load_dataset(circle, "test", holdout="arc")
    assert len(own) == 35 and len(held) == 4 and held.names == test.names  # an eighth of 35
    numbers = [int(name[-3:]) for name in held.names]
    assert numbers == sorted(numbers) and np.ptp(numbers) <= 5  # next to each other, but for one of every 8
    assert set(train.names) | set(held.names) == set(own.names) and not set(train.names) & set(held.names)
    assert set(own.names).isdisjoint(load_dataset(circle, "val").names)
    np.testing.assert_array_equal(train.scene.aabb, held.scene.aabb)
    assert "an arc is held out: the 4 of 35 training views nearest to " in " ".join(train.messages)
    places = np.stack([camera.position for camera in train.cameras])
    gaps = [np.linalg.norm(places - camera.position, axis=1).min() for camera in held.cameras]
    step = 2 * 4 * np.cos(np.radians(20)) * np.sin(np.radians(4.5))
    assert max(gaps) > 1.9 * step


def test_views_that_a_benchmark_keeps_apart_stay_apart(tmp_path):
    cameras = orbit(20, center=(0, 0, 0), radius=4.0, elevation_deg=20, intrinsics=LENS)
    write_blender(tmp_path, cameras, random_images(20, channels=4), splits=("train", "val", "test"))
    for split in ("train", "val", "test"):
        assert str(tmp_path / "transforms_train.json") == load_dataset(tmp_path, split, holdout="arc").source


def test_too_few_views_and_no_such_way(tmp_path):
    cameras = orbit(15, center=(0, 0, 0), radius=4.0, elevation_deg=20, intrinsics=LENS)
    write_blender(tmp_path, cameras, random_images(15, channels=4), splits=("train", "val"))
    with pytest.raises(InputError, match="held out of at least 16 training views, there are 15"):
        load_dataset(tmp_path, "train", holdout="arc")
    with pytest.raises(InputError, match="holdout must be one of own, arc, got 'circle'"):
        load_dataset(tmp_path, "train", holdout="circle")


def test_a_run_and_its_scores(circle, tmp_path, command):
    run = tmp_path / "run"
    code, out, err = command(
        "train", "--data", circle, "--out", run, "--representation", "splats", "--init", "random", "--holdout", "arc",
        "--set", "splats.steps=5", "--threads", 1,
    )  # fmt: skip
    assert code == 0 and "an arc is held out" in out, err
    assert json.loads((run / "metrics.json").read_text())["n_images"] == 4
    assert "4 val views" in command("eval", run)[1]  # as the run did
    assert "5 val views" in command("eval", run, "--holdout", "own")[1]
