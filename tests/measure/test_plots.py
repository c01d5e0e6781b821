"""The pictures of a benchmark show the figures of its record and the logs of runs; what cannot be drawn is said first."""

import json
import sys

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.measure import plots

RATES = ("frames_per_second", "train_rays_per_second")


@pytest.fixture
def record():
    """Three sizes; the training time is exactly leaves^0.25 microseconds."""
    leaves = [1e4, 1e5, 1e6]
    rows = [{"leaves": n, "frames_per_second": 1e3 * n**-0.3, "train_rays_per_second": 1e6 * n**-0.25} for n in leaves]
    for row in rows:
        for rate in RATES:
            row |= {f"{rate}_by_bandwidth": 20 * row[rate], f"{rate}_by_arithmetic": 30 * row[rate]}
    return {
        "hardware": {"cpu": "a CPU", "kernel_path": "baseline"}, "threads": 2, "octree": {"leaves": 1000000},
        "machine": {"bandwidth": 2e10, "operations": 1e11}, "view_size": 800, "size": rows,
        "exponents": {"frame": 0.3, "train_ray": 0.25},
    }  # fmt: skip


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "some_run"
    folder.mkdir()
    lines = [{"seconds": 2.0, "psnr": 15.0}, {"seconds": 5.0, "psnr": 25.5}]
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "metrics.json").write_text(json.dumps({"seconds": 7.0, "psnr": 24.0}))
    return folder


def lines_of(axes):
    return {line.get_label(): line.get_xydata() for line in axes.get_lines()}


def test_the_figure_shows_the_record_and_the_run(record, run):
    frames, training, psnr = plots.bench_figure(record, [str(run)]).axes
    leaves, rates = (np.array([row[key] for row in record["size"]]) for key in ("leaves", "frames_per_second"))
    drawn = lines_of(frames)
    assert np.allclose(drawn["measured"], np.column_stack([leaves, rates]))
    assert np.allclose(drawn["allowed by bandwidth"][:, 1], 20 * rates)
    assert np.allclose(drawn["allowed by arithmetic"][:, 1], 30 * rates)
    drawn = lines_of(training)
    assert np.allclose(drawn["measured"][:, 1], leaves**0.25)
    assert np.allclose(drawn["fit: leaves$^{0.25}$"], drawn["measured"])
    assert np.allclose(drawn["needed by bandwidth"][:, 1], leaves**0.25 / 20)
    curve, point = (line.get_xydata() for line in psnr.get_lines())
    assert np.array_equal(curve, [[2.0, 15.0], [5.0, 25.5]]) and np.array_equal(point, [[7.0, 24.0]])
    assert "some_run" in [text.get_text() for text in psnr.get_legend().get_texts()]


def test_without_runs_and_with_one_size_alone(record, tmp_path):
    record["size"] = record["size"][-1:]
    record["exponents"] = {"frame": None, "train_ray": None}
    plots.draw_bench(str(tmp_path / "b.png"), record, [])
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")
    assert len(plots.bench_figure(record, []).axes) == 2


def test_a_run_that_was_not_scored_has_no_point(run):
    (run / "metrics.json").unlink()
    seconds, psnr, final = plots.training_curve(str(run))
    assert list(seconds) == [2.0, 5.0] and list(psnr) == [15.0, 25.5] and final is None


def test_what_cannot_be_drawn_is_refused_first(run, tmp_path, monkeypatch):
    plots.check_plot(str(tmp_path / "b.png"), [str(run)])
    with pytest.raises(InputError, match="ends in .png, .svg"):
        plots.check_plot(str(tmp_path / "b.jpeg"), [])
    with pytest.raises(InputError, match="holds no log.jsonl"):
        plots.check_plot(str(tmp_path / "b.png"), [str(tmp_path)])
    for damaged in ("{", '{"seconds": 3}\n', '{"seconds": "long", "psnr": 3}\n', "3\n"):
        (run / "log.jsonl").write_text(damaged)
        with pytest.raises(InputError, match="damaged"):
            plots.check_plot(str(tmp_path / "b.png"), [str(run)])
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"pip install 'nerfvol\[plot\]'"):
        plots.check_plot(str(tmp_path / "b.png"), [])
