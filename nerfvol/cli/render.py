"""``nerfvol render``: pictures or a video of a model along a camera path."""

from __future__ import annotations

import argparse
import functools
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from nerfvol.cli.command import Command, add_drawing, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.config.parsers import Colour, Frames, Size, aov_names, fraction, frame_choice, pixels
from nerfvol.config.values import Count, above
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera
    from nerfvol.film import Chosen

VIDEO_ENDINGS = (".mp4", ".mov", ".webm", ".gif")

FOREIGN = (".avi", ".mkv", ".webp", ".apng", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".bmp", ".m4v")
"""Names of pictures and videos that are not written: what ends so is no folder."""


@dataclass
class RenderOptions:
    """``nerfvol render``."""

    target: str = ""
    path: str | None = None
    cameras: str | None = None
    orbit: Count | None = None
    frames: Annotated[Frames | None, frame_choice] = None
    seconds: Annotated[float, above(0, 3600)] | None = None
    loop: bool = False
    size: Size | None = None
    out: str = ""
    output: Literal["rgb", "depth", "median_depth", "opacity", "normal"] = "rgb"
    aov: Annotated[tuple[str, ...], aov_names] = ()
    compare: str | None = None
    light: str | None = None
    format: Literal["png", "exr"] = "png"
    fps: Annotated[float, above(0, 240)] | None = None
    background: Colour | None = None
    early_stop_eps: Annotated[float, fraction] = DEFAULT_EARLY_STOP
    lod: Annotated[float, pixels] = DEFAULT_LOD
    composite: Literal["surface", "over"] | None = None
    cluster: str | None = None
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--path", metavar="orbit|ellipse|spiral|lemniscate|FILE", help="a move around the scene, as the training "
                   "cameras stood, or a file: our JSON or that of nerfstudio, 3DGS or instant-ngp (docs/cli.md)")  # fmt: skip
    p.add_argument("--cameras", metavar="FILE.json", help="the same as --path FILE: each camera of the file a picture")
    p.add_argument("--orbit", metavar="N", help="the same as --path orbit --frames N")
    p.add_argument("--frames", metavar="N|A-B[/S]", help="N pictures; between the cameras of a file as a smooth path through "
                   "them (default: 120 of a move, those of a file). A-B/S: only each S-th from A to B of the path's, and of "
                   "these those that are not there yet (docs/cluster.md)")  # fmt: skip
    p.add_argument("--seconds", metavar="S", help="in place of --frames: N = S x fps")
    p.add_argument("--fps", metavar="F", help="frames a second of a video (default: what the file says, or 30)")
    p.add_argument("--loop", action="store_true", help="the path through a file's cameras comes back to the first")
    p.add_argument("--size", metavar="WxH", help="picture size (default: that of the cameras, or 800x800)")
    p.add_argument(
        "--out", metavar="DIR|FILE", help=f"folder for pictures, a video ({', '.join(VIDEO_ENDINGS)}), or one .png"
    )
    p.add_argument("--output", metavar="rgb|depth|median_depth|opacity|normal", help="what is shown (default: rgb)")
    p.add_argument("--aov", metavar="LIST", help="also write depth,median_depth,opacity,normal")
    p.add_argument("--light", metavar="NAME|FILE[:NAME]", help="for media: another light of the run's, or of a JSON file of "
                   "lights (docs/relighting.md)")  # fmt: skip
    p.add_argument("--compare", metavar="RUN|FILE", help="a second model, to the right of the first")
    p.add_argument("--format", metavar="png|exr", help="exr: linear float, all AOVs in one file (default: png)")
    p.add_argument("--composite", metavar="surface|over", help="point clouds (.ply without scales): surface: points at one "
                   "depth are averaged first, so that neither gaps nor overlaps show; over: one almost opaque disc or ball "
                   "over the other, as viewers of splats draw them (default: surface)")  # fmt: skip
    add_drawing(p)
    p.add_argument("--cluster", metavar="WHERE", help="draw on the workers of an engine: local:N, tcp://host:8786 or a "
                   "scheduler file; the same bytes (needs nerfvol[cluster]; docs/cluster.md)")  # fmt: skip


