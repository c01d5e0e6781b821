"""Cameras written for other programs, read back by our data sets' readers and by the formats' definitions."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, orbit
from nerfvol.cameras.lens import Fisheye
from nerfvol.cameras.paths import load_cameras
from nerfvol.datasets.colmap_files import read_cameras, read_images
from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.export.surface import Cameras
from nerfvol.rotations import rotations
from nerfvol.views import OctreeModel
from tests.export.shapes import ball

LENSES = (
    Intrinsics(64, 48, 50.0, 51.0, 31.0, 25.0, k1=0.01, p2=-0.002), Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0),
    Intrinsics(32, 32, 20.0, 20.0, 16.0, 16.0, Fisheye(k1=0.02)), Intrinsics(64, 48, 50.0, 51.0, 31.0, 25.0, k3=0.003),
)  # fmt: skip


@pytest.fixture
def cameras():
    places = orbit(8, center=(0, 0, 0), radius=3.0, elevation_deg=30.0, intrinsics=LENSES[0])
    return Cameras([Camera(LENSES[i % 4], c.c2w) for i, c in enumerate(places)], [f"photo {i}.jpg" for i in range(8)])


def test_transforms(tmp_path, cameras):
    export_model(OctreeModel(ball(3)), tmp_path / "t.json", cameras=cameras)
    for ours, theirs in zip(cameras.cameras, load_cameras(tmp_path / "t.json"), strict=True):
        assert ours.intrinsics == theirs.intrinsics and np.allclose(ours.c2w, theirs.c2w)


def test_colmap(tmp_path, cameras):
    """A world point projected by COLMAP's definition, x = R(q) X + t, lands where our camera has it."""
    export_model(OctreeModel(ball(3)), tmp_path / "sparse", "colmap", cameras=cameras)
    lenses, images = read_cameras(tmp_path / "sparse"), list(read_images(tmp_path / "sparse"))
    assert len(lenses) == 4 and [image.name for image in images] == [f"photo_{i}.jpg" for i in range(8)]
    point = np.array([0.2, -0.1, 0.3])
    for line, ours in zip(
        (tmp_path / "sparse" / "images.txt").read_text().splitlines()[1::2], cameras.cameras, strict=True
    ):
        numbers = np.array(line.split()[1:8], float)
        x, y, z = rotations(numbers[None, :4])[0] @ point + numbers[4:]
        lens = lenses[int(line.split()[8])].intrinsics(ours.intrinsics.width, ours.intrinsics.height)
        seen = lens.project(np.array([[x, -y, -z]]))
        assert z > 0 and np.allclose(seen, ours.project(point[None]), atol=1e-9)


def test_without_cameras(tmp_path, command):
    model = OctreeModel(ball(3))
    with pytest.raises(InputError, match="the format transforms writes cameras, and nothing says which"):
        export_model(model, tmp_path / "t.json")
    model.save(tmp_path / "o.safetensors")
    code, _, err = command("export", tmp_path / "o.safetensors", "--out", tmp_path / "sparse", "--format", "colmap")
    assert code == 2 and "give --cameras FILE|DATA" in err and not (tmp_path / "sparse").exists()
