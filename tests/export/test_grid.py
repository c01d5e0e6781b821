"""Exported grids, read with numpy: samples where the file says, and a box that holds every leaf."""

import json

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.export.grid import memory
from nerfvol.measure.truth import load_grid
from nerfvol.octree.points import octree_density
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel, SplatModel
from tests.splats.scenes import random_splats


@pytest.fixture
def model():
    """A box that is twice as long along x as along y and z: of linear density along x."""
    octree = Octree.from_leaves([1, 1], [[0, 0, 0], [1, 0, 0]], (-1.0, -2.0, -3.0), 2.0, 0, 10.0)
    octree.density = 2.0 + octree.vertex_positions()[:, 0]
    return OctreeModel(octree)


def test_an_npz_of_density(tmp_path, model):
    export_model(model, tmp_path / "g.npz", resolution=8)
    with np.load(tmp_path / "g.npz", allow_pickle=False) as file:
        assert file["density"].shape == (8, 4, 4) and file["density"].dtype == np.float32
        assert np.allclose(file["lo"], (-1, -2, -3)) and np.allclose(file["hi"], (1, -1, -2))
        x = -1 + (np.arange(8) + 0.5) * 0.25  # raw density is 1 or more: explin is linear there
        assert np.allclose(file["density"], (10 * (2 + x))[:, None, None], rtol=1e-6)
    grid = load_grid(tmp_path / "g.npz")
    rng = np.random.default_rng(0)
    places = rng.uniform((-0.8, -1.8, -2.8), (0.8, -1.2, -2.2), (50, 3))
    assert np.allclose(grid.at(places), octree_density(model.octree, places), rtol=1e-5)


def test_an_npy_of_opacity_and_its_sidecar(tmp_path, model):
    export_model(model, tmp_path / "g.npy", resolution=4, quantity="opacity")
    values, box = np.load(tmp_path / "g.npy", allow_pickle=False), json.loads((tmp_path / "g.json").read_text())
    assert values.shape == (4, 2, 2) and box["quantity"] == "opacity" and box["voxel_size"] == [0.5] * 3
    assert values[0, 0, 0] == pytest.approx(1 - np.exp(-0.5 * 10 * (2 - 0.75)))


def test_what_cannot_be(tmp_path, model, command):
    with pytest.raises(InputError, match=r"goes to .*\.ply"):
        export_model(SplatModel(random_splats(3, 1, 0)), tmp_path / "g.npz")
    with pytest.raises(InputError, match="between 1 and 2048, got 100000"):
        export_model(model, tmp_path / "g.npz", resolution=100_000)
    with pytest.raises(InputError, match="of memory"):
        export_model(model, tmp_path / "g.npz", resolution=1024, free=1 << 30)
    assert memory(model, 1024) > 4 * 1024 * 512 * 512
    model.save(tmp_path / "o.safetensors")
    code, _, err = command("export", tmp_path / "o.safetensors", "--out", tmp_path / "g.npz", "--quantity", "mass")
    assert code == 2 and "sigma or opacity" in err
    assert command("export", tmp_path / "o.safetensors", "--out", tmp_path / "g.npz", "--resolution", 5)[0] == 0
    assert {p.name for p in tmp_path.iterdir()} == {"o.safetensors", "g.npz"}
