"""Pictures of a benchmark: rates against leaves with the machine's roofline, PSNR against seconds. Needs matplotlib."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.atomic import atomic_write, ensure_writable_folder, read_json
from nerfvol.machine import processor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
ROOF_STYLES = {"bandwidth": "--", "arithmetic": ":"}


def check_plot(path: str, run_folders: Sequence[str]) -> None:
    """InputError, before anything is measured, where the picture cannot be made."""
    if Path(path).suffix.lower() not in FORMATS:
        raise InputError(f"--plot {path}: expected a name that ends in {', '.join(FORMATS)}")
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise InputError("--plot needs matplotlib: pip install 'nerfvol[plot]'") from error
    ensure_writable_folder(Path(path).parent)
    for run in run_folders:
        training_curve(run)


def training_curve(run: str) -> tuple[np.ndarray, np.ndarray, tuple[float, float] | None]:
    """Seconds and PSNR, (n,) each, of a run's log; final (seconds, held-out PSNR) where scored, else None.

    The PSNR of the curve is the running one of training batches, dB.

    Raises:
        InputError: the folder holds no log, or log or scores are damaged.
    """
    log = Path(run) / run_folder.LOG
    if not log.is_file():
        raise InputError(f"{run} holds no {run_folder.LOG}: it is no run folder")
    try:
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        curve = np.array([(line["seconds"], line["psnr"]) for line in lines], float).reshape(-1, 2)
        metrics = read_json(Path(run) / run_folder.METRICS) if (Path(run) / run_folder.METRICS).is_file() else {}
        final = (float(metrics["seconds"]), float(metrics["psnr"])) if "psnr" in metrics else None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{run}: log or scores are damaged ({type(error).__name__}: {error})") from error
    return curve[:, 0], curve[:, 1], final


def draw_bench(path: str, record: dict[str, Any], run_folders: Sequence[str]) -> None:
    """Write the picture of a ``nerfvol bench`` record, with the curves of ``run_folders`` next to it."""
    figure = bench_figure(record, run_folders)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix[1:].lower(), dpi=130)


def bench_figure(record: dict[str, Any], run_folders: Sequence[str]) -> Figure:
    """Frames a second and training time a ray against leaves, each with its rooflines; with runs also their PSNR. Of splats:
    frames a second and milliseconds of a training step against the picture's side."""
    from matplotlib.figure import Figure

    if "octree" not in record:
        return _splat_figure(record, run_folders)

    panels = 3 if run_folders else 2
    figure = Figure(figsize=(5.2 * panels, 4.4), layout="constrained")
    axes = figure.subplots(1, panels)
    _draw_frames(axes[0], record)
    _draw_training(axes[1], record)
    if run_folders:
        _draw_runs(axes[2], run_folders)
    hardware, machine = record["hardware"], record["machine"]
    figure.suptitle(
        f"{processor(hardware)}, {record['threads']} threads, {hardware['kernel_path']}: an octree of "
        f"{record['octree']['leaves']:,} leaves and coarser versions of it; roofline: {machine['bandwidth'] / 1e9:.0f} GB/s, "
        f"{machine['operations'] / 1e9:.0f} GFLOP/s",
        fontsize=10,
    )
    return figure


def _splat_figure(record: dict[str, Any], run_folders: Sequence[str]) -> Figure:
    from matplotlib.figure import Figure

    panels = 3 if run_folders else 2
    figure = Figure(figsize=(5.2 * panels, 4.4), layout="constrained")
    axes = figure.subplots(1, panels)
    rows, columns = record["render"], {"frames_per_second": "frames / s", "train_step_ms": "ms a training step"}
    for place, (key, unit) in zip(axes, columns.items(), strict=False):
        for isa, threads in dict.fromkeys((row["isa"], row["threads"]) for row in rows):
            chosen = [row for row in rows if (row["isa"], row["threads"]) == (isa, threads)]
            line = [row["size"] for row in chosen], [row[key] for row in chosen]
            place.plot(*line, "o-" if threads > 1 else "o--", label=f"{isa}, {threads} thread{'s' * (threads > 1)}")
        place.set(xscale="log", yscale="log", xlabel="side of the picture / pixels", ylabel=unit)
        place.grid(True, which="both", alpha=0.25)
        place.legend(fontsize=8)
    if run_folders:
        _draw_runs(axes[2], run_folders)
    hardware, count = record["hardware"], record[record["representation"]]["count"]
    title = f"{processor(hardware)}, {record['threads']} threads: {count:,} {record['representation']}"
    figure.suptitle(title, fontsize=10)
    return figure


def _by_leaves(axes: Any, title: str, unit: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel="leaves", ylabel=unit, title=title)
    axes.grid(True, which="both", alpha=0.25)
    axes.legend(fontsize=8)


def _column(record: dict[str, Any], key: str) -> np.ndarray:
    return np.array([row[key] for row in record["size"]], float)


def _draw_frames(axes: Any, record: dict[str, Any]) -> None:
    leaves = _column(record, "leaves")
    axes.plot(leaves, _column(record, "frames_per_second"), "o-", label="measured")
    for roof, style in ROOF_STYLES.items():
        axes.plot(
            leaves, _column(record, f"frames_per_second_by_{roof}"), style, color="gray", label=f"allowed by {roof}"
        )
    side = record["view_size"]
    _by_leaves(axes, f"frames a second at {side}×{side}", "frames / s")


def _draw_training(axes: Any, record: dict[str, Any]) -> None:
    leaves, micro = _column(record, "leaves"), 1e6 / _column(record, "train_rays_per_second")
    axes.plot(leaves, micro, "o-", label="measured")
    exponent = record["exponents"]["train_ray"]
    if exponent is not None:
        level = np.exp(np.mean(np.log(micro) - exponent * np.log(leaves)))
        axes.plot(leaves, level * leaves**exponent, "-", color="C1", label=f"fit: leaves$^{{{exponent:.2f}}}$")
    for roof, style in ROOF_STYLES.items():
        least = 1e6 / _column(record, f"train_rays_per_second_by_{roof}")
        axes.plot(leaves, least, style, color="gray", label=f"needed by {roof}")
    _by_leaves(axes, "training time a ray", "µs / ray")


def _draw_runs(axes: Any, run_folders: Sequence[str]) -> None:
    for number, run in enumerate(run_folders):
        seconds, psnr, final = training_curve(run)
        colour = f"C{number % 10}"
        axes.plot(seconds, psnr, "-", color=colour, lw=1, label=Path(run).resolve().name)
        if final is not None:
            axes.plot(*final, "o", color=colour)
    axes.set(xlabel="seconds from the start of the process", ylabel="PSNR / dB", xscale="log")
    axes.set_title(
        "lines: training batches, at each stage's picture size\npoints: held-out views at the end", fontsize=10
    )
    axes.grid(True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
