"""``nerfvol sweep``: a training run for every cell of a grid of settings or scenes."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfvol.cli.command import Command, need, prepare_outputs
from nerfvol.errors import InputError


@dataclass
class SweepOptions:
    """``nerfvol sweep``."""

    file: str = ""
    out: str = ""
    cluster: str | None = None
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    p.add_argument("file", metavar="FILE.yaml", nargs="?", help="base: settings that all share; grid: lists of values by "
                   "setting; runs: a list of settings (docs/cluster.md)")  # fmt: skip
    p.add_argument("--config", metavar="FILE", help="YAML file of this command's options")
    p.add_argument("--out", metavar="DIR", help="folder of the runs, of sweep.csv, sweep.md and sweep.html")
    p.add_argument("--cluster", metavar="WHERE", help="train on the workers of an engine, which must see --out and the data: "
                   "local:N, tcp://host:8786 or a scheduler file (docs/cluster.md)")  # fmt: skip
    p.add_argument("--threads", metavar="N", help="CPU threads of each run (default: all; with --cluster: 1)")


def run(options: SweepOptions) -> int:
    """Trains what is not finished, writes table and page after every run; 0, or 1 where a run failed.

    Raises:
        InputError: the file describes no runs, a setting that there is not, or a folder that cannot be written.
    """
    need("sweep", file=options.file, out=options.out)
    if options.threads < 0:
        raise InputError(f"--threads must be 0 (all cores) or more, got {options.threads}")
    from nerfvol.measure import sweep

    cells = sweep.cells_of(options.file, options.out)
    out = Path(options.out)
    prepare_outputs(folder=options.out)
    rows: list[dict[str, Any] | None] = [sweep.finished(cell) for cell in cells]
    todo = [number for number, row in enumerate(rows) if row is None]
    print(f"{len(cells)} runs, {len(cells) - len(todo)} finished before", flush=True)
    written = sweep.write_sweep(out, cells, rows)
    for number, row in zip(todo, _trained(options, [cells[number] for number in todo]), strict=True):
        rows[number] = row
        said = row.get("error") or f"{row['psnr']:.2f} dB in {row['seconds']:.0f} s"
        print(f"{cells[number]['name']}: {said}", flush=True)
        written = sweep.write_sweep(out, cells, rows)
    failed = sum("error" in (row or {}) for row in rows)
    print(f"written: {', '.join(map(str, written))}" + (f"; {failed} of {len(cells)} runs failed" if failed else ""))
    return 1 if failed else 0


def _trained(options: SweepOptions, cells: list[dict[str, Any]]) -> Any:
    """What became of ``cells``, one after the other or on the workers of a cluster."""
    from nerfvol.measure import sweep

    if options.cluster is None:
        return (sweep.train_cell({"threads": options.threads}, {}, cell) for cell in cells)
    return _on_cluster(options, cells)


def _on_cluster(options: SweepOptions, cells: list[dict[str, Any]]) -> Any:
    import sys

    from nerfvol.cluster.needs import Needs, with_data
    from nerfvol.cluster.share import shared_out
    from nerfvol.cluster.tasks import Job

    assert options.cluster is not None
    job = Job("nerfvol.measure.sweep:train_cell", {"threads": options.threads or 1})
    folders = sorted(
        {str(cell["settings"]["data"]) for cell in cells if Path(str(cell["settings"].get("data"))).is_dir()}
    )
    needs = Needs(data=with_data(folders))
    return shared_out(options.cluster, job, needs, cells, lambda text: print(text, file=sys.stderr), repeat=False)


COMMAND = Command(
    summary="Train a grid of settings or scenes, and table what came of it.",
    example="nerfvol sweep grid.yaml --out sweep\nnerfvol sweep grid.yaml --out sweep --cluster local:2",
    options=SweepOptions,
    arguments=arguments,
    run=run,
    place=55,
)
