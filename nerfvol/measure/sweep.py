"""Sweeps: a training run for every cell of a grid of settings or scenes, and one table and one page of what came of them.

Every cell is a process of its own, so that one that fails is a row with its sentence and the others go on.
"""

from __future__ import annotations

import csv
import html
import io
import itertools
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nerfvol.config.assemble import assemble, read_yaml, run_settings, to_plain
from nerfvol.config.training import Config
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json, write_text
from nerfvol.files.run_folder import CHECKPOINT, CONFIG, METRICS

COLUMNS = ("psnr", "ssim", "seconds", "MB", "seconds_per_frame")
"""Of a run's metrics."""
PICTURE = "view.png"
_KEYS = {"base", "grid", "runs"}
_NEVER = ("out", "resume")


def cells_of(path: str | Path, out: str | Path) -> list[dict[str, Any]]:
    """The cells that the YAML file ``path`` describes: name, folder below ``out``, its own values and its settings.

    ``base``: settings that all share; ``grid``: lists of values by dotted setting, every combination is a cell; ``runs``: a
    list of mappings from dotted settings, a cell each. Every cell's settings are checked here, before the first one runs.

    Raises:
        InputError: other keys, no cell, a setting that there is not, or one of a sweep's own.
    """
    document = read_yaml(path)
    surplus = sorted(set(map(str, document)) - _KEYS)
    if surplus:
        raise InputError(f"{path}: unknown key {surplus[0]!r}, expected base, grid and runs")
    base, grid, runs = document.get("base") or {}, document.get("grid") or {}, document.get("runs") or []
    if not (isinstance(base, dict) and isinstance(grid, dict) and isinstance(runs, list)):
        raise InputError(f"{path}: base and grid are settings with values, runs a list of such")
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise InputError(f"{path}: grid.{key} needs a list of values, got {values!r:.60}")
    own = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())] if grid else []
    for row in runs:
        if not isinstance(row, dict):
            raise InputError(f"{path}: every one of runs is settings with values, got {row!r:.60}")
        own.append(row)
    if not own:
        raise InputError(f"{path} describes no run: it needs a grid, or runs")
    digits = len(str(len(own)))
    cells = []
    for number, values in enumerate(own, 1):
        settings = _nested(base, values, str(path))
        folder = Path(out) / f"{number:0{digits}d}_{_slug(values)}"
        assemble(Config, (settings, f"{path}, run {number}"), ({"out": str(folder)}, "sweep"))
        cells.append({"name": folder.name, "folder": str(folder.resolve()), "values": values, "settings": settings})
    return cells


def train_cell(settings: Mapping[str, Any], files: Mapping[str, Path], cell: Mapping[str, Any]) -> dict[str, Any]:
    """Trains a cell unless it is finished, goes on where it was stopped: its metrics, or {"error": its sentence}.

    settings: "threads" of the run. files: none. In the form that cluster tasks have; runs where the folder can be written.
    """
    folder = Path(cell["folder"])
    found = finished(cell)
    if found is not None:
        return found
    folder.mkdir(parents=True, exist_ok=True)
    options = folder / "cell.yaml"
    write_text(
        options, json.dumps({**cell["settings"], "out": str(folder), "threads": settings["threads"]})
    )  # is YAML too
    train = [sys.executable, "-m", "nerfvol.cli", "train"]
    error = ""
    if (folder / CHECKPOINT).is_file() and _same(folder, cell):
        error = _run([*train, "--resume", "--out", str(folder)])
    if error or finished(cell) is None:  # from the start, also where what lies there cannot be gone on with
        error = _run([*train, "--config", str(options)])
    if error:
        return {"error": error}
    drawing = subprocess.run([sys.executable, "-c", _DRAW, str(folder)], capture_output=True, text=True)
    metrics = finished(cell)
    if metrics is None:
        return {"error": "it wrote no metrics"}
    return metrics | ({} if drawing.returncode == 0 else {"picture": "could not be drawn"})


def _run(command: Sequence[str]) -> str:
    """The last sentence of a command that fails, nothing where it does not."""
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", stdin=subprocess.DEVNULL)
    if not done.returncode:
        return ""
    lines = [line for line in done.stderr.strip().splitlines() if line.strip()]
    return lines[-1] if lines else f"it ended with code {done.returncode}"


_DRAW = "import sys; from nerfvol.measure.sweep import draw; draw(sys.argv[1])"


