"""What load_model opens of other programs' files, and point clouds drawn with the EWA filter."""

import json

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.clouds import PointModel
from nerfvol.errors import InputError
from nerfvol.models import load_model
from nerfvol.splats.ply import save_ply
from nerfvol.splats.points import PointCloud
from nerfvol.views import SplatModel
from tests.splats.scenes import random_splats
from tests.splats.test_ply import write_table


def grid_cloud(side: float, n: int, colour, normals=True) -> PointCloud:
    """n x n points of the square [-side, side]^2 in the plane z = 0."""
    places = (np.arange(n) + 0.5) / n * 2 * side - side
    x, y = (a.ravel() for a in np.meshgrid(places, places, indexing="ij"))
    up = np.tile(np.float32([0, 0, 1]), (n * n, 1)) if normals else None
    return PointCloud(np.stack([x, y, 0 * x], 1), np.broadcast_to(colour(x, y), (n * n, 3)).astype(np.float32), up)


def pinhole(size: int, focal: float, eye, target=(0, 0, 0), up=(0, 1, 0)) -> Camera:
    return Camera(Intrinsics(size, size, focal, focal, size / 2, size / 2), look_at(eye, target, up))


@pytest.mark.parametrize("composite", ["surface", "over"])
@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("shift", [0.0, 0.31])
def test_a_screen_of_points_at_the_nyquist_spacing_is_flat(shift, normals, composite):
    """One point a pixel, wherever in the pixel it lies: to 1 % of its colour, and hardly anything shines through."""
    colour = (0.8, 0.5, 0.2)
    cloud = grid_cloud(1.0, 64, lambda x, y: colour, normals)
    camera = pinhole(48, 64.0, (shift * 2 / 64, shift * 2 / 64, 2.0), (shift * 2 / 64, shift * 2 / 64, 0))
    image = PointModel(cloud, composite=composite).render(camera, (0, 0, 0), ("rgb", "opacity"))
    ratio = (image["rgb"] / colour)[8:-8, 8:-8]
    assert np.ptp(ratio) < 0.01 * ratio.mean()
    assert image["opacity"][8:-8, 8:-8].min() > {"surface": 0.9999, "over": 0.98}[composite]


@pytest.mark.parametrize("composite, tolerance", [("surface", 0.02), ("over", 0.25)])
def test_a_receding_checkerboard_converges_to_its_mean_grey(composite, tolerance):
    """Fields of 5 points a side, far below a pixel at the horizon."""

    def checker(x, y):
        return np.where((np.floor(x * 20) + np.floor(y * 20)) % 2 == 0, 0.2, 0.8)[:, None].repeat(3, 1)

    cloud = grid_cloud(1.0, 200, checker)
    camera = pinhole(64, 40.0, (0.0, -1.25, 0.12), (0.0, 0.9, 0.0), (0, 0, 1))
    image = PointModel(cloud, composite=composite).render(camera, (0.5, 0.5, 0.5), ("rgb", "opacity"))
    rows = image["rgb"][..., 0]
    far = np.flatnonzero((image["opacity"][:, 20:44] > 0.9).all(axis=1))[:4]  # the highest rows that are board
    assert len(far) == 4
    assert np.abs(rows[far][:, 24:40] - 0.5).max() < tolerance
    near = rows[-16:, 16:48]
    assert np.ptp(near) > 0.3  # ... and near by it is a checkerboard


def test_a_surface_hides_what_is_behind_it():
    front = grid_cloud(1.0, 64, lambda x, y: (1.0, 0.0, 0.0))
    back = grid_cloud(1.0, 64, lambda x, y: (0.0, 0.0, 1.0))
    cloud = PointCloud.joined(front, PointCloud(back.positions - (0, 0, 0.5), back.colours, back.normals))
    camera = pinhole(48, 48.0, (0, 0, 2.0))
    image = PointModel(cloud, composite="surface").render(camera, (0, 0, 0), ("rgb", "median_depth", "normal"))
    inner = slice(8, -8)
    assert image["rgb"][inner, inner, 0].min() > 0.99 and image["rgb"][inner, inner, 2].max() < 0.01
    assert np.allclose(image["median_depth"][23:25, 23:25], 2.0, atol=1e-3)
    assert np.allclose(image["normal"][inner, inner], (0, 0, 1), atol=1e-3)


# ---------------------------------------------------------------- files
def points_file(path, n=40, **more):
    rng = np.random.default_rng(1)
    table = {name: rng.normal(size=n) for name in "xyz"} | {
        c: rng.integers(0, 255, n) for c in ("red", "green", "blue")
    }
    write_table(path, table | more, types={c: "u1" for c in ("red", "green", "blue")})
    return path


