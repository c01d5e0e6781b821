"""What every loader returns: cameras, compact images, where the scene is, and what there was to say about the files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.images import UInt8, composite, composite_average, map_threads
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds

NEAR_SHARE = 0.1
"""Of the median distance between cameras and the scene's middle: what counts as right before a lens."""


@dataclass(eq=False)
class Dataset:
    """Posed images of one split.

    ``images``: uint8 arrays, (h, w, 3) or (h, w, 4) with straight alpha, as large as their camera's intrinsics say.
    ``names``: one a view, unique, fit for a file name. ``source``: the file the poses came from.
    ``messages``: sentences a person should see (frames left out, how the split was made, how the bounds were found).
    ``reload``: reads the images again after :meth:`release`; None where they came from no file (a dataset made with
    dataclasses.replace has none either).
    """

    cameras: list[Camera]
    images: list[UInt8]
    names: list[str]
    scene: SceneBounds
    source: str
    messages: list[str] = field(default_factory=list)
    threads: int | None = None
    reload: Callable[[], list[UInt8]] | None = field(default=None, init=False)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def nbytes(self) -> int:
        """Bytes the images hold; 0 where they were let go."""
        return sum(image.nbytes for image in vars(self).get("images", ()))

    def release(self) -> None:
        """Let the images' memory go, where they can be read again: whoever asks for ``images`` next does so."""
        if self.reload is not None:
            self.__dict__.pop("images", None)

    def __getattr__(self, name: str) -> list[UInt8]:
        reload = self.__dict__.get("reload")
        if name != "images" or reload is None:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        self.images = reload()
        return self.images

    def evenly(self, most: int) -> Dataset:
        """At most ``most`` of the views, evenly chosen, the first and the last among them; the same images."""
        if len(self) <= most:
            return self
        chosen = np.linspace(0, len(self) - 1, most).round().astype(int)
        cameras, images, names = ([column[i] for i in chosen] for column in (self.cameras, self.images, self.names))
        return replace(self, cameras=cameras, images=images, names=names)

    def smaller(self, k: int, background: Sequence[float]) -> Dataset:
        """All views area-averaged over k x k pixels, over a background (3,) in [0, 1]."""
        cameras = [camera.scaled(k) for camera in self.cameras]
        return replace(self, cameras=cameras, images=self.pyramid(background, k))

    def middles(self, size: int) -> Dataset:
        """The middle of all views, at most size x size pixels of each; the images' memory is shared."""
        cameras, images = [], []
        for camera, image in zip(self.cameras, self.images, strict=True):
            top, left = (max(0, (full - size) // 2) for full in image.shape[:2])
            part = image[top : top + size, left : left + size]
            lens = camera.intrinsics.cropped(left, top, part.shape[1], part.shape[0])
            cameras.append(replace(camera, intrinsics=lens))
            images.append(part)
        return replace(self, cameras=cameras, images=images)

    def before_a_lens(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) are right before a camera, (n,): what is there is seen by no other and would only explain
        that one picture. None in scenes without surroundings, whose cameras stand outside."""
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

    def pyramid(
        self, background: Sequence[float], k: int, then: Callable[[UInt8], UInt8] = lambda image: image
    ) -> list[UInt8]:
        """Every image over a background (3,) in [0, 1], area-averaged over k x k pixels: uint8 (h // k, w // k, 3).

        Their cameras are ``camera.scaled(k)``. Opaque images at k = 1 are returned themselves, not copied. ``then`` turns
        each image into what is kept of it, so that the whole level never stands beside that.
        """
        if not 1 <= k <= 256:
            raise InputError(f"the pyramid's factor must be an integer between 1 and 256, got {k}")
        return map_threads(lambda image: then(composite_average(image, background, k)), self.images, self.threads)
