"""``nerfvol poses``: cameras of photographs or of a video."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Annotated, Literal

from nerfvol.cli.command import Command, need
from nerfvol.config.values import at_least, within
from nerfvol.errors import InputError


@dataclass
class PosesOptions:
    """``nerfvol poses``."""

    source: str = ""
    out: str = ""
    frames: Annotated[int, within(3, 2000)] = 120
    size: Annotated[int, within(200, 8000)] = 1600
    features: Annotated[int, within(100, 20000)] = 3000
    mapper: Literal["auto", "global", "incremental"] = "auto"
    fisheye: bool = False
    threads: Annotated[int, at_least(0)] = 0
    seed: Annotated[int, at_least(0)] = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    p.add_argument("source", metavar="PHOTOS|VIDEO", nargs="?", help="folder of photographs, or a video")
    p.add_argument("--out", metavar="DIR", help="folder for images/, sparse/0 and poses.json: what --data takes")
    p.add_argument("--config", metavar="FILE", help="YAML file of this command's options")
    p.add_argument("--frames", metavar="N", help="most frames that are taken of a video (default: 120)")
    p.add_argument("--size", metavar="PIXELS", help="longest side of the pictures that are written (default: 1600)")
    p.add_argument("--features", metavar="N", help="most features a picture (default: 3000)")
    p.add_argument("--mapper", metavar="auto|global|incremental", help="auto: global, and the incremental one where that "
                   "places less than 90 %% (default: auto)")  # fmt: skip
    p.add_argument("--fisheye", action="store_true", help="the lens is a fisheye (OpenCV's model)")
    p.add_argument("--threads", metavar="N", help="CPU threads (default: all)")
    p.add_argument("--seed", metavar="N", help="seed of every random choice (default: 0)")


def run(options: PosesOptions) -> int:
    """Writes the cameras and prints what came of it; the exit code.

    Raises:
        InputError: no pictures, none that hang together, or pycolmap is missing (see poses.make.make_poses).
    """
    if not options.source:
        raise InputError("nerfvol poses needs PHOTOS|VIDEO (see `nerfvol poses --help`)")
    need("poses", out=options.out)
    from nerfvol.poses.make import PoseSettings, make_poses

    values = {key: value for key, value in vars(options).items() if key not in ("source", "out")}
    print_poses(make_poses(options.source, options.out, PoseSettings(**values)))
    print(f"cameras: {options.out}; next: nerfvol train --data {options.out} --out run --time-budget 2m")
    return 0


def print_poses(report: dict) -> None:
    """What came of it, in one line."""
    print(f"{report['registered']} of {report['photographs']} photographs placed by the {report['mapper']} mapper, "
          f"{report['error_pixels']:.2f} pixels, {report['points']:,} points, {report['median_features']:,} features each, "
          f"{report['seconds']['all']:.0f} s")  # fmt: skip


COMMAND = Command(
    summary="Find the cameras of photographs or of a video (needs nerfvol[poses]).",
    example="nerfvol poses photos --out scene\nnerfvol poses walk.mp4 --out scene",
    options=PosesOptions,
    arguments=arguments,
    run=run,
    place=8,
)
