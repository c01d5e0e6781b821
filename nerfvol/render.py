"""Pictures of an octree: one view at a time, to PNG, EXR or MP4."""

from __future__ import annotations

import contextlib
import functools
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol import pictures, runs
from nerfvol.camera_paths import cameras_document, default_orbit, describe_orbit, load_cameras, orbit_cameras
from nerfvol.cameras import Camera, Intrinsics
from nerfvol.errors import InputError
from nerfvol.files import ensure_writable_folder, write_json
from nerfvol.kernels import ops
from nerfvol.kernels.state import in_squares
from nerfvol.octree import Octree
from nerfvol.octree_io import load_octree
from nerfvol.options import RenderOptions
from nerfvol.settings import DEFAULT_EARLY_STOP, DEFAULT_LOD, WHITE

Float = NDArray[np.float32]


def render_image(
    octree: Octree,
    camera: Camera,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = ops.OUTPUTS,
    lod: float = DEFAULT_LOD,
) -> dict[str, Float]:
    """One view: float32 arrays (H, W, 3) or (H, W) for the names in ``outputs`` (see ops.render_rays).

    ``rgb`` is not clipped. A node of the octree that is smaller than ``lod`` pixels in the middle of the picture stands in
    for its leaves; 0: none does. ValueError where ``lod`` is negative or not finite.
    """
    if not 0 <= lod < np.inf:
        raise ValueError(f"lod must be a number of pixels, 0 or more and finite, got {lod}")
    lens = camera.intrinsics
    view = ops.View(_directions(lens), camera.c2w, lens.height, lens.width)
    return ops.render_view(octree, view, background, early_stop_eps, outputs, lod / max(lens.fx, lens.fy))


@functools.lru_cache(maxsize=1)
def _directions(lens: Intrinsics) -> Float:
    """Unit directions in camera axes, as :class:`ops.View` has them. Kept for a path."""
    return in_squares(lens.directions())


def surface_depth(image: Mapping[str, Float]) -> Float:
    """Mean distance (H, W) of what a pixel sees, sum_i w_i t_i / opacity; 0 where the opacity is below 1e-3."""
    opacity = image["opacity"]
    return np.where(opacity > 1e-3, image["depth"] / np.maximum(opacity, 1e-3), 0.0).astype(np.float32)


def unit_normal(image: Mapping[str, Float]) -> Float:
    """The mean normal (H, W, 3) at unit length; zero where there is none."""
    normal = image["normal"]
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)


def depth_range(octree: Octree, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Nearest and farthest distance that a few of ``cameras`` see, to scale pictures of depth by.

    The 1st and 99th percentile of small renders, a tenth of their distance farther apart: single floaters do not count.
    Where nothing is seen, the distances at which leaves could be.
    """
    seen = []
    for camera in cameras[:: max(1, len(cameras) // 4)]:
        width = min(camera.intrinsics.width, 96)
        small = camera.resized(width, max(1, round(camera.intrinsics.height * width / camera.intrinsics.width)))
        image = render_image(octree, small, outputs=("depth", "opacity"))
        seen.append(surface_depth(image)[image["opacity"] >= 0.5])
    depths = np.concatenate(seen)
    if not len(depths):
        reach = octree.size * 3**0.5
        distances = [float(np.linalg.norm(camera.position - octree.origin - octree.size / 2)) for camera in cameras]
        return max(min(distances) - reach / 2, 0.0), max(distances) + reach / 2
    near, far = (float(value) for value in np.percentile(depths, (1, 99)))
    return max(near - 0.1 * (far - near), 0.0), far + 0.1 * (far - near)


# ------------------------------------------------------------------ the command
def run_render(options: RenderOptions) -> int:
    """``nerfvol render``: writes what the options ask for and prints where it is."""
    out = Path(options.out)
    is_video = out.suffix.lower() == ".mp4"
    if (options.cameras is None) == (options.orbit is None):
        raise InputError("nerfvol render needs either --cameras FILE.json or --orbit N")
    if is_video and options.format == "exr":
        raise InputError("--format exr writes pictures: give --out a folder, not a video file")
    octree, metadata = load_octree(runs.octree_path(options.target))
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


def resolve_background(given: Sequence[float] | None, target: str, metadata: Mapping[str, Any]) -> tuple[float, ...]:
    """The background to render on: as given, else the run's, else the octree file's, else white."""
    for candidate in (given, metadata.get("background"), runs.run_settings(target).get("background")):
        if candidate is not None:
            from nerfvol.config import Colour, coerce

            return coerce(candidate, Colour, "background")
    return WHITE


def find_orbit(target: str, octree: Octree, metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """The orbit stored with the octree, else that of the run's training cameras, else one that shows the octree."""
    stored = metadata.get("orbit")
    if isinstance(stored, dict) and {"center", "radius", "elevation_deg"} <= stored.keys():
        return stored
    data = runs.run_settings(target).get("data")
    if data and Path(data).exists():
        from nerfvol.datasets import load_dataset

        dataset = load_dataset(data, "train")
        return describe_orbit(dataset.cameras, dataset.scene.aabb)
    size = octree.leaf_sizes()[:, None]
    center = octree.leaf_centers()
    return default_orbit([(center - size / 2).min(axis=0), (center + size / 2).max(axis=0)])


def _frames(
    octree: Octree, cameras: Sequence[Camera], background: Sequence[float], options: RenderOptions
) -> Iterator[dict[str, Float]]:
    wanted = {"rgb"}
    for name in options.aov:
        wanted |= {"depth": {"depth", "opacity"}, "normal": {"normal", "opacity"}}.get(name, {name, "opacity"})
    outputs = [name for name in ops.OUTPUTS if name in wanted]
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
