"""The photographs of a folder: which files they are, which camera took them, and copies of a size that training can use.

A copy is upright: EXIF's turn (tag Orientation) is applied once, here, so that neither structure from motion nor training
needs to know of it. Focal lengths: EXIF states the one that gives the same field of view on 35 mm film, by the diagonal
(CIPA DC-008, FocalLengthIn35mmFilm); film is 36 x 24 mm.
"""

from __future__ import annotations

import functools
import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from nerfvol.datasets.colours import colours_of
from nerfvol.datasets.images import FORMATS, MAX_PIXELS, SUFFIXES, looks_like, map_threads
from nerfvol.datasets.listing import is_left_aside
from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write

FILM_DIAGONAL = math.hypot(36, 24)
FOCAL_GUESS = 1.2
"""Of the longer side, where nothing is known: what COLMAP takes."""
FEW_FOR_A_LENS = 20
"""Photographs of one camera below which its lens gets one coefficient instead of four."""
_ORIENTATION, _MAKE, _MODEL, _EXIF, _FOCAL, _FOCAL_35 = 0x0112, 0x010F, 0x0110, 0x8769, 0x920A, 0xA405
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp")
HEIF_SUFFIXES = (".heic", ".heif")


@dataclass(frozen=True)
class Photograph:
    """A picture as structure from motion sees it. ``name``: of the copy. ``width``, ``height``: of the copy, pixels.
    ``camera``: what its EXIF says took it, "" where it says nothing. ``focal``: focal length in pixels of the copy, or None.
    ``source``: name of the file it is a copy of."""

    name: str
    width: int
    height: int
    camera: str = ""
    focal: float | None = None
    source: str = ""


@dataclass(frozen=True)
class CameraGroup:
    """Photographs that share a camera: one size, one camera, one focal length. ``model``: COLMAP's name of the lens."""

    names: list[str]
    width: int
    height: int
    model: str
    focal: float
    known: bool

    def describe(self) -> dict[str, Any]:
        """For reports."""
        source = "EXIF" if self.known else "guessed"
        return {
            "photographs": len(self.names), "width": self.width, "height": self.height, "lens": self.model,
            "focal_start": round(self.focal, 2), "focal_from": source,
        }  # fmt: skip


@functools.cache
def reads_heif() -> bool:
    """Whether pillow-heif is installed; Pillow reads HEIC and HEIF from then on."""
    try:
        import pillow_heif
    except ImportError:
        return False
    pillow_heif.register_heif_opener()
    return True


def find_photographs(folder: Path) -> list[Path]:
    """The picture files of a folder, in the order of their names; InputError where there are fewer than three."""
    try:
        files = sorted(path for path in folder.iterdir() if path.is_file() and not is_left_aside(path))
    except OSError as error:
        raise InputError(f"{folder}: expected a folder of photographs or a video, but it cannot be read") from error
    heif = [path for path in files if path.suffix.lower() in HEIF_SUFFIXES]
    read = SUFFIXES + HEIF_SUFFIXES if heif and reads_heif() else SUFFIXES
    found = [path for path in files if path.suffix.lower() in read]
    if not found and (folder / "images").is_dir():
        return find_photographs(folder / "images")
    if len(found) >= 3:
        return found
    if heif and not reads_heif():
        raise InputError(
            f"{folder}: its {len(heif)} HEIC pictures need pillow-heif (pip install 'nerfvol[heic]'); or export them as "
            "JPEG (phones: camera settings, formats, 'most compatible')"
        )
    videos = [path.name for path in files if path.suffix.lower() in VIDEO_SUFFIXES]
    if videos:
        raise InputError(f"{folder}: expected photographs, but it holds a video; give the video itself: {videos[0]}")
    what = f"only {len(found)}" if found else "none"
    raise InputError(f"{folder}: expected three photographs or more (JPEG, PNG, WebP, TIFF), but it holds {what}")


def left_out(found: list[Path]) -> list[str]:
    """A sentence on the HEIC pictures beside the photographs ``found``, where pillow-heif is not there to read them."""
    beside = found[0].parent.iterdir() if found else ()
    heif = [path for path in beside if path.suffix.lower() in HEIF_SUFFIXES and path not in found]
    if not heif:
        return []
    return [f"{len(heif)} HEIC pictures are left out: they need pillow-heif (pip install 'nerfvol[heic]')"]


