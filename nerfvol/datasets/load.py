"""``load_dataset``: finds the format, reads the listing, decodes the images and works out the scene bounds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.bounds import bounds_of_box, estimate_bounds, require_seen
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.formats import SPLITS, find_format
from nerfvol.datasets.holdout import HOLDOUTS, hold_out_arc
from nerfvol.datasets.images import UInt8, area_average, image_size, map_threads, read_image
from nerfvol.datasets.listing import Frame, Listing, listed_names
from nerfvol.datasets.store import ImageStore
from nerfvol.errors import InputError
from nerfvol.machine import total_memory
from nerfvol.region import SceneBounds, check_box


def load_dataset(
    path: str | os.PathLike[str],
    split: str = "train",
    downscale: int = 1,
    aabb: ArrayLike | None = None,
    threads: int | None = None,
    holdout: str = "own",
) -> Dataset:
    """Loads one split of a folder of posed images, whatever its format (docs/data.md).

    Args:
        path: a folder that one of FORMATS recognises, or one transforms*.json.
        split: "train", "val" or "test".
        downscale: area-averages the images (premultiplied by alpha) over downscale x downscale pixels.
        aabb: the region of detail (see SceneBounds) instead of the one worked out: x0, y0, z0, x1, y1, z1 or its two
            corners (2, 3), in scene units.
        threads: threads that decode; one for every core by default.
        holdout: "own": the split is the files', or every 8th view is held out; "arc": neighbours among the views that would
            then train are held out together, for validation and test alike, and the others train.

    Raises:
        InputError: where the files cannot be used, in one sentence that names the file.
    """
    if split not in SPLITS:
        raise InputError(f"the split must be one of {', '.join(SPLITS)}, got {split!r}")
    if not isinstance(downscale, int) or not 1 <= downscale <= 256:
        raise InputError(f"downscale must be an integer between 1 and 256, got {downscale!r}")
    box = None if aabb is None else check_box(aabb, "aabb")
    if holdout not in HOLDOUTS:
        raise InputError(f"holdout must be one of {', '.join(HOLDOUTS)}, got {holdout!r}")
    reader = find_format(Path(path)).reader
    listing = (
        reader.read(Path(path), split) if holdout == "own" else _without_arc(reader.read(Path(path), "train"), split)
    )
    messages = list(listing.messages)
    frames = _present(listing, messages)
    sizes = map_threads(lambda frame: image_size(frame.file), frames, threads)
    _require_one_size(frames, sizes)
    full_size = [_camera(frame, size, listing.source) for frame, size in zip(frames, sizes, strict=True)]
    cameras = [camera.scaled(downscale) for camera in full_size]
    _require_memory(cameras, downscale)

    def decode() -> tuple[list[UInt8], bool]:
        images = map_threads(lambda frame: area_average(read_image(frame.file), downscale), frames, threads)
        for frame, image, camera in zip(frames, images, cameras, strict=True):
            if image.shape[:2] != (camera.intrinsics.height, camera.intrinsics.width):
                raise InputError(f"{frame.path}: the image is not of the size its header declares")
        return _settle_alpha(images, listing.source)

    images, has_alpha = decode()
    training = [f for f in listing.training if f.path is not None] or frames
    scene, sentence = _bounds(listing, training, box, has_alpha)
    require_seen(scene, cameras)
    messages.append(sentence)
    store = ImageStore(len(images), lambda: decode()[0], images)
    names, source = listed_names(frames), str(listing.source)
    return Dataset(cameras, store, names, scene, source, messages, threads, listing.read_points)


def _without_arc(listing: Listing, split: str) -> Listing:
    """The listing of the training split as one of the arc, or of what is left of it."""
    present = [frame for frame in listing.frames if frame.path is not None]
    try:
        kept, held, sentence = hold_out_arc(present)
    except InputError as error:
        raise InputError(f"{listing.source}: {error}") from error
    frames = kept if split == "train" else held
    return replace(listing, frames=frames, training=kept, messages=[*listing.messages, sentence])


def _present(listing: Listing, messages: list[str]) -> list[Frame]:
    """The frames whose image exists; the others are reported in a message."""
    missing = [frame.listed for frame in listing.frames if frame.path is None]
    present = [frame for frame in listing.frames if frame.path is not None]
    if not present:
        raise InputError(
            f"{listing.source}: none of the {len(missing)} images it lists exists (the first is {missing[0]})"
            if missing
            else f"{listing.source}: no images are left for this split"
        )
    if missing:
        shown = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        messages.append(
            f"{listing.source.name} lists {len(missing)} images that are not on disk; they are left out: {shown}"
        )
    return present


def _camera(frame: Frame, size: tuple[int, int], source: Path) -> Camera:
    try:
        camera = Camera(frame.calibration.intrinsics(*size), frame.c2w)
        width, height = size
        camera.intrinsics.directions_at([(0, 0), (width, 0), (0, height), (width, height)])  # refuses a lens that folds
        return camera
    except InputError as error:
        raise InputError(f"{source}, frame {frame.listed}: {error}") from None


def _require_one_size(frames: Sequence[Frame], sizes: Sequence[tuple[int, int]]) -> None:
    """A field of view shared by images of unstated size means nothing unless they are of one size."""
    first: tuple[Frame, tuple[int, int]] | None = None
    for frame, size in zip(frames, sizes, strict=True):
        if frame.calibration.width is not None or frame.calibration.fx is not None:
            continue
        first = first or (frame, size)
        if size != first[1]:
            expected = f"{first[1][0]}x{first[1][1]} pixels like {first[0].listed}"
            raise InputError(f"{frame.path}: expected an image of {expected}, got {size[0]}x{size[1]}")


def _require_memory(cameras: Sequence[Camera], downscale: int) -> None:
    """Refuses a set of images that cannot fit in memory (the machine's, or its container's limit) before decoding any."""
    need = sum(4 * camera.intrinsics.width * camera.intrinsics.height for camera in cameras)
    have = total_memory()
    if have is not None and need > 0.8 * have:  # on a platform that does not tell, decode and see
        factor = int(np.ceil(downscale * np.sqrt(need / (0.5 * have))))
        raise InputError(
            f"{len(cameras)} images need {need / 2**30:.1f} GiB and there are {have / 2**30:.1f} GiB of memory; "
            f"use a downscale of {factor} or more"
        )


def _settle_alpha(images: list[UInt8], source: Path) -> tuple[list[UInt8], bool]:
    """Drops alpha channels where no image of the split uses one; refuses a split in which nothing is visible."""
    with_alpha = [image for image in images if image.shape[2] == 4]
    if len(with_alpha) == len(images) and not any(image[..., 3].any() for image in images):
        raise InputError(f"{source}: all {len(images)} images are fully transparent, so there is nothing to learn from")
    if any(image[..., 3].min() < 255 for image in with_alpha):
        return images, True
    return [np.ascontiguousarray(image[..., :3]) for image in images], False


def _bounds(
    listing: Listing, training: list[Frame], box: NDArray[np.float64] | None, has_alpha: bool
) -> tuple[SceneBounds, str]:
    if box is not None:
        return bounds_of_box(box, has_alpha), "scene bounds: the aabb as given"
    cameras = [_camera(frame, image_size(frame.file), listing.source) for frame in training]
    return estimate_bounds(cameras, has_alpha, listing.hint)
