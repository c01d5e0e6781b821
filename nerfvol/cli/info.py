"""``nerfvol info``: what a model file holds, and which compute path runs on this machine."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from typing import Any

from nerfvol import __version__
from nerfvol.cli.command import Command


@dataclass
class InfoOptions:
    """``nerfvol info``."""

    target: str = ""
    json: bool = False


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    p.add_argument("target", metavar="RUN|FILE", nargs="?", help="model file or run folder; without: this machine")
    p.add_argument("--json", action="store_true", help="print JSON instead of text")


def run(options: InfoOptions) -> int:
    """Print the record, or only the machine's part where no file is named; the exit code.

    Raises:
        InputError: no such model.
    """
    from nerfvol.kernels import ops
    from nerfvol.machine import describe_hardware

    record: dict[str, Any] = {
        "nerfvol": __version__,
        "hardware": describe_hardware(),
        "kernel_paths": ops.available_isas(),
    }
    if options.target:
        from nerfvol.files.run_folder import model_path
        from nerfvol.models import describe_file, load_model

        path = model_path(options.target)
        model = load_model(path)
        record["file"] = {"path": str(path), "bytes": path.stat().st_size, **describe_file(path)}
        record[model.kind] = model.describe()
    if options.json:
        print(json.dumps(record, indent=2))
    else:
        _print(record)
    return 0


def _print(record: dict[str, Any]) -> None:
    from nerfvol.machine import processor

    hardware = record["hardware"]
    if "file" in record:
        _print_file(record["file"])
    if "octree" in record:
        file, stats = record["file"], record["octree"]
        low, size = file["origin"], file["size"]
        print(f"root cube       {_numbers(low)} to {_numbers([x + size for x in low])}")
        print(f"leaves          {stats['leaves']:,} of {stats['nodes']:,} nodes, {stats['vertices']:,} vertices")
        levels = ", ".join(f"{2**level}³: {count:,}" for level, count in stats["leaves_by_level"].items())
        print(f"by resolution   {levels}")
        print(f"filled          {100 * stats['filled_share']:.3g} % of the root cube")
        print(f"density         {file['density']}, scale {file['density_scale']:g}")
    for kind in ("splats", "points", "field", "medium"):
        for key, value in record.get(kind, {}).items():
            print(f"{key.replace('_', ' '):15s} {f'{value:,}' if type(value) is int else json.dumps(value)}")
    print(f"nerfvol         {record['nerfvol']}")
    print(f"machine         {processor(hardware)}, {hardware['cores']} cores, {hardware['memory_gib']} GiB")
    others = [path for path in record["kernel_paths"] if path != hardware["kernel_path"]]
    print(f"compute path    {hardware['kernel_path']}" + (f" (also: {', '.join(others)})" if others else ""))


def _print_file(file: dict[str, Any]) -> None:
    if "version" not in file:  # another program's
        print(f"file            {file['path']} ({file['bytes'] / 1e6:.1f} MB)")
        return
    print(f"file            {file['path']} ({file['bytes'] / 1e6:.1f} MB, {file.get('storage', 'float32')})")
    print(
        f"format          {file['format']} {file['version']}, written by nerfvol {file.get('nerfvol', '(no version)')}"
    )
    if "colour" in file:
        print(f"colour          {file['colour']}, SH degree {file['sh_degree']}")
    for key, value in file["metadata"].items():
        print(f"{key:15s} {json.dumps(value)}")


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)


COMMAND = Command(
    summary="Show what a model file holds and which compute path runs here.",
    example="nerfvol info run\nnerfvol info run/octree.safetensors --json",
    options=InfoOptions,
    arguments=arguments,
    run=run,
    place=40,
)