def copy_photographs(paths: list[Path], folder: Path, size: int) -> tuple[list[Photograph], list[str]]:
    """Upright copies, at most ``size`` pixels along the longer side, in ``folder``; those that are there are kept.

    A photograph that is small and upright already is copied byte by byte. Returns the photographs in the order of
    ``paths`` and a sentence for each that cannot be read, which is left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    taken: set[str] = set()
    names = []
    for path in paths:
        # Copies may become JPEG, so that names must differ before their endings.
        name = path.name if path.stem.lower() not in taken else f"{path.stem}_{path.suffix[1:]}{path.suffix}"
        names.append(name)
        taken.add(Path(name).stem.lower())

    def copy(pair: tuple[Path, str]) -> Photograph | str:
        try:
            return _copy(pair[0], folder, pair[1], size)
        except UnidentifiedImageError:  # says the path alone
            return f"{pair[0].name} is left out: it cannot be read (its content is {looks_like(pair[0])})"
        except Exception as error:  # a decoder fails in as many ways as files are damaged
            with_suffix = str(error).splitlines()[0] if str(error) else type(error).__name__
            return f"{pair[0].name} is left out: it cannot be read ({with_suffix:.80})"

    made = map_threads(copy, list(zip(paths, names, strict=True)))
    return [m for m in made if isinstance(m, Photograph)], [m for m in made if isinstance(m, str)]


def formats_for(path: Path) -> tuple[str, ...]:
    """The decoders that a photograph's file may reach: those of data sets, and HEIF's where its name says so."""
    return (*FORMATS, "HEIF") if path.suffix.lower() in HEIF_SUFFIXES and reads_heif() else FORMATS


def _copy(path: Path, folder: Path, name: str, size: int) -> Photograph:
    with Image.open(path, formats=formats_for(path)) as image:
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"{image.width}x{image.height} pixels are more than {MAX_PIXELS:,}")
        colours = colours_of(image)  # first: looking for EXIF may decode the picture, which closes the file
        exif = image.getexif()
        turned = exif.get(_ORIENTATION, 1) in range(2, 9)
        camera, focal_35 = _camera_of(exif)
        longest = max(image.size)
        as_it_is = not turned and longest <= size and image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L")
        scale = min(1.0, size / longest)
        width, height = (max(1, round(side * scale)) for side in image.size)
        if turned and exif.get(_ORIENTATION) in (5, 6, 7, 8):
            width, height = height, width
        target = folder / (name if as_it_is else f"{Path(name).stem}.jpg")
        if as_it_is:
            image.load()  # a truncated file shows now
            if not target.exists() or target.stat().st_size != path.stat().st_size:
                with atomic_write(target) as temporary:
                    shutil.copyfile(path, temporary)
        else:  # the copy has no profile: in it are sRGB's
            image.draft(None, (2 * width, 2 * height))
            upright = ImageOps.exif_transpose(image)
            upright = (upright if colours is None else colours.to_srgb(upright)).convert("RGB")
            with atomic_write(target) as temporary:
                upright.resize((width, height), Image.Resampling.LANCZOS).save(temporary, format="JPEG", quality=96)
    focal = None if focal_35 is None else focal_35 * math.hypot(width, height) / FILM_DIAGONAL
    return Photograph(target.name, width, height, camera, focal, path.name)


def _camera_of(exif: Image.Exif) -> tuple[str, float | None]:
    """Who took it with which focal length, in words; and the focal length on 35 mm film, or None."""
    details = exif.get_ifd(_EXIF)

    def number(tag: int) -> float | None:
        try:
            value = float(details[tag])
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            return None
        return value if math.isfinite(value) and value > 0 else None

    real, film = number(_FOCAL), number(_FOCAL_35)
    words = [str(exif.get(tag, "")).strip("\0 ") for tag in (_MAKE, _MODEL)]
    words.append("" if (real or film) is None else f"{real or film:.2f} mm")
    return " ".join(word for word in words if word), film if film is None or 5 <= film <= 2000 else None


def camera_groups(photographs: list[Photograph], fisheye: bool = False) -> list[CameraGroup]:
    """The photographs by the camera that took them, the largest group first."""
    groups: dict[tuple[Any, ...], list[Photograph]] = {}
    for photograph in photographs:
        groups.setdefault((photograph.width, photograph.height, photograph.camera), []).append(photograph)
    made = []
    for (width, height, _), members in groups.items():
        stated = [p.focal for p in members if p.focal is not None]
        focal = float(np.median(stated)) if stated else FOCAL_GUESS * max(width, height)
        few = len(members) < FEW_FOR_A_LENS
        model = "OPENCV_FISHEYE" if fisheye else "SIMPLE_RADIAL" if few else "OPENCV"
        made.append(CameraGroup([p.name for p in members], width, height, model, focal, bool(stated)))
    return sorted(made, key=lambda group: (-len(group.names), group.names[0]))


def is_video(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name says that it is a video."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES
