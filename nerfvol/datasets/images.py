"""Image files to uint8 arrays: opened by the decoders of FORMATS alone, turned, their colours made sRGB's.

Images are (height, width, 3) opaque or (height, width, 4) with *straight* alpha, 8 bits a channel.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image, UnidentifiedImageError

from nerfvol.datasets.averages import UInt8, area_average
from nerfvol.datasets.colours import Colours, colours_of, eight_bits
from nerfvol.datasets.shared_pixels import pixels_of
from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error
from nerfvol.files.unchanged import while_unchanged
from nerfvol.machine import usable_cores

Item = TypeVar("Item")
Made = TypeVar("Made")

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
MAX_PIXELS = 89_000_000  # a declared size beyond this is taken for a decompression bomb, as Pillow does
_ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
"""Whose decoders a file may reach."""
_OR = "PNG, JPEG, WEBP, BMP or TIFF"
_EXIF_ORIENTATION = 0x0112
_TIFF_BITS, _TIFF_PLANES = 258, 284


def map_threads(function: Callable[[Item], Made], items: Iterable[Item], threads: int | None = None) -> list[Made]:
    """``function`` of every item, in order, in threads (decoding and numpy's loops let others run).

    ``threads``: how many; None: one for every core this process may use.
    """
    count = usable_cores() if threads is None else max(1, threads)
    if count == 1:
        return list(map(function, items))
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, items))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The picture, opened but not decoded; whatever its decoder makes of it is one InputError that names the file.

    Only the decoders of :data:`FORMATS` are tried: Pillow goes by the content, and among its others is one that starts
    another program.
    """
    try:
        image = Image.open(path, formats=FORMATS)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(f"{path}: images of more than {MAX_PIXELS // 10**6} million pixels are refused") from error
    except FileNotFoundError as error:
        raise InputError(f"{path}: expected an image, but there is no such file") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: expected a {_OR} image, but its content is {looks_like(path)}") from error
    except OSError as error:
        raise InputError(f"{path}: the image cannot be read: {explain_os_error(error)}") from error
    except Exception as error:  # decoders raise whatever damaged bytes bring them to
        raise InputError(f"{path}: the image is damaged ({_first_line(error)})") from error
    with image:
        if image.width * image.height > MAX_PIXELS:
            raise InputError(
                f"{path}: images of more than {MAX_PIXELS // 10**6} million pixels are refused, this one declares "
                f"{image.width}x{image.height}"
            )
        try:
            yield image
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{path}: the image is damaged or truncated ({_first_line(error)})") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:80] or type(error).__name__


def looks_like(path: Path) -> str:
    """What a file that is no known picture begins like."""
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return "none"
    if start[4:12] == b"ftypavif":
        return "AVIF: convert it to JPEG"
    if start[4:8] == b"ftyp":
        return "HEIC or a video, as phones write them: convert it to JPEG"
    if not start:
        return "nothing, it is empty"
    names = {b"%!PS": "PostScript", b"\xc5\xd0\xd3\xc6": "PostScript", b"DDS ": "DDS", b"GIF8": "GIF", b"%PDF": "PDF",
             b"\x76\x2f\x31\x01": "OpenEXR", b"\x00\x00\x00\x0cjP": "JPEG 2000", b"8BPS": "a Photoshop document",
             b"\x00\x05\x16\x07": "what macOS leaves next to a file on foreign disks",
             b"vers": "a Git LFS pointer: fetch the file itself"}  # fmt: skip
    return next((name for magic, name in names.items() if start.startswith(magic)), "none of them")


@dataclass(frozen=True)
class ImageHeader:
    """``size``: (width, height) in pixels as stored. ``orientation``: EXIF's, 1 to 8; 1: as stored. ``colours``: those that
    it states instead of sRGB's. ``is_several``: others follow in the file, which do not count."""

    size: tuple[int, int]
    orientation: int
    colours: Colours | None = None
    is_several: bool = False

    @property
    def upright(self) -> tuple[int, int]:
        """(width, height) once the picture is turned as its EXIF orientation says."""
        width, height = self.size
        return (height, width) if self.orientation >= 5 else (width, height)


@while_unchanged(4096)
def image_header(path: Path) -> ImageHeader:
    """What the file's header says, without decoding; InputError where it is no image, damaged or too large."""
    with _opened(path) as image:
        colours = colours_of(image)  # first: looking for EXIF may decode the picture, which closes the file
        orientation = _exif(image, path).get(_EXIF_ORIENTATION, 1)
        known = type(orientation) is int and 1 <= orientation <= 8
        # What phones write behind a photograph, MPO, is a map of its brightness. Others are not counted: that would read
        # them, with all that is wrong with them, and leave what they state in image.info.
        several = image.format != "MPO" and getattr(image, "is_animated", False)
        return ImageHeader(image.size, orientation if known else 1, colours, several)


def _exif(image: Image.Image, path: Path) -> Image.Exif:
    """The file's EXIF data. Pillow decodes a whole PNG to look for it behind the pixels: only where something is there."""
    if image.format == "PNG" and not _something_follows_pixels(path):
        return Image.Image.getexif(image)
    return image.getexif()


def _something_follows_pixels(path: Path) -> bool:
    """Whether a PNG file has chunks between its pixels' last and its end."""
    with path.open("rb") as file:
        file.seek(len(b"\x89PNG\r\n\x1a\n"))
        pixels = False
        while len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if pixels and name != b"IDAT":
                return name != b"IEND"
            pixels = name == b"IDAT"
            file.seek(length + 4, os.SEEK_CUR)
    return False


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels as stored, from the file's header alone; see :func:`image_header`."""
    return image_header(path).size


def turned(image: UInt8, orientation: int) -> UInt8:
    """The picture (h, w, ...) as EXIF's ``orientation`` means it to be seen, 1 to 8."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    rows, columns = {2: (1, -1), 3: (-1, -1), 4: (-1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)}.get(orientation, (1, 1))
    return np.ascontiguousarray(image[::rows, ::columns])


def read_image(path: Path, orientation: int = 1) -> UInt8:
    """The image as uint8: (h, w, 4) where the file has transparency, else (h, w, 3); grey and palettes are expanded.

    16-bit channels are reduced to 8, other colours than sRGB's become those (datasets.colours). ``orientation``: how to turn
    it, as EXIF numbers it; by default pixels stay as stored, which is what most poses refer to.

    Raises:
        InputError: there is no such image, it is damaged, has 32 bits a channel or more than MAX_PIXELS.
    """
    return writeable(read_pixels(path, orientation))


def read_pixels(path: Path, orientation: int = 1) -> UInt8:
    """As :func:`read_image`, but the array may refuse writing: what is averaged next need not be copied."""
    with _opened(path) as image:
        return turned(_pixels(image, path), orientation)


def writeable(image: UInt8) -> UInt8:
    """The image, or a copy where it refuses writing."""
    return image if image.flags.writeable else image.copy()


def read_small(path: Path, size: int) -> tuple[UInt8, UInt8 | None]:
    """As :func:`read_image`, reduced by a whole factor so that about ``size`` pixels are left along it: to look at; and the
    picture itself, which may refuse writing, where it was decoded whole."""
    with _opened(path) as image:
        factor = max(1, min(image.size) // size)
        image.draft(None, (image.width // factor, image.height // factor))  # JPEG alone can; others ignore it
        pixels = _pixels(image, path)
        whole = None if image.format == "JPEG" else pixels
    return area_average(pixels, max(1, min(pixels.shape[:2]) // size)), whole


def read_mask(path: Path, size: tuple[int, int], orientation: int = 1) -> UInt8:
    """A mask (h, w) uint8, 0 or 255, for a picture of ``size`` (width, height): 255 where the file is not black.

    A uniformly smaller or larger mask is resized to the nearest pixel. Where the file has transparency and no colour, that
    counts.

    Raises:
        InputError: as for read_image, or a mask of another shape.
    """
    with _opened(path) as image:
        pixels, darkest = (
            _pixels(image, path, as_stored=True),
            127 if image.format == "JPEG" else 0,
        )  # JPEG's black is a little noisy
    values = pixels[..., :3].max(axis=2)
    if pixels.shape[2] == 4:
        values = pixels[..., 3] if values.min() == values.max() else np.minimum(values, pixels[..., 3])
    mask = turned(np.where(values > darkest, 255, 0).astype(np.uint8), orientation)
    height, width = mask.shape
    if (width, height) == size:
        return mask
    if abs(width / size[0] - height / size[1]) * min(size) > 2 + 2 * width / size[0]:
        raise InputError(f"{path}: expected a mask of {size[0]}x{size[1]} pixels like its image, got {width}x{height}")
    rows, columns = ((np.arange(n) + 0.5) * have / n for n, have in ((size[1], height), (size[0], width)))
    return np.ascontiguousarray(mask[rows.astype(int)[:, None], columns.astype(int)])


def _is_misread(image: Image.Image) -> bool:
    """Whether Pillow takes 16-bit planes for 8-bit ones: half of the picture would be of high bytes, half of low ones."""
    tags = getattr(image, "tag_v2", {})
    return tags.get(_TIFF_PLANES) == 2 and max(tags.get(_TIFF_BITS, (8,))) > 8


def _pixels(image: Image.Image, path: Path, as_stored: bool = False) -> UInt8:
    """``as_stored``: whatever colours the file states, as for numbers that are none."""
    if image.mode == "F" or (image.mode == "I" and image.format != "PNG"):
        raise InputError(f"{path}: expected 8 or 16 bits a channel, got 32-bit pixels (mode {image.mode})")
    if image.format == "TIFF" and _is_misread(image):
        raise InputError(f"{path}: a TIFF of 16 bits with a plane for each colour is not read: save it as PNG")
    colours = None if as_stored else colours_of(image)
    if colours is not None and colours.is_known:
        return pixels_of(colours.to_srgb(image))
    if image.mode.startswith("I"):
        return np.repeat(eight_bits(image)[..., None], 3, axis=2)
    has_alpha = image.mode in _ALPHA_MODES or "transparency" in image.info
    wanted = "RGBA" if has_alpha else "RGB"
    return pixels_of(image if image.mode == wanted else image.convert(wanted))
