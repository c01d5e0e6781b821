"""A camera path drawn to pictures in a folder or to videos, frame by frame."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.paths import cameras_document
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.files import pictures
from nerfvol.files.atomic import write_json
from nerfvol.kernels.state import OUTPUTS
from nerfvol.models import Model
from nerfvol.views import depth_range, surface_depth, unit_normal

Float = NDArray[np.float32]


@dataclass(frozen=True)
class Film:
    """What is drawn: a model along cameras, in ``output`` (rgb, depth, median_depth, opacity, normal) and beside it in ``aov``.

    ``compare``: a second model, drawn to the right of the first.
    """

    model: Model
    cameras: Sequence[Camera]
    background: Sequence[float]
    aov: Sequence[str] = ()
    early_stop_eps: float = DEFAULT_EARLY_STOP
    lod: float = DEFAULT_LOD
    output: str = "rgb"
    compare: Model | None = None

    def together(self) -> Iterator[tuple[dict[str, Float], ...]]:
        """:meth:`frames` of the model and, where there is one, of the one that it is compared with."""
        films = [self] if self.compare is None else [self, replace(self, model=self.compare, compare=None)]
        return zip(*(film.frames() for film in films), strict=True)

    def shown(self, name: str, images: Sequence[Mapping[str, Float]], depths: tuple[float, float]) -> Float:
        """The output ``name`` of each of ``images``, side by side (:func:`displayable`)."""
        panels = [displayable(name, image, depths) for image in images]
        return panels[0] if len(panels) == 1 else pictures.side_by_side(panels)

    def frames(self) -> Iterator[dict[str, Float]]:
        """The pictures in order, float32 by name: rgb and normal (H, W, 3), others (H, W).

        Depth is the mean distance of what a pixel sees, scene units; normals have unit length. The opacity that it takes to
        show what was asked for is there too.
        """
        wanted = {"rgb"}
        for name in (self.output, *self.aov):
            wanted |= {"depth": {"depth", "opacity"}, "normal": {"normal", "opacity"}}.get(
                name, {name} if name == "rgb" else {name, "opacity"}
            )
        outputs = [name for name in OUTPUTS if name in wanted]
        for index, camera in enumerate(self.cameras):
            if sys.stderr.isatty():
                print(f"\rview {index + 1}/{len(self.cameras)}", end="", file=sys.stderr, flush=True)
            image = self.model.render(camera, self.background, outputs, self.early_stop_eps, self.lod)
            if "depth" in (self.output, *self.aov):
                image["depth"] = surface_depth(image)
            if "normal" in (self.output, *self.aov):
                image["normal"] = unit_normal(image)
            yield image
        if sys.stderr.isatty():
            print("\r", end="", file=sys.stderr)


def write_videos(path: Path, film: Film, fps: float) -> list[Path]:
    """One video of what the film shows at ``path`` and one for each AOV next to it; returns their paths.

    Raises:
        InputError: cameras of several sizes (:func:`of_one_size` makes them one), or a path that cannot be written.
    """
    if len(sizes := {(c.intrinsics.width, c.intrinsics.height) for c in film.cameras}) > 1:
        listed = " and ".join(f"{w}x{h}" for w, h in sorted(sizes)[:2])
        raise InputError(f"the frames of a video have one size, these cameras have {listed}: give --size WxH")
    depths = depth_range(film.model, film.cameras)
    paths = {film.output: path, **{name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in film.aov}}
    with contextlib.ExitStack() as stack:
        writers = {name: stack.enter_context(pictures.open_video(p, fps)) for name, p in paths.items()}
        for images in film.together():
            for name, writer in writers.items():
                shown = film.shown(name, images, depths)
                writer.add(shown if shown.ndim == 3 else np.repeat(shown[..., None], 3, axis=2))
    return list(paths.values())


def of_one_size(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras with the first one's size; each keeps its field of view across the width."""
    first = cameras[0].intrinsics
    return [camera.resized(first.width, first.height) for camera in cameras]


def displayable(name: str, image: Mapping[str, Float], depths: tuple[float, float]) -> Float:
    """The output ``name`` of ``image`` as values in [0, 1] that a person can read, (H, W) or (H, W, 3).

    ``image``: as of :meth:`Film.frames`; ``depths``: nearest and farthest, scene units.
    """
    if name in ("depth", "median_depth"):
        return pictures.depth_to_grey(image[name], image["opacity"], *depths)
    if name == "normal":
        return pictures.normal_to_rgb(image[name], image["opacity"])
    return image[name]


def write_picture(path: Path, film: Film) -> list[Path]:
    """The one view of the film as a PNG at ``path``, and its AOVs next to it; returns their paths.

    Raises:
        InputError: there are more views, or a path that cannot be written.
    """
    if len(film.cameras) != 1:
        raise InputError(
            f"{path} is one picture and there are {len(film.cameras)} views: give --out a folder or a video"
        )
    depths = depth_range(film.model, film.cameras)
    paths = {film.output: path, **{name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in film.aov}}
    for images in film.together():
        for name, place in paths.items():
            pictures.write_png(place, film.shown(name, images, depths))
    return list(paths.values())


def write_pictures(out: Path, film: Film, suffix: Literal["png", "exr"] = "png") -> list[Path]:
    """One picture a view in the folder ``out`` (PNG with one more for each AOV, or EXR with everything), and cameras.json."""
    depths = depth_range(film.model, film.cameras)
    digits = max(4, len(str(len(film.cameras) - 1)))
    names = [f"{index:0{digits}d}" for index in range(len(film.cameras))]
    if suffix == "exr" and film.compare is not None:
        raise InputError("EXR pictures hold one model: compare in PNG or a video")
    for name, images in zip(names, film.together(), strict=True):
        if suffix == "exr":
            image = images[0]
            channels = {"RGB": pictures.srgb_to_linear(image["rgb"])}
            exr_names = {"opacity": "A", "depth": "Z", "median_depth": "median.Z", "normal": "N"}
            channels.update({exr_names[aov]: image[aov] for aov in film.aov})
            pictures.write_exr(out / f"{name}.exr", channels)
            continue
        pictures.write_png(out / f"{name}.png", film.shown(film.output, images, depths))
        for aov in film.aov:
            pictures.write_png(out / f"{name}_{aov}.png", film.shown(aov, images, depths))
    document = cameras_document(film.cameras, [f"{name}.{suffix}" for name in names])
    if suffix == "png" and {"depth", "median_depth"} & {film.output, *film.aov}:
        document["depth_range"] = depths
    write_json(out / "cameras.json", document)
    return [out]
