"""What the benchmark's table says: medians of two clocks, errors against a truth, and how many times faster."""

import itertools

import numpy as np
import pytest

from data_synth import bench, media
from data_synth.cameras import Viewpoints
from data_synth.scene import Scene


def test_seconds_are_medians_of_both_clocks(monkeypatch):
    wall, cpu = itertools.accumulate([0, 1, 0, 9, 0, 2]), itertools.accumulate([0, 5, 0, 3, 0, 4])
    monkeypatch.setattr(bench.time, "perf_counter", lambda: next(wall))
    monkeypatch.setattr(bench.time, "process_time", lambda: next(cpu))
    calls = []
    assert bench.seconds(lambda: calls.append(0), 3) == (2, 4) and len(calls) == 3


def test_errors_are_relative_to_the_truth():
    truth = np.array([1.0, 3.0, 4.0, 0.0])
    assert bench.errors(truth + [1.0, -1.0, 0.0, 0.0], truth) == pytest.approx((0.25, np.sqrt(0.5) / 2, 0.0))
    assert bench.errors(1.1 * truth, truth) == pytest.approx((0.1, 0.1 * np.sqrt(6.5) / 2, 0.1))


def test_the_table_compares_both_clocks_with_shadow_rays_and_makes_maps_anew(monkeypatch, capsys):
    """Clocks that only the methods move: shadow rays 12 wall and 24 CPU seconds, the others 2 and 3, maps 1 of each more."""
    now = {"wall": 0.0, "cpu": 0.0}
    monkeypatch.setattr(bench.time, "perf_counter", lambda: now["wall"])
    monkeypatch.setattr(bench.time, "process_time", lambda: now["cpu"])

    class Method:
        def __init__(self, wall, cpu):
            self.wall, self.cpu = wall, cpu

        def __call__(self, **options):
            return self

        def render(self, scene, camera):
            made = not scene.__dict__.setdefault("_prepared", {})
            scene._prepared[self] = True
            now["wall"] += self.wall + made
            now["cpu"] += self.cpu + made
            picture = np.full((camera.height, camera.width, 3), 0.5)
            return type("Picture", (), {"rgb": picture})

    medium = media.homogeneous((-1,) * 3, (1,) * 3)
    monkeypatch.setattr(bench, "cumulus", lambda *lit: Scene(medium=medium, viewpoints=Viewpoints(radius=4.0)))
    monkeypatch.setattr(bench, "March", Method(12.0, 24.0))
    monkeypatch.setattr(bench, "DeepShadow", Method(2.0, 3.0))
    bench.single_scattering("test", 8, 1)
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in capsys.readouterr().out.splitlines()
        if "deep" in line
    ]
    assert len(rows) == 3
    for row in rows:
        assert row[1:6] == ["3.000", "4.000", "3.000", f"{13 / 3:.1f}", f"{25 / 4:.1f}"]
        assert row[6:] == ["0.00%", "0.00%", "+0.00%"]