def test_load_model_tells_gaussians_from_points(tmp_path):
    save_ply(tmp_path / "g.ply", random_splats(30, 4, 0, "plain"))
    assert load_model(tmp_path / "g.ply").splats.mode == "plain"
    model = load_model(points_file(tmp_path / "p.PLY"))
    assert isinstance(model, PointModel) and model.describe()["points"] == 40


def test_spz(tmp_path):
    pytest.importorskip("gsply")
    from nerfvol.splats.spz import save_spz

    save_spz(tmp_path / "g.spz", random_splats(30, 4, 0))
    model = load_model(tmp_path / "g.spz")
    assert isinstance(model, SplatModel) and model.splats.n == 30 and model.splats.mode == "mip"


def test_commands_on_a_ply(tmp_path, command, tiny_scene):
    path = points_file(tmp_path / "p.ply")
    save_ply(tmp_path / "g.ply", random_splats(30, 4, 0))
    for options in ([], ["--composite", "over"]):
        code, _, err = command("render", path, "--orbit", 1, "--size", "24x16", "--out", tmp_path / "o", *options)
        assert code == 0, err
    code, out, _ = command("info", tmp_path / "g.ply", "--json")
    assert code == 0 and json.loads(out)["splats"]["splats"] == 30
    code, out, _ = command("info", path)
    assert code == 0 and "points          40" in out
    code, out, err = command("eval", tmp_path / "g.ply", "--data", tiny_scene)
    assert code == 0 and "PSNR" in out, err


def test_composite_is_for_points(tmp_path, command):
    save_ply(tmp_path / "g.ply", random_splats(30, 4, 0))
    code, _, err = command(
        "render", tmp_path / "g.ply", "--orbit", 1, "--out", tmp_path / "o", "--composite", "surface"
    )
    assert code == 2 and "is for point clouds" in err


HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n"
XYZ = "".join(f"property float {c}\n" for c in "xyz")
HOSTILE = {
    "empty": (b"", "does not start with the line 'ply'"),
    "cut.header": (b"ply\nformat binary_little_endian 1.0\nelement ver", "no end within"),
    "cut.rows": (HEADER.format(n=5, properties=XYZ).encode() + bytes(30), "declares 5 vertices"),
    "lies": (HEADER.format(n=10**9, properties=XYZ).encode() + bytes(120), "declares 1000000000 vertices"),
    "no.vertices": (HEADER.format(n=0, properties=XYZ).encode(), "without points cannot be drawn"),
    "one.place": (HEADER.format(n=4, properties=XYZ).encode() + bytes(48), "all at one place"),
    "nan": (HEADER.format(n=2, properties=XYZ).encode() + np.full(6, np.nan, "<f4").tobytes(), "point 0 is not finite"),
    "no.z": (HEADER.format(n=1, properties=XYZ.replace(" z", " w")).encode() + bytes(12), "no property 'z'"),
    "half.gaussian": (
        HEADER.format(n=1, properties=XYZ + "property float scale_0\n").encode() + bytes(16), "holds no Gaussians"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("verb", ["info", "render", "eval", "export", "bench"])
def test_hostile_files_are_refused_in_a_sentence(tmp_path, command, name, verb):
    data, reason = HOSTILE[name]
    path = tmp_path / f"{name}.ply"
    path.write_bytes(data)
    options = {
        "info": [], "render": ["--orbit", 1, "--out", tmp_path / "o"], "eval": ["--data", tmp_path],
        "export": ["--out", tmp_path / "out.ply"], "bench": ["--sizes", 16],
    }[verb]  # fmt: skip
    code, _, err = command(verb, path, *options)
    assert code == 2 and reason in err and err.count("\n") == 1 and str(path) in err


def test_unknown_columns_are_ignored(tmp_path):
    assert load_model(points_file(tmp_path / "p.ply", confidence=np.full(40, np.nan))).describe()["points"] == 40


def test_no_gaussians_and_neither_kind_of_file(tmp_path, command):
    save_ply(tmp_path / "g.ply", random_splats(3, 1, 0).select([]))
    with pytest.raises(InputError, match="holds no Gaussians"):
        load_model(tmp_path / "g.ply")
    (tmp_path / "x.bin").write_bytes(b"something else entirely")
    code, _, err = command("info", tmp_path / "x.bin")
    assert code == 2 and "its .safetensors file, a page, .ply, .spz, .splat, .npz" in err and err.count("\n") == 1
    (tmp_path / "x.spz").write_bytes(b"something else entirely")
    assert command("info", tmp_path / "x.spz")[0] == 2
