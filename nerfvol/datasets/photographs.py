"""Training images for splats: undistorted once into pinhole canvases, as pyramids; and pictures back through a lens.

A rasteriser draws pinholes. So each photograph is resampled once onto the pinhole canvas that holds all its pixels
(bicubic; what it does not show has weight 0), and splats are right in every viewer. What is drawn goes the other way to be
compared with the photograph itself: :func:`through_lens`.

Images are uint8 (height, width, 4), sides padded to multiples of 16; the fourth channel is the weight of the pixel in the
loss: 255 where the photograph shows it, 0 in padding and outside, between for masks and cut pixels.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cameras.canvas import MAX_ANGLE, Canvas, canvas_of, is_pinhole, source_grid
from nerfvol.cameras.warp import padded, reduce, remap
from nerfvol.datasets.averages import composite_average
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.images import UInt8, map_threads
from nerfvol.defaults import WHITE

Float = NDArray[np.float32]
FACTORS = (8, 4, 2, 1)
"""The pyramid's levels: 1 / 8 of the photographs' size first."""
MAX_FACTOR = 64


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One photograph at one level. ``image`` (h, w, 4) uint8 with h, w multiples of 16; ``camera`` a pinhole of that size;
    ``width``, ``height``: the part that is no padding."""

    image: UInt8
    camera: Camera
    width: int
    height: int


