"""``nerfvol export``: a model as a file that other programs open."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Annotated, Literal

from nerfvol.cli.command import Command, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import open_target
from nerfvol.config.values import Count, box, byte_count, fraction
from nerfvol.export import EXPORTS, choose, export_model


@dataclass
class ExportOptions:
    """``nerfvol export``."""

    target: str = ""
    out: str = ""
    format: str | None = None
    threshold: Annotated[float, fraction] | None = None
    resolution: Count | None = None
    quantity: Literal["sigma", "opacity"] | None = None
    level: Count | None = None
    max_bytes: Annotated[int | None, byte_count] = None
    crop: Annotated[tuple[float, float, float, float, float, float] | None, box] = None
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--out", metavar="FILE", help="; ".join(
        f"{' or '.join(row.suffixes)}: {row.name} of {' or '.join(row.kinds)}, opened by {row.opened_by}"
        for row in EXPORTS).replace("%", "%%"))  # fmt: skip
    p.add_argument("--format", metavar="|".join(row.name for row in EXPORTS), help="where an extension serves several "
                   "(default: the first that holds the model)")  # fmt: skip
    p.add_argument("--threshold", metavar="O", help="points: least opacity, of a leaf along its side or of a splat "
                   "(default: 0.5)")  # fmt: skip
    p.add_argument("--resolution", metavar="N", help="grid: samples along the longest side (default: 256)")
    p.add_argument("--quantity", metavar="sigma|opacity", help="grid: density in 1/scene unit, or the opacity of a voxel "
                   "along its side (default: sigma)")  # fmt: skip
    p.add_argument(
        "--level", metavar="L", help="page: the octree's finest leaves are 1/2^L of its cube (default: as it is)"
    )
    p.add_argument("--max-bytes", metavar="SIZE", help="page: the file's most bytes, such as 2MB; draws the least visible "
                   "parts coarser (default: any)")  # fmt: skip
    p.add_argument("--crop", metavar="X0,Y0,Z0,X1,Y1,Z1", help="page: only what lies in this box, scene units")


def run(options: ExportOptions) -> int:
    """Writes the file and prints what it is; the exit code.

    Raises:
        InputError: no such model, a format that does not hold it, or a path that cannot be written.
    """
    need("export", target=options.target, out=options.out)
    target = open_target(options.target)
    choose(options.out, target.model.kind, options.format)
    prepare_outputs(file=options.out)
    set_threads(options.threads)
    given = {
        name: getattr(options, name) for name in ("threshold", "resolution", "quantity", "level", "max_bytes", "crop")
    }
    row, size = export_model(target.model, options.out, options.format, **given)
    print(f"{options.out}: {row.name}, {size / 1e6:.1f} MB; opened by {row.opened_by}")
    return 0


COMMAND = Command(
    summary="Write a model as a file that other programs open.",
    example="nerfvol export run --out scene.ply",
    options=ExportOptions,
    arguments=arguments,
    run=run,
    place=35,
)
