"""The benchmark measures what it says and leaves the octree alone."""

import json

import numpy as np
import pytest

from nerfvol.cameras.paths import default_orbit, orbit_cameras
from nerfvol.measure import bench, roofline
from nerfvol.octree.io import save_octree
from tests.fixtures.tiny import make_sphere_octree


@pytest.fixture
def cameras():
    return orbit_cameras(2, default_orbit([[-1, -1, -1], [1, 1, 1]]), (64, 64))


def test_median_does_not_count_the_first_call(monkeypatch):
    clock = iter([0.0, 1.0, 10.0, 13.0, 20.0, 22.0])
    calls = []
    monkeypatch.setattr(bench.time, "perf_counter", lambda: next(clock))
    assert bench.median_seconds(calls.append, 3) == 2.0
    assert calls == [0, 0, 1, 2]


def test_training_rate_leaves_the_octree_as_it_is(cameras):
    octree = make_sphere_octree(4)
    before = octree.values.copy()
    rate, samples, tested = bench.training_rate(octree, cameras, 2)
    assert np.array_equal(octree.values, before)
    assert rate > 0 and 0 < samples < 64 and 0 < tested < octree.n_leaves


def test_bench_command(tmp_path, command, monkeypatch):
    monkeypatch.setattr(bench, "BASE_SIZE", 48)
    monkeypatch.setattr(bench, "REFERENCE_RAYS", 64)
    monkeypatch.setattr(bench, "REFERENCE_TILES", 4)
    monkeypatch.setattr(bench, "TRAIN_TILES", 16)
    machine = roofline.Machine(read=2e10, copy=3e10, operations=1e11, threads=1)
    monkeypatch.setattr(roofline, "measure_machine", lambda threads: machine)
    save_octree(tmp_path / "o.safetensors", make_sphere_octree(5), {})
    code, text, _ = command(
        "bench", tmp_path / "o.safetensors", "--sizes", "16,32", "--repeats", 1, "--threads", 1,
        "--json", tmp_path / "b.json", "--plot", tmp_path / "b.svg",
    )  # fmt: skip
    assert code == 0 and "roofline: memory 20.0 GB/s read, 30.0 GB/s copied" in text
    assert (tmp_path / "b.svg").read_text().startswith("<?xml")
    assert "frames a second" in text and "training rays/s" in text and "million segments/s" in text
    record = json.loads((tmp_path / "b.json").read_text())
    assert {row["size"] for row in record["render"]} == {16, 32}
    assert all(row["frames_per_second"] > 0 for row in record["render"])
    assert record["size"][-1]["leaves"] == make_sphere_octree(5).n_leaves
    assert record["reference"]["kernel_over_paper_mlp"] > 0 and record["reference"]["train_step_kernel_over_torch"] > 0
    assert record["machine"]["bandwidth"] == 3e10 and record["exponents"] == {"frame": None, "train_ray": None}
    size = record["size"][-1]
    assert size["train_segments_per_second"] == size["train_rays_per_second"] * size["samples_per_ray"]
    assert size["frames_per_second_by_bandwidth"] * size["frame_bytes"] == pytest.approx(3e10)
    assert size["train_rays_per_second_by_arithmetic"] * size["train_ray_operations"] == pytest.approx(1e11)
    assert record["file"]["bytes"] == (tmp_path / "o.safetensors").stat().st_size