class Photographs:
    """The photographs of a dataset as pinhole pictures of any level.

    Full-size canvases of distorted photographs are made at once; levels when they are asked for, and kept until
    :meth:`drop`. Photographs without distortion cost nothing until then, and their full size is the dataset's own memory.

    ``most_bytes`` bounds what is kept next to the dataset's images: what comes when it is full is made again whenever it is
    asked for, the same bits. Views are visited in an order of chance, each once in an epoch: no rule of what to throw out
    would hit more often than keeping those that came first.

    ``second``: another background (3,) in [0, 1], before which each view can be had as well; None: there is none.
    """

    def __init__(
        self,
        dataset: Dataset,
        background: Sequence[float] = WHITE,
        alpha: Literal["background", "mask"] = "background",
        max_angle: float = MAX_ANGLE,
        threads: int | None = None,
        most_bytes: int | None = None,
        second: tuple[float, float, float] | None = None,
    ) -> None:
        """``alpha``: images with transparency are composited over ``background`` (objects), or it is the loss's weight
        (masked photographs). ``max_angle``: radians to each side of the axis, the widest a canvas is. ``most_bytes``: None for
        no bound. ``second``: the second background of composited images.

        Raises:
            InputError: the lens of a view cannot be undone.
        """
        self.names, self.messages = list(dataset.names), []
        self._threads = dataset.threads if threads is None else threads
        self._levels: dict[int, dict[int, TrainingView]] = {}
        canvases = {lens: canvas_of(lens, max_angle) for lens in {c.intrinsics for c in dataset.cameras}}
        self.cameras = [c.through(canvases[c.intrinsics].camera) for c in dataset.cameras]
        grids = {lens: source_grid(canvas, lens) for lens, canvas in canvases.items() if not is_pinhole(lens)}
        self.second = second
        colours = [background] if second is None else [background, second]
        images: list[UInt8] = list(dataset.images) * len(colours)

        def make(key: int) -> UInt8:
            which, i = divmod(key, len(dataset))
            lens, image = dataset.cameras[i].intrinsics, images[i]
            if alpha == "background" and image.shape[2] == 4:
                image = composite_average(image, colours[which], 1)
            if (mask := dataset.mask(i)) is not None:
                own = image[..., 3] if image.shape[2] == 4 else 255
                image = np.concatenate([image[..., :3], np.minimum(mask, own)[..., None]], axis=2)
            return undistorted(image, canvases[lens], *grids[lens]) if lens in grids else image

        self._make_source, self._images, self._most, self._lock = make, images, most_bytes, threading.Lock()
        # Those before the second background come after the others.
        self._sources: list[UInt8 | None] = [None] * len(images)
        self._bytes, self._full = 0, False
        map_threads(lambda key: None if self._full else self._source(key), range(len(images)), self._threads)
        wide = [c.intrinsics for c in dataset.cameras if canvases[c.intrinsics].cropped]
        if wide:
            self.messages.append(
                f"{len(wide)} of {len(dataset)} photographs show more than {math.degrees(max_angle):.0f} degrees to a side "
                "of their axis: training leaves out what is beyond"
            )

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def most_bytes(self) -> int | None:
        """The bound on :attr:`nbytes`; None: there is none."""
        return self._most

    @property
    def nbytes(self) -> int:
        """Bytes of all images held now, next to the dataset's own."""
        held = {id(image): image.nbytes for image in self._sources if image is not None}
        held |= {id(view.image): view.image.nbytes for level in self._levels.values() for view in level.values()}
        return sum(held[which] for which in held.keys() - {id(image) for image in self._images})

    @property
    def held(self) -> set[int]:
        """The factors of which images are held now."""
        return {factor for factor, views in self._levels.items() if views}

    def view(self, i: int, factor: int, second: bool = False) -> TrainingView:
        """View i at 1 / factor of its size, a power of two up to 64, made where it is not kept; ``second``: before the second
        background."""
        check_factor(factor)
        key = i + len(self) * second
        kept = self._levels.setdefault(factor, {}).get(key)
        if kept is not None:
            return kept
        source = self._source(key)
        view = self._make(i, factor, source)
        own = factor == 1 and source is self._sources[key] and source is not self._images[key]
        if (
            view.image is self._sources[key]
            or (own and self._in_place(key, source, view.image))
            or self._room(view.image.nbytes)
        ):
            self._levels[factor][key] = view
        return view

    def level(self, factor: int) -> list[TrainingView]:
        """All views at 1 / factor of their size, before the first background."""
        return map_threads(lambda i: self.view(i, factor), range(len(self)), self._threads)

    def drop(self, factor: int) -> None:
        """Release a level's images; full-size canvases stay, since the others are made from them."""
        for key, view in self._levels.pop(factor, {}).items():
            if view.image is not self._sources[key]:
                self._bytes -= view.image.nbytes

    def _room(self, more: int) -> bool:
        """Whether ``more`` bytes may be kept; they are counted then."""
        with self._lock:
            fits = self._most is None or self._bytes + more <= self._most
            self._bytes += more if fits else 0
            self._full |= not fits
        return fits

    def _source(self, key: int) -> UInt8:
        """A photograph at its full size, what is made of the dataset's image kept where there is room."""
        if (kept := self._sources[key]) is not None:
            return kept
        source = self._make_source(key)
        if source is self._images[key] or self._room(source.nbytes):
            self._sources[key] = source
        return source

    def _in_place(self, key: int, source: UInt8, padded: UInt8) -> bool:
        """Whether the padded copy takes the place of the source that it was made from, and of its bytes."""
        if not self._room(padded.nbytes - source.nbytes):
            return False
        self._sources[key] = padded
        return True

    def _make(self, i: int, factor: int, source: UInt8) -> TrainingView:
        camera = self.cameras[i]
        lens = level_camera(camera.intrinsics, factor)
        width, height = (-(-n // factor) for n in (camera.intrinsics.width, camera.intrinsics.height))
        size = (lens.height, lens.width)
        image = source if factor == 1 and source.shape == (*size, 4) else reduce(source, factor, size)
        return TrainingView(image, camera.through(lens), width, height)


def check_factor(factor: int) -> None:
    """ValueError unless the factor is a power of two up to 64."""
    if factor not in (1, 2, 4, 8, 16, 32, MAX_FACTOR):
        raise ValueError(f"a level's factor must be a power of two up to {MAX_FACTOR}, got {factor!r}")


def level_camera(canvas: Intrinsics, factor: int) -> Intrinsics:
    """The pinhole of a canvas averaged over factor x factor pixels, with its sides padded to multiples of 16."""
    width, height = (padded(-(-n // factor)) for n in (canvas.width, canvas.height))
    return replace(
        canvas, width=width, height=height, fx=canvas.fx / factor, fy=canvas.fy / factor,
        cx=canvas.cx / factor, cy=canvas.cy / factor,
    )  # fmt: skip


def undistorted(image: UInt8, canvas: Canvas, grid: Float, step: int) -> UInt8:
    """The photograph (h, w, 3 or 4) on its canvas, padded: (height, width, 4), the fourth 0 where it shows nothing."""
    camera = canvas.camera
    used = (camera.height, camera.width)
    return remap(image, grid, step, used, (padded(used[0]), padded(used[1])))


def estimate_bytes(cameras: Sequence[Camera], factors: Sequence[int] = FACTORS, max_angle: float = MAX_ANGLE) -> int:
    """Bytes that :class:`Photographs` of these cameras would hold, next to the dataset's images, once all views of the levels
    ``factors`` are made."""
    total = 0
    for camera in cameras:
        canvas = canvas_of(camera.intrinsics, max_angle).camera
        for factor in {*factors, 1}:
            lens = level_camera(canvas, factor)
            total += 4 * lens.width * lens.height
    return total
