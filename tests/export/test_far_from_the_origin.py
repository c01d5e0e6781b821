"""A model in map coordinates, in millimetres or in huge units keeps its shape in every format that holds points."""

import copy
import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from nerfvol.export import export_model
from nerfvol.export import mesh as meshes
from nerfvol.export.tsdf import Mesh
from nerfvol.models import load_model
from nerfvol.splats.near import offset_for
from nerfvol.splats.plyfile import PlyFile
from nerfvol.views import SplatModel
from tests.splats.scenes import random_splats

UTM = np.array([448_262.5, 5_411_932.25, 300.0])


def far_splats(scale=1.0):
    splats = random_splats(200, 4, 3)
    log_scales = splats.log_scales + np.float32(np.log(scale))
    return replace(splats, means=splats.means * np.float32(scale), log_scales=log_scales, origin=scale * UTM)


@pytest.mark.parametrize(("ending", "scale"), [("ply", 1e-6), ("ply", 1.0), ("ply", 1e8), ("spz", 1.0), ("spz", 1e3)])
def test_splats_in_map_coordinates_stay_apart(tmp_path, ending, scale):
    if ending == "spz":
        pytest.importorskip("gsply")
    splats, path = far_splats(scale), tmp_path / f"s.{ending}"
    export_model(SplatModel(splats), path)
    again = load_model(path).splats
    assert not again.origin.any() or ending == "ply"
    shape = again.means.astype(float) - again.means[0]
    # float32 or 24 bits of positions that reach a few times the cube
    np.testing.assert_allclose(shape, splats.means.astype(float) - splats.means[0], atol=1e-5 * scale)
    if ending == "ply":  # the file says where: our reader gives the units of the poses back, and writes the same again
        np.testing.assert_allclose(again.means + again.origin, splats.means + splats.origin, atol=1e-6 * scale)
        export_model(SplatModel(again), tmp_path / "again.ply")
        assert (tmp_path / "again.ply").read_bytes() == path.read_bytes()


def test_units_that_an_spz_file_cannot_hold_are_refused(tmp_path):
    pytest.importorskip("gsply")
    with pytest.raises(ValueError, match="would round positions to .* narrower than"):
        export_model(SplatModel(far_splats(1e-6)), tmp_path / "s.spz")
    with pytest.raises(ValueError, match="an .spz file holds up to"):
        export_model(SplatModel(far_splats(1e8)), tmp_path / "s.spz")


def test_near_the_origin_a_file_says_nothing_of_it(tmp_path):
    export_model(SplatModel(random_splats(20, 4, 3)), tmp_path / "s.ply")
    assert b"origin" not in (tmp_path / "s.ply").read_bytes()[:1500]


@pytest.mark.parametrize("text", ["1 2", "1 2 nan", "1 2 1e30", "a b c"])
def test_an_origin_that_is_none_is_refused(tmp_path, text):
    export_model(SplatModel(far_splats()), tmp_path / "s.ply")
    data = (tmp_path / "s.ply").read_bytes()
    start = data.index(b"nerfvol origin: ")
    end = data.index(b"\n", start)
    (tmp_path / "s.ply").write_bytes(data[:start] + b"nerfvol origin: " + text.encode() + data[end:])
    with pytest.raises(ValueError, match="comment 'nerfvol origin' says .* expected three finite numbers"):
        load_model(tmp_path / "s.ply")


def test_the_command_says_so(tmp_path, command):
    from nerfvol.splats.io import save_splats

    save_splats(tmp_path / "s.safetensors", far_splats(), {})
    code, out, err = command("export", tmp_path / "s.safetensors", "--out", tmp_path / "s.ply")
    assert code == 0 and "positions are written relative to (448263, 5411932, 300)" in out, (out, err)


@pytest.mark.parametrize("far", [True, False])
def test_a_place_that_a_format_rounds_is_told(tmp_path, command, sphere_octree, far):
    from nerfvol.octree.io import save_octree

    octree = copy.copy(sphere_octree)
    octree.origin = sphere_octree.origin + far * UTM
    save_octree(tmp_path / "o.safetensors", octree, {})
    code, out, err = command("export", tmp_path / "o.safetensors", "--out", tmp_path / "o.nii", "--resolution", 4)
    assert code == 0 and ("rounded, by up to 0.25 units" in out) == far, (out, err)


@pytest.mark.parametrize("far", [True, False])
@pytest.mark.parametrize("ending", ["ply", "obj", "glb"])
def test_vertices_of_meshes_in_map_coordinates_stay_apart(tmp_path, ending, far):
    """Doubles in a .ply, digits in an .obj, a node's translation in a .glb; near the origin what it always was."""
    generator = np.random.default_rng(0)
    vertices = generator.uniform(-1, 1, (30, 3)) + far * UTM
    path = tmp_path / f"m.{ending}"
    mesh = Mesh(vertices, generator.integers(0, 30, (40, 3)).astype(np.int32), np.zeros((30, 3), np.float32))
    meshes._WRITERS[f".{ending}"](path, mesh)
    if ending == "ply":
        with PlyFile(path) as file:
            columns = file.read()
        found = np.stack([columns[name].astype(float) for name in "xyz"], axis=1)
        assert columns["x"].dtype == (np.float64 if far else np.float32)
    elif ending == "obj":
        found = np.array([line.split()[1:4] for line in path.read_text().splitlines() if line[:2] == "v "], float)
    else:
        data = path.read_bytes()
        (n,) = struct.unpack_from("<I", data, 12)
        node = json.loads(data[20 : 20 + n])["nodes"][0]
        assert ("translation" in node) == far
        found = np.frombuffer(data, "<f4", 90, 28 + n).reshape(30, 3) + np.array(node.get("translation", [0.0] * 3))
    np.testing.assert_allclose(found, vertices, atol=1e-5)


def test_what_is_taken_off():
    places = np.array([[5e6, 0, 0], [5e6 + 1, 1, 1.0]])
    assert not offset_for(places, 1.0).any() and not offset_for(np.zeros((0, 3)), 0.1).any()
    offset = offset_for(places, 0.1)
    assert np.abs(places - offset).max() <= 1 and (offset * 10 == np.round(offset * 10)).all()
    assert (offset_for(places[:1], 0.1) == places[0]).all()
