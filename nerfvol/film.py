"""A camera path drawn to pictures in a folder or to videos, frame by frame."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.paths import cameras_document
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.files import pictures
from nerfvol.files.atomic import write_json
from nerfvol.kernels.state import OUTPUTS
from nerfvol.models import Model
from nerfvol.views import depth_range, surface_depth, unit_normal

Float = NDArray[np.float32]


@dataclass(frozen=True)
class Film:
    """What is drawn: a model along cameras, in colour and in ``aov`` (depth, median_depth, opacity, normal)."""

    model: Model
    cameras: Sequence[Camera]
    background: Sequence[float]
    aov: Sequence[str] = ()
    early_stop_eps: float = DEFAULT_EARLY_STOP
    lod: float = DEFAULT_LOD

    def frames(self) -> Iterator[dict[str, Float]]:
        """The pictures in order, float32 by name: rgb and normal (H, W, 3), others (H, W).

        Depth is the mean distance of what a pixel sees, scene units; normals have unit length. The opacity that it takes to
        show what was asked for is there too.
        """
        wanted = {"rgb"}
        for name in self.aov:
            wanted |= {"depth": {"depth", "opacity"}, "normal": {"normal", "opacity"}}.get(name, {name, "opacity"})
        outputs = [name for name in OUTPUTS if name in wanted]
        for index, camera in enumerate(self.cameras):
            if sys.stderr.isatty():
                print(f"\rview {index + 1}/{len(self.cameras)}", end="", file=sys.stderr, flush=True)
            image = self.model.render(camera, self.background, outputs, self.early_stop_eps, self.lod)
            if "depth" in self.aov:
                image["depth"] = surface_depth(image)
            if "normal" in self.aov:
                image["normal"] = unit_normal(image)
            yield image
        if sys.stderr.isatty():
            print("\r", end="", file=sys.stderr)


def write_videos(path: Path, film: Film, fps: int) -> list[Path]:
    """One video of the colours at ``path`` and one for each AOV next to it; returns their paths."""
    depths = depth_range(film.model, film.cameras)
    paths = {"rgb": path, **{name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in film.aov}}
    with contextlib.ExitStack() as stack:
        writers = {name: stack.enter_context(pictures.open_video(p, fps)) for name, p in paths.items()}
        for image in film.frames():
            for name, writer in writers.items():
                shown = displayable(name, image, depths)
                writer.add(shown if shown.ndim == 3 else np.repeat(shown[..., None], 3, axis=2))
    return list(paths.values())


def displayable(name: str, image: Mapping[str, Float], depths: tuple[float, float]) -> Float:
    """The output ``name`` of ``image`` as values in [0, 1] that a person can read, (H, W) or (H, W, 3).

    ``image``: as of :meth:`Film.frames`; ``depths``: nearest and farthest, scene units.
    """
    if name in ("depth", "median_depth"):
        return pictures.depth_to_grey(image[name], image["opacity"], *depths)
    if name == "normal":
        return pictures.normal_to_rgb(image[name], image["opacity"])
    return image[name]


def write_pictures(out: Path, film: Film, suffix: Literal["png", "exr"] = "png") -> list[Path]:
    """One picture a view in the folder ``out`` (PNG with one more for each AOV, or EXR with everything), and cameras.json."""
    depths = depth_range(film.model, film.cameras)
    digits = max(4, len(str(len(film.cameras) - 1)))
    names = [f"{index:0{digits}d}" for index in range(len(film.cameras))]
    for name, image in zip(names, film.frames(), strict=True):
        if suffix == "exr":
            channels = {"RGB": pictures.srgb_to_linear(image["rgb"])}
            exr_names = {"opacity": "A", "depth": "Z", "median_depth": "median.Z", "normal": "N"}
            channels.update({exr_names[aov]: image[aov] for aov in film.aov})
            pictures.write_exr(out / f"{name}.exr", channels)
            continue
        pictures.write_png(out / f"{name}.png", image["rgb"])
        for aov in film.aov:
            pictures.write_png(out / f"{name}_{aov}.png", displayable(aov, image, depths))
    document = cameras_document(film.cameras, [f"{name}.{suffix}" for name in names])
    if suffix == "png" and {"depth", "median_depth"} & set(film.aov):
        document["depth_range"] = depths
    write_json(out / "cameras.json", document)
    return [out]
