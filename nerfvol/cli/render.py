"""``nerfvol render``: pictures and videos of a model along a camera path."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.paths import cameras_document, load_cameras, orbit_cameras
from nerfvol.cli.target import find_orbit, resolve_background
from nerfvol.config.values import Colour, Count, Size, aov_names, fraction, pixels
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.files import pictures, run_folder
from nerfvol.files.atomic import ensure_writable_folder, write_json
from nerfvol.kernels.state import OUTPUTS
from nerfvol.octree.io import load_octree
from nerfvol.octree.tree import Octree
from nerfvol.views import Float, depth_range, render_image, surface_depth, unit_normal


def run_render(options: RenderOptions) -> int:
    """``nerfvol render``: writes what the options ask for and prints where it is."""
    out = Path(options.out)
    is_video = out.suffix.lower() == ".mp4"
    if (options.cameras is None) == (options.orbit is None):
        raise InputError("nerfvol render needs either --cameras FILE.json or --orbit N")
    if is_video and options.format == "exr":
        raise InputError("--format exr writes pictures: give --out a folder, not a video file")
    octree, metadata = load_octree(run_folder.octree_path(options.target))
    background = resolve_background(options.background, options.target, metadata)
    if options.cameras is not None:
        cameras = load_cameras(options.cameras, options.size)
    else:
        assert options.orbit is not None
        cameras = orbit_cameras(options.orbit, find_orbit(options.target, octree, metadata), options.size)
    ensure_writable_folder(out.parent if is_video else out)
    started = time.perf_counter()
    frames = _frames(octree, cameras, background, options)
    if is_video:
        written = write_videos(out, frames, options.aov, options.fps, depth_range(octree, cameras))
    else:
        written = _write_pictures(out, frames, cameras, octree, options)
    seconds = time.perf_counter() - started
    where = ", ".join(map(str, written))
    print(f"{len(cameras)} views in {seconds:.1f} s ({len(cameras) / seconds:.1f} a second): {where}")
    return 0


def _frames(
    octree: Octree, cameras: Sequence[Camera], background: Sequence[float], options: RenderOptions
) -> Iterator[dict[str, Float]]:
    wanted = {"rgb"}
    for name in options.aov:
        wanted |= {"depth": {"depth", "opacity"}, "normal": {"normal", "opacity"}}.get(name, {name, "opacity"})
    outputs = [name for name in OUTPUTS if name in wanted]
    for index, camera in enumerate(cameras):
        if sys.stderr.isatty():
            print(f"\rview {index + 1}/{len(cameras)}", end="", file=sys.stderr, flush=True)
        image = render_image(octree, camera, background, options.early_stop_eps, outputs, options.lod)
        if "depth" in options.aov:
            image["depth"] = surface_depth(image)
        if "normal" in options.aov:
            image["normal"] = unit_normal(image)
        yield image
    if sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)


def write_videos(
    path: Path, frames: Iterator[dict[str, Float]], aovs: Sequence[str], fps: int, depths: tuple[float, float]
) -> list[Path]:
    """One video of the colours at ``path`` and one for each AOV beside it; returns their paths."""
    paths = {"rgb": path, **{name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in aovs}}
    with contextlib.ExitStack() as stack:
        writers = {name: stack.enter_context(pictures.open_video(p, fps)) for name, p in paths.items()}
        for image in frames:
            for name, writer in writers.items():
                shown = _displayable(name, image, depths)
                writer.add(shown if shown.ndim == 3 else np.repeat(shown[..., None], 3, axis=2))
    return list(paths.values())


def _displayable(name: str, image: Mapping[str, Float], depths: tuple[float, float]) -> Float:
    """An output as values in [0, 1] that a person can read."""
    if name in ("depth", "median_depth"):
        return pictures.depth_to_grey(image[name], image["opacity"], *depths)
    if name == "normal":
        return pictures.normal_to_rgb(image[name], image["opacity"])
    return image[name]


def _write_pictures(
    out: Path, frames: Iterator[dict[str, Float]], cameras: Sequence[Camera], octree: Octree, options: RenderOptions
) -> list[Path]:
    depths = depth_range(octree, cameras)
    digits = max(4, len(str(len(cameras) - 1)))
    names = [f"{index:0{digits}d}" for index in range(len(cameras))]
    for name, image in zip(names, frames, strict=True):
        if options.format == "exr":
            channels = {"RGB": pictures.srgb_to_linear(image["rgb"])}
            exr_names = {"opacity": "A", "depth": "Z", "median_depth": "median.Z", "normal": "N"}
            channels.update({exr_names[aov]: image[aov] for aov in options.aov})
            pictures.write_exr(out / f"{name}.exr", channels)
            continue
        pictures.write_png(out / f"{name}.png", image["rgb"])
        for aov in options.aov:
            pictures.write_png(out / f"{name}_{aov}.png", _displayable(aov, image, depths))
    document = cameras_document(cameras, [f"{name}.{options.format}" for name in names])
    if options.format == "png" and {"depth", "median_depth"} & set(options.aov):
        document["depth_range"] = depths
    write_json(out / "cameras.json", document)
    return [out]


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
    threads: int = 0