def run(options: RenderOptions) -> int:
    """Writes what the options ask for and prints where it is; the exit code.

    Raises:
        InputError: options that do not go together, no such model or camera path, or a path that cannot be written.
    """
    need("render", target=options.target, out=options.out)
    _check_path_options(options)
    out, ending = Path(options.out), _ending(options)
    set_threads(options.threads)
    from nerfvol.cluster.frames import COMPARED, MODEL, OnCluster, identity
    from nerfvol.film import Film, of_one_size, write_picture, write_pictures, write_videos

    target = open_target(options.target, options.background)
    compared = open_target(options.compare, target.background) if options.compare else None
    if options.light is not None and options.cluster is not None:
        raise InputError("--light is not sent to the workers of --cluster: give one of them")
    if options.light is not None:
        target = _lit(target, options.light)
        compared = None if compared is None else _lit(compared, options.light)
    if options.composite is not None:
        target = _composited(target, options.composite)
    cameras, fps = _cameras(options, target)
    if ending in VIDEO_ENDINGS and len({(c.intrinsics.width, c.intrinsics.height) for c in cameras}) > 1:
        cameras = of_one_size(cameras)
        lens = cameras[0].intrinsics
        print(
            f"the cameras have several sizes: all are drawn at the first one's, {lens.width}x{lens.height} (or give --size)"
        )
    if ending == ".png" and len(cameras) != 1:
        raise InputError(f"{out} is one picture and there are {len(cameras)} views: give --out a folder or a video")
    if ending == ".png" and options.cluster is not None:
        raise InputError(
            f"--cluster shares out views, and {out} is one picture: leave --cluster out, or give --out a folder"
        )
    prepare_outputs(folder=str(out.parent if ending else out))
    film = Film(
        target.model,
        cameras,
        target.background,
        options.aov,
        options.early_stop_eps,
        options.lod,
        options.output,
        compared and compared.model,
    )
    started = time.perf_counter()
    files = {MODEL: target.path} | ({COMPARED: compared.path} if compared else {})
    suffix = None if ending in VIDEO_ENDINGS else "png" if ending else options.format
    each = None
    if options.cluster is not None:
        each = OnCluster(options.cluster, film, files, functools.partial(print, file=sys.stderr), suffix=suffix)
    drawn, written = len(cameras), [out]
    if ending in VIDEO_ENDINGS:
        written = write_videos(out, film, fps, each)
    elif ending:
        written = write_picture(out, film)
    else:
        chosen = _chosen(options, len(cameras))
        of = identity(film, files, suffix=suffix, **({"light": options.light} if options.light else {}))
        drawn = write_pictures(out, film, options.format, chosen, each, of)
    seconds = time.perf_counter() - started
    where = ", ".join(map(str, written))
    there = f", {len(cameras)} in the path" if drawn != len(cameras) else ""
    print(f"{drawn} views{there} in {seconds:.1f} s ({drawn / seconds:.1f} a second): {where}")
    return 0


def _chosen(options: RenderOptions, n: int) -> Chosen | None:
    """The views that are drawn where not all are: those asked for, or with a cluster those that are not there yet."""
    from nerfvol.film import Chosen

    if options.frames is not None and options.frames.count is None:
        return Chosen(options.frames.first, options.frames.last, options.frames.step)
    return Chosen(0, n - 1) if options.cluster is not None else None


