"""A camera path drawn to pictures in a folder or to videos, frame by frame."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.paths import cameras_document
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.files import pictures
from nerfvol.files.atomic import read_json, remove_leftovers, write_bytes, write_json
from nerfvol.kernels.state import OUTPUTS
from nerfvol.models import Model
from nerfvol.views import depth_range, surface_depth, unit_normal

Float = NDArray[np.float32]
Suffix = Literal["png", "exr"]


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

    def drawn(self, camera: Camera) -> tuple[dict[str, Float], ...]:
        """One view, of the model and, where there is one, of the model that it is compared with; by the names of outputs.

        float32, rgb and normal (H, W, 3), others (H, W). Depth is the mean distance of what a pixel sees, scene units; normals
        have unit length. The opacity that it takes to show what was asked for is there too.
        """
        models = [self.model] if self.compare is None else [self.model, self.compare]
        return tuple(self._drawn(model, camera) for model in models)

    def _drawn(self, model: Model, camera: Camera) -> dict[str, Float]:
        wanted = {"rgb"}
        for name in (self.output, *self.aov):
            wanted |= {"depth": {"depth", "opacity"}, "normal": {"normal", "opacity"}}.get(
                name, {name} if name == "rgb" else {name, "opacity"}
            )
        outputs = [name for name in OUTPUTS if name in wanted]
        image = model.render(camera, self.background, outputs, self.early_stop_eps, self.lod)
        if "depth" in (self.output, *self.aov):
            image["depth"] = surface_depth(image)
        if "normal" in (self.output, *self.aov):
            image["normal"] = unit_normal(image)
        return image

    def shown(self, name: str, images: Sequence[Mapping[str, Float]], depths: tuple[float, float]) -> Float:
        """The output ``name`` of each of ``images``, side by side (:func:`displayable`)."""
        panels = [displayable(name, image, depths) for image in images]
        return panels[0] if len(panels) == 1 else pictures.side_by_side(panels)

    def files(self, camera: Camera, depths: tuple[float, float], suffix: Suffix) -> dict[str, bytes]:
        """The files of one view by the end of their names: PNG with one more for each AOV, or EXR with everything.

        ``depths``: nearest and farthest that pictures of depth show, scene units.
        """
        images = self.drawn(camera)
        if suffix == "exr":
            image = images[0]
            channels = {"RGB": pictures.srgb_to_linear(image["rgb"])}
            exr_names = {"opacity": "A", "depth": "Z", "median_depth": "median.Z", "normal": "N"}
            channels.update({exr_names[aov]: image[aov] for aov in self.aov})
            return {".exr": pictures.encode_exr(channels)}
        names = {".png": self.output, **{f"_{aov}.png": aov for aov in self.aov}}
        return {end: pictures.encode_png(self.shown(name, images, depths)) for end, name in names.items()}

    def video_frames(self, camera: Camera, depths: tuple[float, float]) -> dict[str, NDArray[np.uint8]]:
        """What videos show of one view: (H, W, 3) by the names of output and AOVs."""
        images = self.drawn(camera)
        out = {}
        for name in (self.output, *self.aov):
            shown = pictures.to_uint8(self.shown(name, images, depths))
            out[name] = shown if shown.ndim == 3 else np.repeat(shown[..., None], 3, axis=2)
        return out

    def depths(self) -> tuple[float, float]:
        """What pictures of depth are scaled by, the same for all views; (0, 1) where there is none."""
        return depth_range(self.model, self.cameras) if self.shows_depth() else (0.0, 1.0)

    def shows_depth(self) -> bool:
        """Whether a picture of distances is among what is drawn."""
        return not {"depth", "median_depth"}.isdisjoint((self.output, *self.aov))


T = TypeVar("T")
Each = Callable[[Callable[[Camera], T], Sequence[Camera]], Iterator[T]]
"""How views are drawn: a function of a camera, the cameras -> its results in order. Here one after the other; workers of a
cluster do the same (nerfvol.cluster.frames)."""


def one_by_one(draw: Callable[[Camera], T], cameras: Sequence[Camera]) -> Iterator[T]:
    """The views in turn."""
    return with_progress(map(draw, cameras), len(cameras))


def with_progress(results: Iterator[T], n: int) -> Iterator[T]:
    """``results``, whose number stands on the terminal with the time that is left, if there is a terminal."""
    started = time.perf_counter()
    for done, result in enumerate(results, 1):
        if sys.stderr.isatty():
            left = (time.perf_counter() - started) / done * (n - done)
            print(f"\rview {done}/{n}, {left:.0f} s left ", end="", file=sys.stderr, flush=True)
        yield result
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)


def write_videos(path: Path, film: Film, fps: float, each: Each | None = None) -> list[Path]:
    """One video of what the film shows at ``path`` and one for each AOV next to it; returns their paths.

    Raises:
        InputError: cameras of several sizes (:func:`of_one_size` makes them one), or a path that cannot be written.
    """
    if len(sizes := {(c.intrinsics.width, c.intrinsics.height) for c in film.cameras}) > 1:
        listed = " and ".join(f"{w}x{h}" for w, h in sorted(sizes)[:2])
        raise InputError(f"the frames of a video have one size, these cameras have {listed}: give --size WxH")
    depths = film.depths()
    paths = {film.output: path, **{name: path.with_name(f"{path.stem}_{name}{path.suffix}") for name in film.aov}}
    with contextlib.ExitStack() as stack:
        writers = {name: stack.enter_context(pictures.open_video(p, fps)) for name, p in paths.items()}
        for frames in (each or one_by_one)(lambda camera: film.video_frames(camera, depths), film.cameras):
            for name, writer in writers.items():
                writer.add(frames[name])
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
    depths = film.depths()
    written = []
    for end, data in film.files(film.cameras[0], depths, "png").items():
        written.append(path.with_name(path.stem + end[:-4] + path.suffix))
        write_bytes(written[-1], data)
    return written


@dataclass(frozen=True)
class Chosen:
    """Which of a path's views are drawn: first, first + step, ... last; those whose files are there already are left."""

    first: int
    last: int
    step: int = 1


