"""From pictures to a folder of poses, with a stub in the place of structure from motion: what is written, and going on."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfvol.errors import InputError
from nerfvol.poses.child import Progress
from nerfvol.poses.engine import MODEL
from nerfvol.poses.make import WORK, PoseSettings, make_poses
from tests.fixtures.rooms import draw, facing_cameras, trace_planes
from tests.fixtures.scenes import write_colmap
from tests.fixtures.walk import LENS

SETTINGS = PoseSettings(size=64)


def stub(job, progress):
    """The cameras that took the pictures, which the test knows; counts its calls in the work folder's parent."""
    names = job.names
    cameras = facing_cameras(len(names), small())
    made = Path(job.work) / "made"
    write_colmap(made, cameras, [np.zeros((1, 1, 3), np.uint8)] * len(names), text=True)
    target = Path(job.work) / MODEL
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    for file in (made / "sparse" / "0").iterdir():
        text = file.read_text()
        for i, name in enumerate(sorted(p.name for p in (made / "images").iterdir())):
            text = text.replace(name, names[i])
        (target / file.name).write_text(text)
    (target / "images.bin").touch()
    links = [(a, b, 99) for a, b in zip(names, names[1:], strict=False)]
    return {"features": dict.fromkeys(names, 900), "links": links, "registered": names, "error_pixels": 0.5, "points": 10,
            "track_length": 3.0, "mapper": "global", "tried": {"global": len(names)}, "pairs": "all pairs", "cameras": [],
            "motion": {"good_pairs": len(links), "parallax": 0.1}, "seconds": {}}  # fmt: skip


def small():
    return LENS.__class__(64, 48, 60.0, 60.0, 32.0, 24.0)


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, camera in enumerate(facing_cameras(9, small())):
        Image.fromarray(draw(camera, trace_planes, 1)).save(folder / f"p{i}.png")
    return folder


def test_the_folder_holds_pictures_model_and_report(photos, tmp_path):
    said = []
    report = make_poses(photos, tmp_path / "out", SETTINGS, said.append, engine=stub)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["images", "poses.json", "sparse"]
    assert len(list((tmp_path / "out/images").iterdir())) == 9 and report["registered"] == 9
    assert report["made_of"]["settings"]["size"] == 64 and "bit for bit" in report["repeats"]


def test_an_interrupted_call_goes_on_with_its_pictures(photos, tmp_path):
    def stopped(job, progress):
        (Path(job.work) / "database.db").write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_poses(photos, tmp_path / "out", SETTINGS, str, engine=stopped)
    pictures = tmp_path / "out/images"
    times = {p.name: p.stat().st_mtime_ns for p in pictures.iterdir()}
    assert not (tmp_path / "out/sparse").exists()

    def going_on(job, progress):
        assert (Path(job.work) / "database.db").read_text() == "half"
        return stub(job, progress)

    make_poses(photos, tmp_path / "out", SETTINGS, str, engine=going_on)
    assert {p.name: p.stat().st_mtime_ns for p in pictures.iterdir()} == times


def test_other_pictures_or_settings_begin_anew(photos, tmp_path):
    make_poses(photos, tmp_path / "out", SETTINGS, str, engine=stub)
    calls = []

    def counted(job, progress):
        calls.append(len(job.names))
        return stub(job, progress)

    make_poses(photos, tmp_path / "out", PoseSettings(size=64, seed=1), str, engine=counted)
    (photos / "p8.png").unlink()
    make_poses(photos, tmp_path / "out", PoseSettings(size=64, seed=1), str, engine=counted)
    assert calls == [9, 8]
    assert not (tmp_path / "out" / WORK).exists() and len(list((tmp_path / "out/images").iterdir())) == 8


def test_the_bar_never_steps_back():
    shares = []
    bar = Progress(lambda step, share: shares.append(share))
    for step, done in (
        ("frames", 1),
        ("features", 3),
        ("matching", 8),
        ("global mapping", 10),
        ("incremental mapping", 1),
    ):
        bar.at(step, done, 10)
    assert shares == sorted(shares) and 0 <= shares[0] and shares[-1] <= 1


def test_pictures_are_never_written_over_themselves(tmp_path, photos):
    scene = tmp_path / "scene"
    shutil.move(photos, scene / "images")
    with pytest.raises(InputError, match="written over the photographs"):
        make_poses(scene / "images", scene, SETTINGS, str, engine=stub)
    assert len(list((scene / "images").iterdir())) == 9


def test_failures_leave_a_report_and_no_model(photos, tmp_path):
    def failing(job, progress):
        return stub(job, progress) | {"registered": [], "links": []}

    with pytest.raises(InputError, match="no two of the 9 photographs share enough"):
        make_poses(photos, tmp_path / "out", SETTINGS, str, engine=failing)
    assert "failed" in json.loads((tmp_path / "out/poses.json").read_text())
    assert not (tmp_path / "out/sparse").exists()


def test_a_missing_library_is_said_at_once(photos, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'nerfvol\[poses\]'"):
        make_poses(photos, tmp_path / "out", SETTINGS, str)
    assert not (tmp_path / "out").exists()
