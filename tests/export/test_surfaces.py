"""Exported surfaces: meshes read by trimesh, points by numpy; a ball and a cube come back in place, size and colour."""

import json
import struct

import numpy as np
import pytest

from data_synth.image import srgb_to_linear
from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.errors import InputError
from nerfvol.export import export_model, part, tsdf
from nerfvol.export.surface import Cameras
from nerfvol.models import load_model
from nerfvol.views import OctreeModel, SplatModel
from tests.export.shapes import BLUE, CENTER, HIGH, LOW, RADIUS, RED, SIZE, ball, box

RESOLUTION = 32
BALL_VOXEL = 2.2 * RADIUS / RESOLUTION
"""About: the box around the ball's leaves is a little larger than the ball."""


@pytest.fixture(scope="module")
def cube():
    return OctreeModel(box(mixed=False))


@pytest.fixture(scope="module")
def sphere():
    return OctreeModel(ball())


def chunks(path):
    data = path.read_bytes()
    (n,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + n]), data[28 + n :]


def test_glb_of_the_ball(tmp_path, sphere):
    """Turned by hand, z up to y up is (x, z, -y): radius to a fifth of a voxel on average, middle too, faces outwards."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("skimage")
    size = export_model(sphere, tmp_path / "a.glb", resolution=RESOLUTION, views=24).size
    assert size == (tmp_path / "a.glb").stat().st_size
    mesh = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    turned = np.array([CENTER[0], CENTER[2], -CENTER[1]])
    radius = np.linalg.norm(mesh.vertices - turned, axis=1)
    assert abs(radius.mean() - RADIUS) < 0.2 * BALL_VOXEL and np.abs(radius - RADIUS).max() < 1.0 * BALL_VOXEL
    assert np.abs(mesh.vertices.mean(axis=0) - turned).max() < 0.2 * BALL_VOXEL
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)


def test_glb_colours_are_linear_and_unlit(tmp_path, cube):
    pytest.importorskip("skimage")
    export_model(cube, tmp_path / "a.glb", resolution=RESOLUTION, views=24)
    document, data = chunks(tmp_path / "a.glb")
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    count = document["accessors"][0]["count"]
    views = document["bufferViews"]
    places = np.frombuffer(data, "<f4", offset=views[0]["byteOffset"], count=3 * count).reshape(-1, 3)
    colours = np.frombuffer(data, "<u2", offset=views[1]["byteOffset"], count=4 * count).reshape(-1, 4)[:, :3] / 65535
    assert np.allclose(places.min(0), document["accessors"][0]["min"]) and np.allclose(
        places.max(0), document["accessors"][0]["max"]
    )
    for chosen, colour in ((places[:, 0] < -0.15, RED), (places[:, 0] > 0.05, BLUE)):
        assert (
            chosen.sum() > 200
            and np.abs(np.median(colours[chosen], axis=0) - srgb_to_linear(np.array(colour))).max() < 0.01
        )
    # y up: (x, z, -y)
    low, high = np.array([LOW[0], LOW[2], -HIGH[1]]), np.array([HIGH[0], HIGH[2], -LOW[1]])
    voxel = (HIGH - LOW).max() / RESOLUTION
    assert np.abs(places.min(0) - low).max() < 1.5 * voxel and np.abs(places.max(0) - high).max() < 1.5 * voxel


def test_ply_and_obj_are_the_same_mesh(tmp_path, cube):
    """In the scene's axes; colours as trained."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("skimage")
    export_model(cube, tmp_path / "a.ply", "mesh", resolution=16, views=12)
    export_model(cube, tmp_path / "a.obj", resolution=16, views=12, up="none")
    ply, obj = (trimesh.load(tmp_path / name, process=False) for name in ("a.ply", "a.obj"))
    assert np.allclose(ply.vertices, obj.vertices, atol=1e-5) and np.array_equal(ply.faces, obj.faces)
    red = ply.vertices[:, 0] < -0.2
    assert np.abs(np.median(ply.visual.vertex_colors[red, :3], axis=0) - 255 * np.array(RED)).max() < 3
    assert np.abs(np.median(obj.visual.vertex_colors[red, :3], axis=0) - 255 * np.array(RED)).max() < 3
    voxel = (HIGH - LOW).max() / 16
    assert np.abs(ply.bounds - [LOW, HIGH]).max() < 1.5 * voxel


