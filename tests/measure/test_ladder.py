"""The ladder trains what is missing, and shows its runs' scores beside published ones."""

import json

import pytest
import yaml

from nerfvol.measure import ladder
from nerfvol.training import train
from tests.fixtures.runs import TINY


@pytest.fixture
def settings(tmp_path):
    octree = {key: value for key, value in TINY["octree"].items() if key != "steps"}
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump({"octree": octree, "field": {"few_views": 0}}))
    return tmp_path / "settings.yaml"


def test_a_ladder_of_steps(tmp_path, tiny_scene, command, settings, monkeypatch):
    folder = tmp_path / "ladder"
    arguments = (
        "bench", "--ladder", tiny_scene, "--out", folder, "--threads", 1, "--settings", settings, "--published", "lego",
    )  # fmt: skip
    code, text, err = command(*arguments, "--budgets", "20steps,40steps")
    assert code == 0, err
    record = json.loads((folder / "ladder.json").read_text())
    assert [(r["representation"], r["budget"]) for r in record["rows"]] == [
        (kind, budget) for kind in ("octree", "splats") for budget in ("20steps", "40steps")
    ]
    assert [sum(row["steps"].values()) for row in record["rows"]] == [20, 40, 20, 40]
    for row in record["rows"]:
        assert row["psnr"] == json.loads((folder / row["run"] / "metrics.json").read_text())["psnr"]
    lines = (folder / "ladder.md").read_text().splitlines()
    assert sum(line.startswith(("| octree |", "| splats |")) for line in lines) == 4
    assert (
        "| OpenSplat at 400², on 2 CPU cores | 379 | 25.4 |" in lines and (folder / "ladder.png").stat().st_size > 5000
    )

    trained, real = [], train.train
    monkeypatch.setattr(train, "train", lambda config, **more: (trained.append(config.out), real(config, **more))[1])
    assert command(*arguments, "--budgets", "20steps,30steps", "--representations", "octree")[0] == 0
    assert trained == [str(folder / "octree_30steps")]
    settings.write_text(settings.read_text() + "seed: 1\n")
    assert command(*arguments, "--budgets", "20steps", "--representations", "octree")[0] == 0
    assert trained[1:] == [str(folder / "octree_20steps")]


def test_the_median_of_several_runs(tmp_path, tiny_scene, command, settings, monkeypatch):
    """Seeds 0, 1 and 2; a ladder that was stopped goes on with what is missing, and what was half done is begun again."""
    folder = tmp_path / "ladder"
    arguments = (
        "bench", "--ladder", tiny_scene, "--out", folder, "--threads", 1, "--settings", settings, "--budgets", "12steps",
        "--representations", "splats", "--repeats", 3,
    )  # fmt: skip
    trained, real = [], train.train

    def stopped_in_the_second(config, **more):
        trained.append((config.out, config.seed))

        def stop(run, phase, began):
            if len(trained) == 2 and phase.steps_done == 5:
                raise KeyboardInterrupt

        return real(config, watch=stop, **more)

    monkeypatch.setattr(train, "train", stopped_in_the_second)
    assert command(*arguments)[0] != 0 and len(trained) == 2
    assert command(*arguments)[0] == 0
    names = [str(folder / name) for name in ("splats_12steps", "splats_12steps_2", "splats_12steps_3")]
    assert trained == [(names[0], 0), (names[1], 1), (names[1], 1), (names[2], 2)]
    (row,) = json.loads((folder / "ladder.json").read_text())["rows"]
    scores = [json.loads((folder / name / "metrics.json").read_text())["psnr"] for name in names]
    assert row["psnr_of_runs"] == scores and row["psnr"] == sorted(scores)[1]
    assert row["run"] == names[scores.index(row["psnr"])].rsplit("/", 1)[1] and row["steps"] == {"splats": 12}
    text = (folder / "ladder.md").read_text()
    assert f"| {row['psnr']:.2f} ({min(scores):.2f} to {max(scores):.2f}) |" in text and "median PSNR of 3" in text


