"""The integer arithmetic on pictures: area averaging and compositing over a background.

Images are (height, width, 3) opaque or (height, width, 4) with *straight* alpha, 8 bits a channel. Averages are of
colour premultiplied by alpha, summed exactly in integers and rounded once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.warp import reduce

UInt8 = NDArray[np.uint8]


def _area_sums(plane: NDArray[np.unsignedinteger], k: int) -> NDArray[np.uint32]:
    """Sums (h // k, w // k) over the k x k blocks of a plane (h, w); rows and columns that fill no block drop out."""
    h, w = plane.shape[0] // k, plane.shape[1] // k
    rows = plane[: h * k : k, : w * k].astype(np.uint32)
    for j in range(1, k):
        rows += plane[j : h * k : k, : w * k]
    total = rows[:, 0::k].copy()
    for j in range(1, k):
        total += rows[:, j::k]
    return total


def _divide(total: NDArray[np.uint32], by: np.uint32) -> UInt8:
    """total / by rounded half up."""
    return ((total + by // np.uint32(2)) // by).astype(np.uint8)


def area_average(image: UInt8, k: int) -> UInt8:
    """The image (h, w, 3 or 4) at 1/k of its size, (h // k, w // k, 3 or 4): colour averaged with its alpha as the weight,
    black where that is 0 as it is rounded."""
    if k == 1:
        return image
    out = reduce(image, k, (image.shape[0] // k, image.shape[1] // k))
    if image.shape[2] == 3:
        return np.ascontiguousarray(out[..., :3])
    pixels = out.view(np.uint32)[..., 0]  # four bytes at once
    pixels *= out[..., 3] > 0
    return out


def composite_average(image: UInt8, background: Sequence[float], k: int) -> UInt8:
    """The image over a background (3,) in [0, 1], area-averaged by k: (h // k, w // k, 3), rounded once at the end."""
    if image.shape[2] == 3:
        return area_average(image, k)
    out = np.empty((image.shape[0] // k, image.shape[1] // k, 3), dtype=np.uint8)
    alpha = image[..., 3].astype(np.uint16)
    clear = 255 - alpha
    behind = np.empty_like(alpha)
    for c in range(3):
        # In units of 1/255 of a level; at most 255 * 255, which 16 bits hold.
        mixed = image[..., c] * alpha
        level = 255.0 * background[c]
        if level == int(level):
            np.multiply(clear, np.uint16(level), out=behind)
        else:
            behind = np.rint(clear * np.float32(level)).astype(np.uint16)
        mixed += behind
        if k > 1:
            out[..., c] = _divide(_area_sums(mixed, k), np.uint32(255 * k * k))
        else:
            mixed += 128
            np.right_shift(mixed, 8, out=behind)
            mixed += behind
            np.right_shift(mixed, 8, out=out[..., c], casting="unsafe")  # round(mixed / 255), exact in 16 bits
    return out


def plain_colour(background: Sequence[float]) -> UInt8:
    """The colour (3,) of what is transparent before ``background``, as :func:`composite_average` rounds it: 127.5 to 127."""
    return composite_average(np.zeros((1, 1, 4), np.uint8), background, 1)[0, 0]


def masked_average(image: UInt8, mask: UInt8, k: int) -> tuple[UInt8, UInt8]:
    """The image (h, w, 3 or 4) and its mask (h, w), area-averaged by k: colours of the part that is not masked alone.

    What is masked, black things and people, must not colour what is averaged with it. A block that is masked as a whole is
    black, and its mask 0.
    """
    if k == 1:
        return image, mask
    if image.shape[2] == 3:
        both = area_average(np.concatenate([image, mask[..., None]], axis=2), k)
        return np.ascontiguousarray(both[..., :3]), np.ascontiguousarray(both[..., 3])
    return area_average(image, k), mask_average(mask, k)


def mask_average(mask: UInt8, k: int) -> UInt8:
    """A mask (h, w) averaged by k: (h // k, w // k)."""
    return mask if k == 1 else _divide(_area_sums(mask, k), np.uint32(k * k))


def composite(image: UInt8, background: Sequence[float]) -> NDArray[np.float32]:
    """The image over a background (3,) in [0, 1] as float32 (h, w, 3) in [0, 1]."""
    values = image.astype(np.float32) * np.float32(1 / 255)
    if image.shape[2] == 3:
        return values
    behind = np.asarray(background, dtype=np.float32)
    mixed = values[..., :3] - behind
    mixed *= values[..., 3:]
    mixed += behind
    return mixed
