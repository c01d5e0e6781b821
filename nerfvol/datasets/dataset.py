"""What every loader returns: cameras, compact images, where the scene is, and what there was to say about the files."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.averages import composite, composite_average, mask_average, masked_average
from nerfvol.datasets.images import UInt8, map_threads
from nerfvol.datasets.points import ModelPoints
from nerfvol.datasets.store import ImageStore
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds

if TYPE_CHECKING:
    from nerfvol.datasets.frame import Frame

Made = TypeVar("Made")

NEAR_SHARE = 0.1
"""Of the median distance between cameras and the scene's middle: what counts as right before a lens."""


@dataclass(eq=False)
class Dataset:
    """Posed images of one split.

    ``images``: uint8 arrays, (h, w, 3) or (h, w, 4) with straight alpha, as large as their camera's intrinsics say; an
    ImageStore where they came from files.
    ``names``: one a view, unique, fit for a file name. ``source``: the file the poses came from.
    ``messages``: sentences a person should see (frames left out, how the split was made, how the bounds were found).
    ``threads``: that decode and average; one for every core by default. ``read_points``: see :attr:`points`.
    ``masks``: uint8 (h, w) a view, 255 where its pixels count, 0 where they are not to be looked at, between where averaging
    mixed both; None for a view that counts whole, and for all of them.
    ``backdrop``: the RGB in [0, 1] that opaque pictures of an object have behind it. ``kind``: one of kinds.KINDS.
    ``frame``: the frame that cameras, bounds and points are in; None: scene units.

    dataclasses.replace makes a dataset of other cameras, images, bounds; what is not replaced is shared, the store of images
    too.
    """

    cameras: list[Camera]
    images: Sequence[UInt8]
    names: list[str]
    scene: SceneBounds
    source: str
    messages: list[str] = field(default_factory=list)
    threads: int | None = None
    read_points: Callable[[], ModelPoints] | None = None
    masks: Sequence[UInt8 | None] | None = None
    backdrop: tuple[float, float, float] | None = None
    kind: str = ""
    frame: Frame | None = None

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def nbytes(self) -> int:
        """Bytes the images hold; 0 while they are released."""
        held = {id(mask): mask.nbytes for mask in self.masks or () if mask is not None}
        images = self.images.nbytes if isinstance(self.images, ImageStore) else sum(i.nbytes for i in self.images)
        return images + sum(held.values()) if images else 0

    def mask(self, i: int) -> UInt8 | None:
        """Which pixels of view i count, uint8 (h, w); None: all."""
        return None if self.masks is None else self.masks[i]

    @property
    def can_reload(self) -> bool:
        """Whether the images came from files, so that :meth:`release` does something."""
        return isinstance(self.images, ImageStore)

    @functools.cached_property
    def points(self) -> ModelPoints | None:
        """The points that were found with the poses, read when first asked for; None where the format has none.

        Raises:
            InputError: their file is damaged.
        """
        return None if self.read_points is None else self.read_points()

    def release(self) -> None:
        """Give up the images' memory, where they can be read again: whoever asks for one of them next does so."""
        if isinstance(self.images, ImageStore):
            self.images.release()

    def evenly(self, most: int) -> Dataset:
        """At most ``most`` of the views, evenly chosen, the first and the last among them; the same images."""
        return self if len(self) <= most else self.chosen(evenly(len(self), most))

    def chosen(self, views: Sequence[int]) -> Dataset:
        """These views alone; the same images. All of them in order: the dataset itself."""
        if list(views) == list(range(len(self))):
            return self
        cameras, images, names = ([column[i] for i in views] for column in (self.cameras, self.images, self.names))
        masks = None if self.masks is None else [self.masks[i] for i in views]
        return replace(self, cameras=cameras, images=images, names=names, masks=masks)

    def smaller(self, k: int, background: Sequence[float]) -> Dataset:
        """All views area-averaged over k x k pixels, over a background (3,) in [0, 1]; InputError where nothing is left."""
        cameras = [camera.scaled(k) for camera in self.cameras]
        return replace(self, cameras=cameras, images=self.pyramid(background, k), masks=self.weights(k))

    def middles(self, size: int) -> Dataset:
        """The middle of all views, at most size x size pixels of each; the images' memory is shared."""
        cameras, images, masks = [], [], []
        for i, (camera, image) in enumerate(zip(self.cameras, self.images, strict=True)):
            top, left = (max(0, (full - size) // 2) for full in image.shape[:2])
            part = image[top : top + size, left : left + size]
            lens = camera.intrinsics.cropped(left, top, part.shape[1], part.shape[0])
            cameras.append(camera.through(lens))
            images.append(part)
            mask = self.mask(i)
            masks.append(None if mask is None else mask[top : top + size, left : left + size])
        return replace(self, cameras=cameras, images=images, masks=None if self.masks is None else masks)

    def before_a_lens(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) are right before a camera, (n,) bool: what is there is seen by no other and would only explain
        that one picture. None in scenes without a background of their own, whose cameras are outside.

        ``points`` are in scene units; right before is within NEAR_SHARE of the cameras' median distance to the middle.
        """
        hidden = np.zeros(len(points), dtype=bool)
        if not self.scene.is_unbounded:
            return hidden
        cameras = np.stack([camera.position for camera in self.cameras])
        near = NEAR_SHARE * np.median(np.linalg.norm(cameras - self.scene.center, axis=1))
        for camera in cameras:
            hidden |= ((points - camera) ** 2).sum(1) <= near**2
        return hidden

    def composited(self, i: int, background: Sequence[float]) -> NDArray[np.float32]:
        """Image i over a background (3,) in [0, 1]: float32 (h, w, 3) in [0, 1]."""
        return composite(self.images[i], background)

    @overload
    def pyramid(self, background: Sequence[float], k: int) -> list[UInt8]: ...
    @overload
    def pyramid(self, background: Sequence[float], k: int, then: Callable[[UInt8], Made]) -> list[Made]: ...
    def pyramid(
        self, background: Sequence[float], k: int, then: Callable[[UInt8], Made] | None = None
    ) -> list[UInt8] | list[Made]:
        """Every image over a background (3,) in [0, 1], area-averaged over k x k pixels: uint8 (h // k, w // k, 3).

        Their cameras are ``camera.scaled(k)``. Opaque images at k = 1 are returned themselves, not copied. ``then`` turns
        each image into what is kept of it, so that the whole level is never in memory at once.

        Raises:
            InputError: k is not between 1 and 256.
        """
        if then is None:
            return self.before_each([background], k, lambda pictures: pictures[0])
        return self.before_each([background], k, lambda pictures: then(pictures[0]))

    def before_each(
        self, backgrounds: Sequence[Sequence[float]], k: int, then: Callable[[list[UInt8]], Made]
    ) -> list[Made]:
        """What ``then`` makes of every image over each of the ``backgrounds``, averaged as by :meth:`pyramid`, which raises the
        same: of one image at a time."""
        if not 1 <= k <= 256:
            raise InputError(f"the pyramid's factor must be an integer between 1 and 256, got {k}")

        def make(i: int) -> Made:
            image, mask = self.images[i], self.mask(i)
            if mask is None or k == 1:
                return then([composite_average(image, background, k) for background in backgrounds])
            wholes = [composite_average(image, background, 1) for background in backgrounds]
            return then([masked_average(whole, mask, k)[0] for whole in wholes])

        return map_threads(make, range(len(self)), self.threads)

    def weights(self, k: int) -> list[UInt8 | None] | None:
        """How much each pixel of :meth:`pyramid` counts, uint8 (h // k, w // k) a view: 255 whole, 0 not; None for all."""
        if self.masks is None:
            return None
        return [None if mask is None else mask if k == 1 else mask_average(mask, k) for mask in self.masks]


def evenly(n: int, most: int) -> list[int]:
    """``most`` of n > 1 places in order, evenly chosen, the first and the last among them."""
    return np.linspace(0, n - 1, most).round().astype(int).tolist()
