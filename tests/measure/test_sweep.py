"""Sweeps: every cell of a grid is trained once, what is finished stays, and what fails is a row with its sentence."""

import csv
import json

import pytest

from nerfvol.errors import InputError
from nerfvol.measure import sweep
from tests.fixtures.runs import TINY

BASE = {key: value for key, value in TINY.items() if key not in ("field", "distill")} | {"init": "direct"}


def write(tmp_path, **document):
    path = tmp_path / "grid.yaml"
    path.write_text(json.dumps(document))
    return path


def test_a_grid_is_every_combination_and_runs_stand_beside_it(tmp_path):
    path = write(tmp_path, base={"seed": 3}, grid={"octree.sh_degree": [0, 1], "background": ["white", "black"]},
                 runs=[{"seed": 4}])  # fmt: skip
    cells = sweep.cells_of(path, tmp_path / "out")
    assert [cell["values"] for cell in cells] == [
        {"octree.sh_degree": degree, "background": colour} for degree in (0, 1) for colour in ("white", "black")
    ] + [{"seed": 4}]
    assert [cell["settings"]["seed"] for cell in cells] == [3, 3, 3, 3, 4]
    assert cells[2]["settings"]["octree"] == {"sh_degree": 1}
    assert len({cell["folder"] for cell in cells}) == 5


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({}, "no run"),
        ({"grids": {}}, "unknown key 'grids'"),
        ({"grid": {"seed": 3}}, "needs a list"),
        ({"grid": {"octre.sh_degree": [1]}}, "octre"),
        ({"grid": {"seed": ["many"]}}, "seed"),
        ({"runs": [{"out": "x"}]}, "out is the sweep's own"),
        ({"base": {"seed": 1}, "runs": [{"seed.x": 1}]}, "seed is no section"),
        ({"runs": ["seed"]}, "every one of runs"),
    ],
)  # fmt: skip
def test_a_file_that_describes_no_sweep_is_one_sentence(tmp_path, document, message):
    with pytest.raises(InputError, match=message):
        sweep.cells_of(write(tmp_path, **document), tmp_path / "out")


def test_cells_are_trained_once_and_a_failed_one_is_a_row(tmp_path, tiny_scene, command):
    base = BASE | {"data": str(tiny_scene), "octree": {**BASE["octree"], "steps": 6}}
    path = write(tmp_path, base=base, grid={"octree.sh_degree": [0, 1]}, runs=[{"data": str(tmp_path / "nowhere")}])
    out = tmp_path / "sweep"
    code, said, _ = command("sweep", str(path), "--out", str(out), "--threads", "1")
    assert code == 1 and "3 runs, 0 finished before" in said and "1 of 3 runs failed" in said
    with (out / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["octree.sh_degree"] for row in rows] == ["0", "1", ""]
    assert all(float(row["psnr"]) > 0 and not row["error"] for row in rows[:2])
    assert "nowhere" in rows[2]["error"] and rows[2]["psnr"] == ""
    assert all((out / row["run"] / sweep.PICTURE).is_file() for row in rows[:2])
    assert (out / "sweep.html").read_text().count("<img") == 2
    models = [(out / row["run"] / "octree.safetensors").stat().st_mtime_ns for row in rows[:2]]
    (out / rows[1]["run"] / "metrics.json").unlink()  # stopped before its end
    _, said, _ = command("sweep", str(path), "--out", str(out), "--threads", "1")
    assert "3 runs, 1 finished before" in said
    again = [(out / row["run"] / "octree.safetensors").stat().st_mtime_ns for row in rows[:2]]
    assert again[0] == models[0] and again[1] > models[1]
    assert sweep.finished(sweep.cells_of(path, out)[1]) is not None
