"""nerfvol export: help and refusals are made from the rows, and nothing is half written."""

import importlib
import inspect
import os
import subprocess
import sys

import pytest

from nerfvol import export
from nerfvol.errors import InputError
from nerfvol.export import EXPORTS, Export, choose, export_model
from nerfvol.files import atomic
from nerfvol.octree.io import save_octree
from nerfvol.views import OctreeModel


@pytest.fixture
def octree_file(tmp_path, sphere_octree):
    save_octree(tmp_path / "o.safetensors", sphere_octree, {})
    return tmp_path / "o.safetensors"


@pytest.mark.parametrize("row", EXPORTS, ids=lambda row: row.name)
def test_each_row_names_a_module_that_keeps_its_promise(row, command):
    module = importlib.import_module(row.module)
    assert tuple(inspect.signature(module.write).parameters)[2:] == row.options
    assert tuple(inspect.signature(module.memory).parameters)[1:] == row.options
    code, out, _ = command("export", "--help")
    assert code == 0 and row.name in out and all(suffix in out for suffix in row.suffixes)


def test_an_unknown_extension_is_refused_before_anything_is_made(tmp_path, command, octree_file):
    for name, reason in (("x.foo", "unknown extension .foo: expected"), ("x", "has no extension: expected")):
        code, _, err = command("export", octree_file, "--out", tmp_path / "new" / name)
        assert code == 2 and reason in err and err.count("\n") == 1
    assert not (tmp_path / "new").exists()
    assert command("export", octree_file)[0] == 2


def test_refusals_follow_from_the_rows(monkeypatch):
    rows = (
        Export("splats", (".ply",), "m", ("splats",), "viewers"),
        Export("points", (".ply",), "m", ("octree", "splats"), "Blender", ("threshold",)),
        Export("grid", (".npz",), "m", ("octree",), "numpy"),
        Export("leaves", (".ply", ".vol.gz"), "m", ("splats",), "viewers", (), ("octree",)),
        Export("model", ("",), "m", ("octree",), "COLMAP"),
    )
    monkeypatch.setattr(export, "EXPORTS", rows)
    assert choose("a.PLY", "splats").name == "splats" and choose("a.ply", "octree").name == "points"
    assert choose("a.ply", "splats", "points").name == "points"
    with pytest.raises(InputError, match=r"holds splats, this is a model of octree, which goes to \.npz"):
        choose("a.ply", "octree", "splats")
    with pytest.raises(
        InputError,
        match=r"\.npz \(grid\) holds octree, .* goes to \.ply \(leaves\), \.ply \(points\), \.ply \(splats\) or",
    ):
        choose("a.npz", "splats")
    assert choose("a.ply", "octree", "leaves").name == "leaves"  # by name alone
    assert choose("A.VOL.gz", "splats").name == "leaves" and choose("folder", "octree", "model").name == "model"
    with pytest.raises(InputError, match="unknown extension .gz: expected .npz, .ply or .vol.gz"):
        choose("a.nii.gz", "octree")
    with pytest.raises(InputError, match="format grid is not written to .ply, which is for splats, points or leaves"):
        choose("a.ply", "octree", "grid")
    with pytest.raises(InputError, match="unknown format 'mesh'"):
        choose("a.ply", "octree", "mesh")


def test_options_memory(monkeypatch, sphere_octree, tmp_path):
    class Writer:
        @staticmethod
        def memory(model, threshold=0.5):
            return 1 << 30

        @staticmethod
        def write(model, path, threshold=0.5):
            return 7

    monkeypatch.setattr(export, "EXPORTS", (Export("points", (".ply",), "m", ("octree",), "all", ("threshold",)),))
    monkeypatch.setattr(export.importlib, "import_module", lambda name: Writer)
    model = OctreeModel(sphere_octree)
    with pytest.raises(InputError, match="--resolution is no option of the format points"):
        export_model(model, tmp_path / "a.ply", resolution=4)
    with pytest.raises(InputError, match="takes about 1 GiB of memory, 0.5 GiB are free"):
        export_model(model, tmp_path / "a.ply", free=1 << 29)
    assert export_model(model, tmp_path / "a.ply", free=1 << 31, threshold=None)[1] == 7


def test_what_killed_writers_left_beside_an_export_is_removed(tmp_path, command, octree_file):
    gone = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True
    ).stdout
    names = [f".o.{process}.{atomic._machine()}{'1' * 8}.tmp.npz" for process in (gone.strip(), os.getpid())]
    for name in names:
        (tmp_path / name).touch()
    assert command("export", octree_file, "--resolution", "4", "--out", tmp_path / "o.npz")[0] == 0
    assert [path.name for path in tmp_path.glob(".*.tmp*")] == names[1:]
