"""Structure from motion on a room whose cameras are known, and on pictures from which none can follow."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from nerfvol.poses.make import PoseSettings, make_poses
from tests.fixtures.walk import align, turn, walk, write_pictures

pytest.importorskip("pycolmap", reason="pycolmap is not installed: pip install 'nerfvol[poses]'")
N = 12
FEW = PoseSettings(features=800, threads=2)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The folder of a walk of N pictures with its cameras found, and what was said."""
    root = tmp_path_factory.mktemp("walk")
    write_pictures(root / "photos", walk(N, 0, 0.2))
    said = []
    report = make_poses(root / "photos", root / "scene", FEW, said.append)
    return root, report, said


def test_a_walk_comes_back_to_a_percent(scene):
    """After the similarity that no picture can tell: centres to a percent of their distance, and rotations to the hundredth
    of a radian that makes up for such a step in a picture (on an arc, distance and focal length make up for each other too:
    of the latter nothing is asked)."""
    root, report, _ = scene
    truth = walk(N, 0, 0.2)
    assert report["registered"] == N and report["left_out"] == []
    views = [
        *zip(*[(d.names, d.cameras) for d in (load_dataset(root / "scene", s) for s in ("train", "val"))], strict=True)
    ]
    found = {
        name: camera for names, cameras in zip(*views, strict=True) for name, camera in zip(names, cameras, strict=True)
    }
    cameras = [found[f"view_{i:03d}"] for i in range(N)]
    scale, rotation, shift = align(np.stack([c.position for c in cameras]), np.stack([c.position for c in truth]))
    u, _, vt = np.linalg.svd(sum(t.c2w[:3, :3] @ c.c2w[:3, :3].T for c, t in zip(cameras, truth, strict=True)))
    turned = u @ vt  # the rotation that no picture can tell, from rotations alone
    for mine, true in zip(cameras, truth, strict=True):
        there = scale * rotation @ mine.position + shift
        assert np.linalg.norm(there - true.position) < 0.01 * np.linalg.norm(true.position)
        cosine = (np.trace((turned @ mine.c2w[:3, :3]).T @ true.c2w[:3, :3]) - 1) / 2
        assert np.arccos(np.clip(cosine, -1, 1)) < 0.01


def test_the_report_says_what_happened(scene):
    root, report, _ = scene
    assert json.loads((root / "scene" / "poses.json").read_text()) == report
    assert (
        report["error_pixels"] < 1 and report["median_features"] > 100 and report["mapper"] in ("global", "incremental")
    )
    assert report["groups"][0]["focal_from"] == "guessed"
    assert not (root / "scene" / "poses_work").exists()


def test_what_is_there_is_not_done_again(scene):
    root, report, _ = scene
    said = []
    assert make_poses(root / "photos", root / "scene", FEW, said.append, engine=_never) == report
    assert "there already" in said[0]


def _never(job, progress):
    raise AssertionError("cameras were there")


def test_the_incremental_mapper_too(scene, tmp_path):
    root, _, _ = scene
    few = tmp_path / "photos"
    few.mkdir()
    for i in range(8):
        shutil.copy(root / "photos" / f"view_{i:03d}.png", few)
    report = make_poses(few, tmp_path / "scene", PoseSettings(features=800, threads=2, mapper="incremental"), str)
    assert report["mapper"] == "incremental" and report["registered"] >= 7


def test_two_groups_are_named(scene, tmp_path):
    """Seven pictures of one corner, five of another room: the first does not place the second, and both are named."""
    root, _, _ = scene
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(7):
        shutil.copy(root / "photos" / f"view_{i:03d}.png", photos)
    for i in range(5):
        other = np.asarray(Image.open(root / "photos" / f"view_{N - 1 - i:03d}.png"))
        Image.fromarray(255 - other[::-1, :, ::-1]).save(photos / f"zz_{i}.png")
    said = []
    try:
        report = make_poses(photos, tmp_path / "scene", FEW, said.append)
    except InputError as error:
        said.append(str(error))
    else:
        assert all(name.startswith("zz_") for name in report["left_out"]) and len(report["left_out"]) == 5
    groups = [sentence for sentence in said if "form a group without connection" in sentence]
    assert len(groups) == 1 and "7 of 12 photographs hang together (view_000.png, " in groups[0]
    assert "5 more form a group" in groups[0] and "(zz_0.png, zz_1.png, zz_2.png, zz_3.png, zz_4.png)" in groups[0]


def test_bare_walls_say_so(tmp_path):
    write_pictures(tmp_path / "photos", walk(4), bare=True)
    with pytest.raises(InputError, match="share too little: .* blur or bare walls"):
        make_poses(tmp_path / "photos", tmp_path / "scene", FEW, str)
    assert "failed" in json.loads((tmp_path / "scene" / "poses.json").read_text())


def test_turning_on_the_spot_says_so(tmp_path):
    write_pictures(tmp_path / "photos", turn(6))
    with pytest.raises(InputError, match="turning on the spot.*step sideways"):
        make_poses(tmp_path / "photos", tmp_path / "scene", FEW, str)
