"""Image files to uint8 arrays, and the integer arithmetic on them: area averaging and compositing over a background.

Images are (height, width, 3) opaque or (height, width, 4) with *straight* alpha, 8 bits a channel. Averages are of
colour premultiplied by alpha, summed exactly in integers and rounded once.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error
from nerfvol.machine import usable_cores

UInt8 = NDArray[np.uint8]
Item = TypeVar("Item")
Made = TypeVar("Made")

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
MAX_PIXELS = 89_000_000  # a declared size beyond this is taken for a decompression bomb, as Pillow does
_ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")
_DECODE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, IndexError, struct.error, zlib.error, MemoryError)


def map_threads(function: Callable[[Item], Made], items: Iterable[Item], threads: int | None = None) -> list[Made]:
    """``function`` of every item, in order, in threads (decoding and numpy's loops let others run).

    ``threads``: how many; None: one for every core this process may use.
    """
    with ThreadPoolExecutor(usable_cores() if threads is None else max(1, threads)) as pool:
        return list(pool.map(function, items))


def _open(path: Path) -> Image.Image:
    try:
        image = Image.open(path)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(f"{path}: images of more than {MAX_PIXELS // 10**6} million pixels are refused") from error
    except FileNotFoundError as error:
        raise InputError(f"{path}: expected an image, but there is no such file") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: expected a PNG or JPEG image, but its content is none") from error
    except OSError as error:
        raise InputError(f"{path}: the image cannot be read: {explain_os_error(error)}") from error
    except _DECODE_ERRORS as error:
        raise InputError(f"{path}: the image is damaged ({error})") from error
    if image.width * image.height > MAX_PIXELS:
        image.close()
        raise InputError(
            f"{path}: images of more than {MAX_PIXELS // 10**6} million pixels are refused, this one declares "
            f"{image.width}x{image.height}"
        )
    return image


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels from the file's header alone; InputError where it is no image, damaged or too large."""
    with _open(path) as image:
        return image.size


def read_image(path: Path) -> UInt8:
    """The image as uint8: (h, w, 4) where the file has transparency, else (h, w, 3); grey and palettes are expanded.

    16-bit channels are reduced to 8. EXIF orientation is not applied: poses refer to pixels as stored.

    Raises:
        InputError: there is no such image, it is damaged, has 32 bits a channel or more than MAX_PIXELS.
    """
    with _open(path) as image:
        try:
            if image.mode.startswith("I;16"):
                grey = (np.asarray(image).astype(np.uint32) + 128) // 257
                return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
            if image.mode in ("I", "F"):
                raise InputError(f"{path}: expected 8 or 16 bits a channel, got 32-bit pixels (mode {image.mode})")
            has_alpha = image.mode in _ALPHA_MODES or "transparency" in image.info
            wanted = "RGBA" if has_alpha else "RGB"
            converted = image if image.mode == wanted else image.convert(wanted)
            return np.array(converted)
        except InputError:
            raise
        except _DECODE_ERRORS as error:
            raise InputError(f"{path}: the image is damaged or truncated ({error})") from error


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


def _divide(total: NDArray[np.uint32], by: NDArray[np.uint32] | np.uint32) -> UInt8:
    """total / by rounded half up."""
    return ((total + by // np.uint32(2)) // by).astype(np.uint8)


def area_average(image: UInt8, k: int) -> UInt8:
    """The image (h, w, 3 or 4) at 1/k of its size, (h // k, w // k, 3 or 4): colour averaged with its alpha as the weight."""
    if k == 1:
        return image
    out = np.empty((image.shape[0] // k, image.shape[1] // k, image.shape[2]), dtype=np.uint8)
    block = np.uint32(k * k)
    if image.shape[2] == 3:
        for c in range(3):
            out[..., c] = _divide(_area_sums(image[..., c], k), block)
        return out
    alpha = image[..., 3].astype(np.uint16)
    weight = _area_sums(alpha, k)
    out[..., 3] = _divide(weight, block)
    for c in range(3):
        out[..., c] = _divide(_area_sums(image[..., c] * alpha, k), np.maximum(weight, 1))
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