def draw(folder: str) -> None:
    """The first held-out view of a finished run, truth and render side by side, as view.png in its folder."""
    import numpy as np

    from nerfvol.datasets.load import load_dataset
    from nerfvol.files import pictures
    from nerfvol.models import load_model

    settings, model = assemble(Config, (run_settings(folder), CONFIG)), load_model(folder)
    background = model.metadata.get("background", WHITE)
    dataset = load_dataset(
        settings.data, "val", settings.downscale, holdout=settings.holdout, scene=settings.scene
    ).evenly(1)
    truth = dataset.composited(0, background)
    image = model.render(dataset.cameras[0], background)["rgb"]
    pictures.write_png(Path(folder) / PICTURE, np.concatenate([truth, np.clip(image, 0, 1)], 1))


def finished(cell: Mapping[str, Any]) -> dict[str, Any] | None:
    """The columns of a cell that was trained with these settings, None where it is to be done."""
    folder = Path(cell["folder"])
    if not (folder / METRICS).is_file() or not _same(folder, cell):
        return None
    metrics = read_json(folder / METRICS)
    if not isinstance(metrics, dict) or not all(key in metrics for key in COLUMNS):
        return None
    return {key: metrics[key] for key in COLUMNS}


def write_sweep(out: Path, cells: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any] | None]) -> list[Path]:
    """sweep.csv, sweep.md and sweep.html in ``out``; a row None is not done yet."""
    keys = list(dict.fromkeys(key for cell in cells for key in cell["values"]))
    head = ["run", *keys, *COLUMNS, "error"]
    body = []
    for cell, row in zip(cells, rows, strict=True):
        found = {"error": "not done yet"} if row is None else row
        body.append(
            [cell["name"], *(_text(cell["values"].get(key, "")) for key in keys), *(_text(found.get(k, "")) for k in COLUMNS),
             found.get("error", "")]
        )  # fmt: skip
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([head, *body])
    write_text(out / "sweep.csv", buffer.getvalue())
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(str(value).replace("|", "\\|") for value in row) + " |" for row in body]
    write_text(out / "sweep.md", "\n".join(lines) + "\n")
    figures = []
    for cell, row in zip(cells, body, strict=True):
        shown = html.escape(
            "  ".join(f"{key} {value}" for key, value in zip(head[1:], row[1:], strict=True) if value != "")
        )
        picture = f'<img src="{html.escape(cell["name"])}/{PICTURE}" alt="" loading="lazy">'
        figures.append(f"<figure>{'' if row[-1] else picture}<figcaption>{shown}</figcaption></figure>")
    write_text(out / "sweep.html", _PAGE.format(title=html.escape(out.name), figures="\n".join(figures)))
    return [out / f"sweep.{suffix}" for suffix in ("csv", "md", "html")]


_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>body{{font:14px system-ui;margin:2em;background:#fafafa}}figure{{display:inline-block;width:380px;margin:0 1em 1em 0;
vertical-align:top}}img{{width:100%}}figcaption{{white-space:pre-wrap}}</style>
<h1>{title}</h1><p>Left the photograph, right what was learned: the first view that was held out.</p>
{figures}
</html>
"""


def _same(folder: Path, cell: Mapping[str, Any]) -> bool:
    """Whether the run in ``folder`` has the cell's settings, but for folder, threads and how it goes on."""
    if not (folder / CONFIG).is_file():
        return False
    wanted = to_plain(assemble(Config, (cell["settings"], "sweep")))
    found = run_settings(folder)
    return all(found.get(key) == value for key, value in wanted.items() if key not in ("out", "threads", "resume"))


def _nested(base: Mapping[str, Any], values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """``base`` with the dotted ``values`` on top."""
    out = json.loads(json.dumps(base, default=str))
    for key, value in values.items():
        *sections, name = str(key).split(".")
        place = out
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise InputError(f"{source}: {key}: {section} is no section")
        place[name] = value
    for name in _NEVER:
        if name in out:
            raise InputError(f"{source}: {name} is the sweep's own to say, leave it out")
    if isinstance(out.get("data"), str) and Path(out["data"]).exists():
        out["data"] = str(Path(out["data"]).resolve())  # the same place for every process
    return out


def _slug(values: Mapping[str, Any]) -> str:
    parts = [
        f"{str(key).split('.')[-1]}={Path(v).name if key == 'data' else v}"
        for key, v in values.items()
        for v in [str(v)]
    ]
    return re.sub(r"[^A-Za-z0-9.=-]+", "_", "_".join(parts))[:60].strip("_.")


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
