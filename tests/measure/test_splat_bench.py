"""The benchmark of splats measures what it says and leaves them alone."""

import json

import numpy as np
import pytest

from nerfvol.cameras.paths import default_orbit, orbit_cameras
from nerfvol.kernels import ops
from nerfvol.measure import splat_bench
from nerfvol.splats.io import save_splats
from nerfvol.views import SplatModel
from tests.splats.scenes import random_splats
from tests.test_clouds import points_file


def test_the_splats_stay_as_they_are():
    model = SplatModel(random_splats(60, 4, 0))
    before, isa = model.packed.params.copy(), ops.isa()
    views = [orbit_cameras(2, default_orbit(model.aabb()), (side, side)) for side in (24, 40)]
    rows = splat_bench.measure(model, views, 1, 1)
    assert np.array_equal(model.packed.params, before) and ops.isa() == isa
    assert {(row["isa"], row["size"]) for row in rows} == {(i, s) for i in ops.available_isas() for s in (24, 40)}
    assert all(row["frames_per_second"] > 0 and row["train_step_ms"] > 0 for row in rows)


@pytest.mark.parametrize("kind", ["splats", "points"])
def test_bench_command(tmp_path, command, kind):
    path = tmp_path / "s.safetensors"
    save_splats(path, random_splats(60, 4, 0), {})
    if kind == "points":
        path = points_file(tmp_path / "p.ply")
    code, text, err = command(
        "bench", path, "--sizes", "24,16", "--repeats", 1, "--threads", 1, "--json", tmp_path / "b.json",
        "--plot", tmp_path / "b.svg",
    )  # fmt: skip
    assert code == 0, err
    assert "frames a second" in text and "ms a training step" in text and f" {kind}, " in text
    record = json.loads((tmp_path / "b.json").read_text())
    assert record["representation"] == kind and record["file"]["bytes"] == path.stat().st_size
    assert (tmp_path / "b.svg").read_text().startswith("<?xml")
