"""What the benchmark's table says: medians of two clocks, errors against a truth, and how many times faster."""

import itertools
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth import InputError, bench, bench_mitsuba, integrators
from data_synth.scenes.volumes import EVENING_SUN, cumulus


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


def test_the_table_compares_with_shadow_rays_and_makes_maps_again(monkeypatch, capsys):
    """Shadow rays are said to take 12 wall and 24 CPU seconds, each other method 3 and 4, and every further view 1."""
    times = iter([(12.0, 24.0), (1.0, 1.0), *[(3.0, 4.0), (1.0, 1.0)] * 3])
    monkeypatch.setattr(bench, "seconds", lambda work, repeats: ([work() for _ in range(repeats)], next(times))[1])
    made = []

    def counting(name, function):
        return lambda *arguments: (made.append(name), function(*arguments))[1]

    for module, name in ((integrators.gather, "gather"), (integrators.shadowmap, "build")):
        monkeypatch.setattr(module, name, counting(name, getattr(module, name)))
    scene = cumulus(EVENING_SUN, resolution=24)
    bench.single_scattering("test", scene, size=8, beams=1, repeats=2)
    # The first render of a method, then each repetition; a further view of the same scene reads what is there.
    assert made == ["gather"] * 3 + ["build"] * 6
    lines = capsys.readouterr().out.splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[4:]]
    assert [row[0].split(",")[0] for row in rows] == ["shadow rays", "deep", "deep", "deep"]
    assert rows[0][1:6] == ["12.000", "24.000", "1.000", "1.0", "1.0"]
    assert all(row[1:6] == ["3.000", "4.000", "1.000", "4.0", "6.0"] for row in rows[1:])
    for row in rows:  # against shadow rays of a quarter of the step
        error, rms, bias = (float(cell.rstrip("%")) for cell in row[6:])
        assert abs(bias) <= error <= rms and error < 10.0


def test_a_fork_that_cannot_be_run_is_said_first(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", SimpleNamespace(__version__="3"))
    with pytest.raises(InputError, match="--fork expects a Python interpreter, nowhere/python is none"):
        bench_mitsuba.main(cumulus(EVENING_SUN, resolution=16), "nowhere/python", 2)
    with pytest.raises(InputError, match="--fork belongs to mitsuba, got sky"):
        bench.main(["sky", "--fork", "python"])
