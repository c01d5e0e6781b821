"""``nerfvol render``: pictures or a video of a model along a camera path."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from nerfvol.cli.command import Command, add_drawing, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.config.values import Colour, Count, Size, aov_names, fraction, pixels
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError


@dataclass
class RenderOptions:
    """``nerfvol render``."""

    target: str = ""
    cameras: str | None = None
    orbit: Count | None = None
    size: Size | None = None
    out: str = ""
    aov: Annotated[tuple[str, ...], aov_names] = ()
    format: Literal["png", "exr"] = "png"
    fps: Count = 30
    background: Colour | None = None
    early_stop_eps: Annotated[float, fraction] = DEFAULT_EARLY_STOP
    lod: Annotated[float, pixels] = DEFAULT_LOD
    composite: Literal["surface", "over"] | None = None
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--cameras", metavar="FILE.json", help="camera path: a transforms JSON (docs/cli.md)")
    p.add_argument("--orbit", metavar="N", help="N views on a circle around the scene, as the training cameras stood")
    p.add_argument("--size", metavar="WxH", help="picture size (default: that of the cameras, or 800x800)")
    p.add_argument("--out", metavar="DIR|FILE.mp4", help="folder for pictures, or a video file")
    p.add_argument("--aov", metavar="LIST", help="also write depth,median_depth,opacity,normal")
    p.add_argument("--format", metavar="png|exr", help="exr: linear float, all AOVs in one file (default: png)")
    p.add_argument("--fps", metavar="N", help="frames a second of a video (default: 30)")
    p.add_argument("--composite", metavar="surface|over", help="point clouds (.ply without scales): surface: points at one "
                   "depth are averaged first, so that neither gaps nor overlaps show; over: one almost opaque disc or ball "
                   "over the other, as viewers of splats draw them (default: surface)")  # fmt: skip
    add_drawing(p)


def run(options: RenderOptions) -> int:
    """Writes what the options ask for and prints where it is; the exit code.

    Raises:
        InputError: options that do not go together, no such model or camera path, or a path that cannot be written.
    """
    need("render", target=options.target, out=options.out)
    if (options.cameras is None) == (options.orbit is None):
        raise InputError("nerfvol render needs either --cameras FILE.json or --orbit N")
    out = Path(options.out)
    is_video = out.suffix.lower() == ".mp4"
    if is_video and options.format == "exr":
        raise InputError("--format exr writes pictures: give --out a folder, not a video file")
    set_threads(options.threads)
    from nerfvol.cameras.paths import load_cameras, orbit_cameras
    from nerfvol.film import Film, write_pictures, write_videos

    target = open_target(options.target, options.background)
    if options.composite is not None:
        target = _composited(target, options.composite)
    if options.cameras is not None:
        cameras = load_cameras(options.cameras, options.size)
    else:
        orbit = target.orbit()
        if "arc_deg" in orbit:
            print(f"the training cameras stood on one side: the path sways within their {orbit['arc_deg']:.0f} degrees")
        cameras = orbit_cameras(options.orbit or 1, orbit, options.size)
    prepare_outputs(folder=str(out.parent if is_video else out))
    film = Film(target.model, cameras, target.background, options.aov, options.early_stop_eps, options.lod)
    started = time.perf_counter()
    written = write_videos(out, film, options.fps) if is_video else write_pictures(out, film, options.format)
    seconds = time.perf_counter() - started
    where = ", ".join(map(str, written))
    print(f"{len(cameras)} views in {seconds:.1f} s ({len(cameras) / seconds:.1f} a second): {where}")
    return 0


def _composited(target: Target, composite: Literal["surface", "over"]) -> Target:
    """The point cloud drawn in that way; InputError for any other model."""
    from nerfvol.clouds import PointModel

    model = target.model
    if not isinstance(model, PointModel):
        raise InputError(f"--composite is for point clouds, {target.path} is a model of {model.kind}")
    if composite == model.composite:
        return target
    return replace(target, model=PointModel(model.cloud, model.metadata, composite))


COMMAND = Command(
    summary="Render pictures or a video along a camera path.",
    example="nerfvol render run --orbit 120 --out orbit.mp4\n"
    "nerfvol render run --cameras path.json --out frames --aov depth,normal",
    options=RenderOptions,
    arguments=arguments,
    run=run,
    place=30,
)
