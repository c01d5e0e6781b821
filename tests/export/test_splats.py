"""Exported Gaussians, drawn by a rasteriser of our tests' own, look as nerfvol draws them."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.export import export_model
from nerfvol.splats.io import save_splats
from nerfvol.views import SplatModel
from tests.export.rasteriser import rasterise
from tests.splats.scenes import ORIGIN, random_splats


@pytest.mark.parametrize("mode", ["plain", "mip"])
@pytest.mark.parametrize("basis", [1, 4, 9])
def test_another_rasteriser_draws_the_same(tmp_path, mode, basis):
    splats = random_splats(400, basis, basis, mode, size=0.06)
    splats.means[:20], splats.log_scales[:20] = splats.means[:20] * 0.2, -6.0  # far below a pixel
    model = SplatModel(splats)
    assert export_model(model, tmp_path / "s.ply")[1] == (tmp_path / "s.ply").stat().st_size
    camera = Camera(Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0), look_at(ORIGIN + (0.3, -3.0, 0.8), ORIGIN))
    ours = model.render(camera, (1.0, 0.5, 0.2), early_stop_eps=0.0)["rgb"]
    theirs = rasterise(tmp_path / "s.ply", camera.c2w, 80.0, 96, 64, (1.0, 0.5, 0.2))
    assert -10 * np.log10(np.mean((ours - theirs) ** 2)) > 50


def test_the_command_of_splats_and_of_an_octree(tmp_path, command, sphere_octree):
    from nerfvol.octree.io import save_octree

    save_splats(tmp_path / "s.safetensors", random_splats(30, 4, 0), {})
    code, out, err = command("export", tmp_path / "s.safetensors", "--out", tmp_path / "s.ply")
    assert code == 0 and "splats" in out, err
    save_octree(tmp_path / "o.safetensors", sphere_octree, {})
    code, out, err = command("export", tmp_path / "o.safetensors", "--out", tmp_path / "o.ply", "--format", "splats")
    assert code == 0 and SplatModel.load(tmp_path / "o.ply").splats.n > 100, err
