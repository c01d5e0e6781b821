"""Pictures of views: decoded, averaged, with what of them counts; and what is said of those that are damaged or masked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerfvol.datasets.averages import area_average, masked_average
from nerfvol.datasets.frames import View, unread_sentence
from nerfvol.datasets.images import UInt8, map_threads, read_image, read_pixels, turned, writeable
from nerfvol.datasets.listing import named, require_few
from nerfvol.datasets.sampled import Sampled
from nerfvol.errors import InputError


def decoded(view: View, sampled: Sampled | None, downscale: int, cut_out: bool) -> tuple[UInt8, UInt8 | None]:
    """A view's image and mask at its final size; of ``sampled`` where that has it whole."""
    whole = None if sampled is None else sampled.take()
    image = read_pixels(view.path, view.orientation) if whole is None else turned(whole, view.orientation)
    mask = view.seen()
    lens = view.camera.intrinsics
    if image.shape[:2] != (lens.height, lens.width):
        raise InputError(f"{view.path}: the image is not of the size its header declares")
    if cut_out and image.shape[2] == 4:
        unseen = image[..., 3] < 128
        if unseen.any() and not unseen.all():
            kept = np.where(unseen, 0, 255).astype(np.uint8)
            mask = kept if mask is None else np.minimum(mask, kept)
        image = np.ascontiguousarray(image[..., :3]) if not unseen.all() else image
    if mask is None:
        return writeable(area_average(image, downscale)), None
    image, mask = masked_average(image, mask, downscale)
    return writeable(image), mask


def on_masks(views: Sequence[View], masks: Sequence[UInt8 | None], images: Sequence[UInt8]) -> list[str]:
    """Sentences on what is left out of pictures; InputError where nothing is left of any."""
    said = []
    empty = [view.frame.listed for view, mask in zip(views, masks, strict=True) if mask is not None and not mask.any()]
    if len(empty) == len(views):
        raise InputError(f"{views[0].path}: the masks of all {len(views)} images leave nothing to look at")
    if empty:
        said.append(f"the masks of {len(empty)} images leave nothing of them: {named(empty)}")
    by_alpha = [
        view.frame.listed for view, mask in zip(views, masks, strict=True) if mask is not None and view.seen() is None
    ]
    if by_alpha:
        said.append(
            f"{len(by_alpha)} of {len(views)} photographs have transparent pixels: they count as not seen, and take no part in "
            f"training and scores: {named(by_alpha)}"
        )
    return said


def settle_alpha(images: list[UInt8], source: Path) -> list[UInt8]:
    """Drops alpha channels where no image of the split uses one; refuses a split in which nothing is visible."""
    with_alpha = [image for image in images if image.shape[2] == 4]
    if len(with_alpha) == len(images) and not any(image[..., 3].any() for image in images):
        raise InputError(f"{source}: all {len(images)} images are fully transparent, so there is nothing to learn from")
    if any(image[..., 3].min() < 255 for image in with_alpha):
        return images
    return [np.ascontiguousarray(image[..., :3]) for image in images]


def readable(views: Sequence[View], messages: list[str], threads: int | None) -> list[View]:
    """The views whose pictures are whole, where few are not; a sentence tells of the others."""

    def damage(view: View) -> InputError | None:
        try:
            read_image(view.path)
            view.seen()
        except InputError as error:
            return error
        return None

    found = map_threads(damage, views, threads)
    wrong = [error for error in found if error is not None]
    require_few(wrong, len(views))
    if wrong:
        messages.append(unread_sentence(wrong))
    return [view for view, error in zip(views, found, strict=True) if error is None]