def test_the_table_says_on_how_many_views_each_run_was_scored():
    """A short run of an octree is scored on fewer: that is no property of the first row."""
    row = {
        "representation": "octree",
        "budget": "3s",
        "seconds": 6.5,
        "psnr": 14.1,
        "ssim": 0.76,
        "psnr_of_runs": [14.1],
    }
    row |= {"MB": 0.1, "seconds_per_frame": 0.25, "image_size": [40, 30], "n_images": 2}
    record = {
        "data": "d",
        "hardware": {"cpu": "c", "kernel_path": "avx2"},
        "threads": 2,
        "nerfvol": "1",
        "published": {},
    }
    head, *_, first, second = ladder.table(record | {"rows": [row, row | {"n_images": 20}]}).splitlines()
    assert head.startswith("d: held-out views at 40×30;")
    assert first == "| octree | 3s | 6.5 | 14.10 | 0.7600 | 2 | 0.1 | 0.250 |" and second.split(" | ")[5] == "20"
    several = ladder.table(record | {"rows": [row | {"psnr_of_runs": [14.1, 13.9, 15.2, 14.0]}]})
    assert "| 14.10 (13.90 to 15.20) |" in several and "median PSNR of 4" in several


def test_the_picture_shows_the_record():
    row = {
        "representation": "octree",
        "budget": "1m",
        "seconds": 60.0,
        "psnr": 30.0,
        "ssim": 0.9,
        "psnr_of_runs": [30.0],
    }
    record = {"data": "d", "hardware": {"cpu": "c"}, "threads": 2, "rows": [row, row | {"seconds": 6.0, "psnr": 25.0}]}
    psnr, ssim = ladder.ladder_figure(record | {"published": ladder.PUBLISHED["bonsai"]}).axes
    assert psnr.get_lines()[0].get_xydata().tolist() == [[0.1, 25.0], [1.0, 30.0]]
    assert [line.get_ydata()[0] for line in psnr.get_lines()[1:]] == [26.2, 30.5, 32.0]
    assert len(ssim.get_lines()) == 1 and not psnr.collections
    several = record | {"rows": [row | {"psnr_of_runs": [29.0, 30.0, 32.0]}], "published": {}}
    psnr, ssim = ladder.ladder_figure(several).axes
    assert [s.tolist() for s in psnr.collections[0].get_segments()] == [
        [[1.0, 29.0], [1.0, 32.0]]
    ] and not ssim.collections


@pytest.mark.parametrize(
    "more, reason",
    [
        (["--budgets", "soon"], "--budgets: expected a duration"),
        (["--budgets", "0steps"], "--budgets: expected a number of steps"),
        (["--budgets", "none"], "--budgets: expected durations"),
        (["--representations", "mesh"], "expected octree or splats"),
        (["--published", "fern"], "expected none or lego or bonsai"),
        (["--settings", "nowhere.yaml"], "no such file: nowhere.yaml"),
        (["run"], "either RUN|FILE or --ladder"),
    ],
)
def test_refusals(tmp_path, tiny_scene, command, more, reason):
    code, _, err = command("bench", "--ladder", tiny_scene, "--out", tmp_path / "l", *more)
    assert code == 2 and reason in err and err.count("\n") == 1


def test_no_data_no_folder_and_damaged_scores(tmp_path, tiny_scene, command, settings):
    assert command("bench", "--ladder", "nowhere", "--out", tmp_path / "l")[0] == 2
    assert "needs --out" in command("bench", "--ladder", tiny_scene)[2]
    run = tmp_path / "l" / "octree_20steps"
    run.mkdir(parents=True)
    (run / "metrics.json").write_text("{ damaged")
    assert ladder.finished(run, {"seed": 0}) is None  # another run: no config.yaml says what it was
    (run / "config.yaml").write_text("seed: 0\n")
    with pytest.raises(Exception, match="metrics.json is not JSON"):
        ladder.finished(run, {"seed": 0})
