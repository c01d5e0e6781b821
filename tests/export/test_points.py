"""Exported points, read with numpy: on the sphere, in its colours; and nerfvol opens them again."""

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.models import load_model
from nerfvol.splats.plyfile import PlyFile
from nerfvol.views import OctreeModel, SplatModel
from tests.fixtures.tiny import TINY_RADIUS, sphere_colour
from tests.splats.scenes import random_splats

ROW = [("place", "<f4", 3), ("colour", "u1", 3)]


def read(path):
    head, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = [line.split()[1] for line in head.decode().splitlines() if line.startswith("property")]
    assert kinds == ["float"] * 3 + ["uchar"] * 3
    return np.frombuffer(body, ROW)


def test_leaves_of_an_octree(tmp_path, sphere_octree):
    size = export_model(OctreeModel(sphere_octree), tmp_path / "p.ply", method="centers", threshold=0.3)[1]
    points = read(tmp_path / "p.ply")
    assert size == (tmp_path / "p.ply").stat().st_size and 500 < len(points) < sphere_octree.n_leaves
    radius = np.linalg.norm(points["place"], axis=1)
    assert TINY_RADIUS - 0.15 < radius.min() and radius.max() < TINY_RADIUS + 0.05
    on_surface = points["place"] / radius[:, None] * TINY_RADIUS
    assert np.abs(points["colour"] / 255 - sphere_colour(on_surface)).max() < 0.05
    assert load_model(tmp_path / "p.ply").describe()["points"] == len(points)


def test_means_of_splats(tmp_path):
    splats = random_splats(200, 4, 3)
    export_model(SplatModel(splats), tmp_path / "p.ply", "points", method="centers", threshold=0.6)
    points, shown = read(tmp_path / "p.ply"), 1 / (1 + np.exp(-splats.logits)) >= 0.6
    assert np.allclose(points["place"], (splats.means + splats.origin)[shown], atol=1e-5)
    wanted = np.clip(0.5 + 0.28209479 * splats.sh[shown, :, 0], 0, 1)
    assert np.abs(points["colour"] / 255 - wanted).max() < 0.51 / 255


@pytest.mark.parametrize("origin, kind", [((0, 0, 0), "float"), ((448_262.5, 5_411_932.25, 300), "double")])
def test_map_coordinates_keep_their_digits(tmp_path, origin, kind):
    """UTM northings are half a metre apart in float32; what is near the origin stays as viewers know it."""
    splats = random_splats(200, 4, 3)
    splats.origin = np.asarray(origin, float)
    export_model(SplatModel(splats), tmp_path / "p.ply", "points", method="centers", threshold=0.6)
    with PlyFile(tmp_path / "p.ply") as file:
        columns = file.read()
    assert f"property {kind} x".encode() in (tmp_path / "p.ply").read_bytes()[:400]
    shown = 1 / (1 + np.exp(-splats.logits)) >= 0.6
    places = np.stack([columns[name] for name in "xyz"], axis=1)
    assert np.abs(places - (splats.means.astype(float) + splats.origin)[shown]).max() < 1e-5
    assert len(load_model(tmp_path / "p.ply").cloud.positions) == shown.sum()


def test_nothing_so_opaque(tmp_path):
    splats = random_splats(20, 1, 3)
    splats.logits[:] = -2
    with pytest.raises(InputError, match="nothing is as opaque as 0.5, the most is 0.119: lower --threshold"):
        export_model(SplatModel(splats), tmp_path / "p.ply", "points", method="centers")
    assert not list(tmp_path.iterdir())
