"""A ladder: scores against minutes of runs that differ in time (or steps) and representation alone, and what others publish.

Published figures are from other machines and, where the name says so, other picture sizes: they say what is usual, no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol.config.assemble import run_settings
from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, read_json, write_json, write_text
from nerfvol.files.run_folder import METRICS
from nerfvol.machine import processor

PUBLISHED: dict[str, dict[str, list[tuple[float | None, float]]]] = {
    "none": {},
    "lego": {
        "instant-ngp, white background, on a GPU": [(1, 21.5), (5, 29.3), (15, 33.1), (60, 35.2), (300, 36.0)],
        "metal-gauss, on an Apple GPU": [(57, 24.0), (147, 27.0), (390, 33.3)],
        "OpenSplat at 400², on 2 CPU cores": [(379, 25.4), (560, 28.5), (661, 29.2)],
    },
    "bonsai": {
        "Plenoxels, twice the size, on a GPU": [(None, 26.2)],
        "nerfacto, twice the size, on a GPU": [(None, 30.5)],
        "3DGS, twice the size, on a GPU": [(None, 32.0)],
    },
}
"""By scene: (seconds, PSNR in dB); None: at the end of a full training."""
KEPT = ("psnr", "ssim", "seconds", "MB", "seconds_per_frame", "n_images", "image_size", "steps", "hardware")
_PARTS = ("octree", "splats")


def finished(folder: Path, wanted: Mapping[str, Any]) -> dict[str, Any] | None:
    """The metrics of a finished run with the settings ``wanted`` (as config.yaml holds them), None where it is to be made.

    Folder and threads do not count: the result does not depend on them.
    """
    if not (folder / METRICS).is_file():
        return None
    found = run_settings(folder)
    if any(found.get(key) != value for key, value in wanted.items() if key not in ("out", "threads", "resume")):
        return None
    metrics = read_json(folder / METRICS)
    return metrics if isinstance(metrics, dict) and all(key in metrics for key in KEPT) else None


def folder_of(out: Path, representation: str, budget: str, repeat: int) -> Path:
    """Of the run number ``repeat``, from 0, of one rung."""
    return out / (f"{representation}_{budget}" + (f"_{repeat + 1}" if repeat else ""))


def row_of(representation: str, budget: str, runs: Sequence[tuple[Path, Mapping[str, Any]]]) -> dict[str, Any]:
    """One rung of one or several runs (folder, metrics): the figures of the run of the median PSNR (of an even number the lower
    of the two in the middle), and ``psnr_of_runs`` in the order of the runs."""
    folder, metrics = sorted(runs, key=lambda run: run[1]["psnr"])[(len(runs) - 1) // 2]
    row = {"representation": representation, "budget": budget, "run": folder.name}
    return row | {key: metrics[key] for key in KEPT} | {"psnr_of_runs": [m["psnr"] for _, m in runs]}


def write_ladder(folder: Path, record: Mapping[str, Any]) -> list[Path]:
    """ladder.json, ladder.md and, where matplotlib is installed, ladder.png in ``folder``; those that were written."""
    write_json(folder / "ladder.json", record)
    write_text(folder / "ladder.md", table(record))
    written = [folder / "ladder.json", folder / "ladder.md"]
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return written
    figure = ladder_figure(record)
    with atomic_write(folder / "ladder.png") as temporary:
        figure.savefig(temporary, format="png", dpi=130)
    return [*written, folder / "ladder.png"]


def table(record: Mapping[str, Any]) -> str:
    """The record in Markdown."""
    hardware, rows = record["hardware"], record["rows"]
    size = "×".join(map(str, rows[0]["image_size"]))
    most = max(len(row["psnr_of_runs"]) for row in rows)
    several = f"; the run of the median PSNR of {most}, in brackets the range of all" if most > 1 else ""
    lines = [
        f"{record['data']}: held-out views at {size}; {processor(hardware)}, {record['threads']} threads, "
        f"{hardware['kernel_path']}, nerfvol {record['nerfvol']}{several}",
        "",
        "| representation | budget | seconds | PSNR / dB | SSIM | views | MB | s / frame |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['representation']} | {r['budget']} | {r['seconds']:.1f} | {r['psnr']:.2f}{_range(r['psnr_of_runs'])} "
        f"| {r['ssim']:.4f} | {r['n_images']} | {r['MB']:.1f} | {r['seconds_per_frame']:.3f} |"
        for r in rows
    ]
    if record["published"]:
        lines += ["", "| published, other machines | seconds | PSNR / dB |", "|---|---|---|"]
        for name, points in record["published"].items():
            lines += [f"| {name} | {'full' if s is None else f'{s:g}'} | {psnr:.1f} |" for s, psnr in points]
    return "\n".join(lines) + "\n"


def _range(psnr: Sequence[float]) -> str:
    return f" ({min(psnr):.2f} to {max(psnr):.2f})" if len(psnr) > 1 else ""


def ladder_figure(record: Mapping[str, Any]) -> Any:
    """PSNR with the published figures, and SSIM, against minutes; bars: the range over the runs of a rung."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.8), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True)
    for number, name in enumerate(dict.fromkeys(row["representation"] for row in record["rows"])):
        rows = sorted((r for r in record["rows"] if r["representation"] == name), key=lambda r: r["seconds"])
        minutes = [row["seconds"] / 60 for row in rows]
        for place, key in zip(axes, ("psnr", "ssim"), strict=True):
            place.plot(minutes, [row[key] for row in rows], "o-", color=f"C{number}", label=f"nerfvol, {name}")
        low, high = (np.array([pick(row["psnr_of_runs"]) for row in rows]) for pick in (min, max))
        if (low < high).any():
            axes[0].vlines(minutes, low, high, color=f"C{number}", lw=2, alpha=0.5)
    for number, (name, points) in enumerate(record["published"].items()):
        colour = f"C{5 + number}"
        timed = [(seconds / 60, psnr) for seconds, psnr in points if seconds is not None]
        if timed:
            axes[0].plot(*zip(*timed, strict=True), "s:", color=colour, lw=1, ms=4, label=name)
        for psnr in (psnr for seconds, psnr in points if seconds is None):
            axes[0].axhline(psnr, ls=":", lw=1, color=colour, label=name)
    for place, unit in zip(axes, ("PSNR / dB", "SSIM"), strict=True):
        place.set(xscale="log", xlabel="minutes, loading and scoring included", ylabel=unit)
        place.xaxis.set_major_formatter("{x:g}")
        place.xaxis.set_minor_formatter("")
        place.grid(True, which="both", alpha=0.25)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=3)
    figure.suptitle(
        f"{Path(record['data']).name}: {record['hardware']['cpu']}, {record['threads']} threads", fontsize=10
    )
    return figure


def budgets(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Training settings by budget: "30s", "5m" is wall-clock time, "500steps" a number of steps."""
    from nerfvol.config.parsers import seconds

    out: dict[str, dict[str, Any]] = {}
    for text in texts:
        number = text.removesuffix("steps")
        if number != text:
            if not (number.isascii() and number.isdigit() and 0 < int(number) < 10**9):
                raise InputError(f"--budgets: expected a number of steps such as 500steps, got {text!r}")
            out[text] = {"time_budget": None, **{part: {"steps": int(number)} for part in _PARTS}}
            continue
        try:
            duration = seconds(text)
        except ValueError as error:
            raise InputError(f"--budgets: {error}") from error
        if duration is None:
            raise InputError(f"--budgets: expected durations such as 30s or 5m, or 500steps, got {text!r}")
        out[text] = {"time_budget": duration}
    if not out:
        raise InputError("--budgets: expected at least one, such as 30s,2m")
    return out