def _check_path_options(options: RenderOptions) -> None:
    given = [name for name in ("path", "cameras", "orbit") if getattr(options, name) is not None]
    if not given:
        raise InputError(
            "nerfvol render needs --path orbit|ellipse|spiral|lemniscate|FILE (or --cameras FILE.json or --orbit N)"
        )
    if len(given) > 1:
        raise InputError(f"--{given[0]} and --{given[1]} both say where the cameras are: give one of them")
    count = options.frames is not None and options.frames.count is not None
    if options.frames is not None and not count and _ending(options):
        raise InputError("--frames A-B draws pictures of a path: give --out a folder, not a video or one picture")
    if count and options.seconds is not None:
        raise InputError("--frames and --seconds both say how many pictures there are: give one of them")
    if options.orbit is not None and (count or options.seconds is not None):
        raise InputError("--orbit N says how many pictures there are: use --path orbit with --frames or --seconds")


def _count(options: RenderOptions) -> int | None:
    return None if options.frames is None else options.frames.count


def _ending(options: RenderOptions) -> str:
    """The end of a video's or picture's name, or "" where --out is a folder."""
    out = Path(options.out)
    ending = out.suffix.lower()
    if out.is_dir() or options.out.endswith("/"):
        return ""
    if ending in FOREIGN:
        raise InputError(
            f"{ending} is not written: expected {', '.join(VIDEO_ENDINGS)}, .png for one view, or a folder"
        )
    if ending not in (*VIDEO_ENDINGS, ".png"):
        return ""
    if options.format == "exr":
        raise InputError("--format exr writes pictures: give --out a folder, not a video file or a .png")
    return ending


def _cameras(options: RenderOptions, target: Target) -> tuple[list[Camera], float]:
    """The cameras that the options name, and the frames a second of a video of them."""
    from nerfvol.cameras.interpolate import interpolated
    from nerfvol.cameras.paths import load_path
    from nerfvol.cameras.shots import MOVES, moving_cameras

    name = options.path or options.cameras or "orbit"
    if options.cameras is None and name in MOVES and not Path(name).is_file():
        fps = options.fps or 30.0
        count = options.orbit or _count(options) or round((options.seconds or 0) * fps) or 120
        orbit = target.orbit()
        if "arc_deg" in orbit:
            print(f"the training cameras stood on one side: the path sways within their {orbit['arc_deg']:.0f} degrees")
        seen = target.training_cameras() if name in ("ellipse", "spiral") else []
        return moving_cameras(name, count, orbit, options.size, seen), fps
    if options.cameras is None and not Path(name).exists() and not Path(name).suffix:
        raise InputError(f"unknown path {name!r}: expected {', '.join(MOVES)}, or a file")
    path = load_path(name, options.size)
    for sentence in path.said:
        print(sentence)
    fps = options.fps or path.fps or 30.0
    count = _count(options) or (max(1, round(options.seconds * fps)) if options.seconds else None)
    if count is None and path.keyframes:
        count = max(1, round((path.seconds or 4.0) * fps))
    cameras = path.cameras if count is None else interpolated(path.cameras, count, options.loop or path.loop)
    return cameras, fps


def _lit(target: Target, light: str) -> Target:
    """The medium under another light; InputError for any other model."""
    from nerfvol.medium.lighting import Lighting, load_lighting
    from nerfvol.medium.model import MediumModel

    model = target.model
    if not isinstance(model, MediumModel):
        raise InputError(f"--light is for media, {target.path} is a model of {model.kind}")
    lighting, name = model.lighting, light
    if light not in lighting.lights:
        file, colon, name = light.rpartition(":") if not Path(light).exists() else (light, "", "")
        if not Path(file).is_file():
            known = ", ".join(list(lighting.lights)[:8])
            raise InputError(f"--light {light}: expected one of the run's lights ({known}), or a JSON file of lights")
        lighting = load_lighting(file)
    chosen = lighting.of(name or None)
    return replace(target, model=model.under(Lighting({light: chosen}, lighting.phase, lighting.exposure)))


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
    example="nerfvol render run --path orbit --seconds 4 --out orbit.mp4\n"
    "nerfvol render run --path path.json --frames 240 --out path.webm --compare other_run\n"
    "nerfvol render run --cameras path.json --out frames --aov depth,normal",
    options=RenderOptions,
    arguments=arguments,
    run=run,
    place=30,
)
