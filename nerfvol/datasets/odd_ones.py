"""Views that are nothing like the others of their set: one must not decide for all. They are left out, counted and named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from nerfvol.cameras.focus import crowd_of
from nerfvol.datasets.images import UInt8
from nerfvol.datasets.listing import MOST_LOST, are_few, named

if TYPE_CHECKING:
    from nerfvol.datasets.frames import View

DIM = 24
"""Of 255 levels: no photograph is so dark throughout, and 12 bits in a file for 16 reach 15."""
OTHER_LENS = 20
"""Times: focal lengths, in widths of the picture, that differ by more from the middle one are a mistake and no zoom."""
THUMBNAIL = 25
"""Times that the middle one of the pictures' longer sides holds a thumbnail's shorter one, at least: training reduces pictures
together, until some hundred pixels are left along their longer side, and so of a thumbnail at most four, or none."""
LEAST_SIDE = 16
"""Pixels: what is smaller is a thumbnail too, where the others are much larger; the first stages see 1 / 16 of pictures."""


def alone(views: Sequence[View], messages: list[str]) -> set[int]:
    """The views, by id, whose lens is nothing like the others', or whose pose is that which trackers write where they lost it;
    sentences on them."""
    found: set[int] = set()
    scales = np.array([view.camera.intrinsics.fx / view.camera.intrinsics.width for view in views])
    apart = (
        np.maximum(scales, np.median(scales)) / np.minimum(scales, np.median(scales)) > OTHER_LENS if views else scales
    )
    odd = [view for view, is_so in zip(views, apart, strict=True) if is_so]
    if odd and are_few(len(odd), len(views)):
        found |= {id(view) for view in odd}
        messages.append(
            f"the focal lengths of {len(odd)} of {len(views)} images are more than {OTHER_LENS} times as long or short as the "
            f"others': they are left out: {named([view.frame.listed for view in odd])}"
        )
    at_rest = [view for view in views if np.abs(np.abs(view.camera.c2w) - np.eye(4)).max() < 1e-12]
    told = named([view.frame.listed for view in at_rest])
    if 1 < len(at_rest) < MOST_LOST * len(views) and len({view.frame.light for view in at_rest}) == 1:
        found |= {id(view) for view in at_rest}
        messages.append(
            f"{len(at_rest)} of {len(views)} images have one pose, the identity, as trackers write that they lost it: they are "
            f"left out: {told}"
        )
    elif len(at_rest) == 1 and len(views) > 1 and at_rest[0] is not views[0]:
        messages.append(f"the pose of {told} is the identity: was its camera found?")
    return found


def astray(training: Sequence[View], views: Sequence[View]) -> set[int]:
    """The views whose cameras lie far from all others, by id."""
    if len(training) < 5:
        return set()
    crowd = crowd_of(np.stack([view.camera.position for view in training]))
    found = set()
    for group in (training, views):
        positions = np.stack([view.camera.position for view in group]) if group else np.zeros((0, 3))
        if len(group):
            found |= {id(view) for view, far in zip(group, crowd.astray(positions), strict=True) if far}
    return found


def thumbnails(
    training: Sequence[View], views: Sequence[View], downscale: int, messages: list[str]
) -> tuple[list[View], list[View]]:
    """Both without the pictures that, 1 / downscale of their size, are too small to be reduced together with the others; a
    sentence on those of ``views``. Where all of these are so small they stay."""
    usual = float(np.median([_longer(view) for view in training])) / downscale
    least = max(usual / THUMBNAIL, LEAST_SIDE)

    def is_large(view: View) -> bool:
        lens = view.camera.intrinsics
        return min(lens.width, lens.height) // downscale >= least or 4 * _longer(view) >= usual * downscale

    kept, small = [v for v in views if is_large(v)], [v for v in views if not is_large(v)]
    if small and kept:
        messages.append(
            f"{len(small)} of {len(views)} images are thumbnails, less than {least * downscale:.0f} pixels to a side where the "
            f"others have {usual * downscale:.0f}: they are left out: {named([view.frame.listed for view in small])}"
        )
    return kept or list(views), [view for view in training if is_large(view)]


def _longer(view: View) -> int:
    return max(view.camera.intrinsics.width, view.camera.intrinsics.height)


def blank(views: Sequence[View], images: Sequence[UInt8], messages: list[str]) -> set[int]:
    """Indices of the views whose pictures (h, w, 3 or 4) show nothing at all, where few do: one colour throughout, or wholly
    transparent. A camera that failed would teach that there is nothing. A sentence on them."""
    found = [i for i, image in enumerate(images) if _is_blank(image)]
    if not found or not are_few(len(found), len(images)):
        return set()
    messages.append(
        f"{len(found)} of {len(images)} images show nothing, one colour or full transparency throughout, where the others do: "
        f"they are left out: {named([views[i].frame.listed for i in found])}"
    )
    return set(found)


def dim(pictures: Sequence[UInt8]) -> list[str]:
    """A sentence where all of the ``pictures`` (h, w, 3 or 4) are nearly black, as fewer bits in a file for more look."""
    brightest = max((int(picture[..., :3].max()) for picture in pictures), default=255)
    if brightest >= DIM:
        return []
    return [
        f"the brightest of {len(pictures)} images has level {brightest} of 255: they are learnt as dark as they are; do their "
        "numbers have fewer bits than their files, or are they linear?"
    ]


def _is_blank(image: UInt8) -> bool:
    colour = image[0, 0]
    if image.shape[2] == 4 and not colour[3]:
        return not image[::8, ::8, 3].any() and not image[..., 3].any()
    return bool((image[::8, ::8] == colour).all()) and bool((image == colour).all())