def write_pictures(
    out: Path, film: Film, suffix: Suffix = "png", chosen: Chosen | None = None, each: Each | None = None, of: str = ""
) -> int:
    """Pictures of views in the folder ``out`` (:meth:`Film.files`), and cameras.json; returns how many views were drawn.

    ``chosen``: draws these alone and leaves what is whole already, so that many processes can share a folder, and a killed one
    goes on; None: all views, over what is there. ``of``: names what is drawn, a hash of model and settings; it is kept beside
    the pictures, and a folder of another film is refused.

    Raises:
        InputError: views that the path does not have, pictures of another film, or a path that cannot be written.
    """
    if suffix == "exr" and film.compare is not None:
        raise InputError("EXR pictures hold one model: compare in PNG or a video")
    remove_leftovers(out)
    digits = max(4, len(str(len(film.cameras) - 1)))
    names = [f"{index:0{digits}d}" for index in range(len(film.cameras))]
    wanted = list(range(len(names)))
    ends = [".exr"] if suffix == "exr" else [".png", *(f"_{aov}.png" for aov in film.aov)]
    if chosen is None:
        (out / RECORD).unlink(missing_ok=True)  # until all are of this film
    else:
        if chosen.last >= len(names):
            raise InputError(f"--frames {chosen.first}-{chosen.last}: the path has the frames 0-{len(names) - 1}")
        ours = _claim(out, of)
        wanted = [k for k in wanted[chosen.first : chosen.last + 1 : chosen.step]
                  if not (ours and all((out / f"{names[k]}{end}").is_file() for end in ends))]  # fmt: skip
    depths = film.depths()
    document = cameras_document(film.cameras, [f"{name}.{suffix}" for name in names])
    if suffix == "png" and film.shows_depth():
        document["depth_range"] = depths
    write_json(out / "cameras.json", document)
    made = (each or one_by_one)(lambda camera: film.files(camera, depths, suffix), [film.cameras[k] for k in wanted])
    for k, files in zip(wanted, made, strict=True):
        for end, data in files.items():
            write_bytes(out / f"{names[k]}{end}", data)
    if chosen is None:
        _claim(out, of)
    return len(wanted)


RECORD = "film.json"
"""What the pictures of a folder are of."""


def _claim(out: Path, of: str) -> bool:
    """Notes in ``out`` what its pictures are of; whether they were so before. InputError where they are of something else."""
    path = out / RECORD
    if not path.is_file():
        write_json(path, {"of": of})
        return False
    found = read_json(path)
    if found != {"of": of}:
        what = f"{found.get('of', '?')!s:.12}" if isinstance(found, dict) else "?"
        raise InputError(
            f"{out} holds pictures of another model, path or drawn otherwise ({RECORD} says {what}, this is {of:.12}): "
            "choose another --out"
        )
    return True