def test_small_components_go():
    tetrahedron = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.int32)
    many = np.concatenate([np.arange(2000)[:-2, None] + np.arange(3) + 4, tetrahedron[:1]]).astype(np.int32)
    vertices = np.random.default_rng(0).normal(size=(2004, 3))
    kept, faces = tsdf.without_islands(vertices, many)
    assert len(faces) == 1998 and len(kept) == 2000 and np.array_equal(kept[faces], vertices[many[:-1]])


def test_points_of_views(tmp_path, sphere):
    export_model(sphere, tmp_path / "p.ply", resolution=64, views=24)
    head, body = (tmp_path / "p.ply").read_bytes().split(b"end_header\n", 1)
    kinds = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    assert [name for _, name in kinds] == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    points = np.frombuffer(body, [("place", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
    offset = points["place"] - CENTER
    radius, outward = np.linalg.norm(offset, axis=1), offset / np.linalg.norm(offset, axis=1, keepdims=True)
    voxel = BALL_VOXEL / 2
    assert len(points) > 4 * np.pi * (RADIUS / voxel) ** 2 / 2 and abs(np.median(radius) - RADIUS) < voxel
    assert np.median((points["normal"] * outward).sum(1)) > 0.98
    wanted = 0.5 + 0.3 * offset / RADIUS
    assert np.median(np.abs(points["colour"] / 255 - wanted)) < 0.03
    cells = np.unique(np.floor(points["place"] / voxel).astype(int), axis=0)
    assert len(cells) > 0.6 * len(points)  # one a voxel
    assert load_model(tmp_path / "p.ply").cloud.normals is not None


def test_given_cameras_see_what_they_see(tmp_path, sphere):
    """Cameras on one side: no point of the other."""
    lens = Intrinsics(96, 96, 120.0, 120.0, 48.0, 48.0)
    eyes = CENTER + [(2.5, 0.3 * k, 0.4 * k) for k in (-2, -1, 0, 1, 2)]
    cameras = Cameras([Camera(lens, look_at(eye, CENTER)) for eye in eyes], [str(k) for k in range(5)])
    export_model(sphere, tmp_path / "p.ply", resolution=64, cameras=cameras)
    x = load_model(tmp_path / "p.ply").cloud.positions[:, 0]
    assert x.min() > CENTER[0] - 0.1 and x.max() > CENTER[0] + 0.95 * RADIUS


def test_splats_have_surfaces_too(tmp_path, sphere):
    pytest.importorskip("skimage")
    from nerfvol.starts.gaussians import splats_of_leaves

    export_model(SplatModel(splats_of_leaves(sphere.octree)), tmp_path / "a.ply", "mesh", resolution=24, views=16)
    vertices = load_model(tmp_path / "a.ply").cloud.positions
    assert abs(np.median(np.linalg.norm(vertices - CENTER, axis=1)) - RADIUS) < SIZE / 32


@pytest.mark.parametrize("up,axis", [("+y", (0, 1, 0)), ("-y", (0, -1, 0)), ("-z", (0, 0, -1)), ("+x", (1, 0, 0))])
def test_up_turns_the_scenes_up_there(up, axis):
    model = OctreeModel(ball(3), {"orbit": {"up": [0.6, 0.0, 0.8]}})
    turn = part.turn_to(model, up)
    assert np.allclose(turn @ (0.6, 0, 0.8), axis) and np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) > 0


def test_what_cannot_be(tmp_path, sphere, monkeypatch):
    with pytest.raises(InputError, match="--views must lie between 2 and 1000, got 1"):
        export_model(sphere, tmp_path / "a.glb", views=1)
    clear = ball(3)
    clear.density = -9.0
    with pytest.raises(InputError, match="no view sees anything that stops half"):
        export_model(OctreeModel(clear), tmp_path / "a.glb", views=4, resolution=16)
    monkeypatch.setitem(__import__("sys").modules, "skimage", None)
    with pytest.raises(InputError, match=r"pip install 'nerfvol\[mesh\]'"):
        export_model(sphere, tmp_path / "a.glb", views=4, resolution=16)
    assert not list(tmp_path.iterdir())
