"""What a format reader hands over: a listing of posed image files, before any image is decoded."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.cameras.camera import unscaled_pose
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.images import SUFFIXES
from nerfvol.datasets.points import ModelPoints
from nerfvol.errors import InputError

HOLD_OUT_EVERY = 8
MOST_LOST = 0.5
"""Share of the frames that may lack a usable pose; a set that loses more is refused."""


def named(names: Sequence[str], most: int = 3) -> str:
    """The first few of ``names`` for a sentence."""
    return ", ".join(str(name) for name in names[:most]) + (", ..." if len(names) > most else "")


class Poses:
    """Poses as files have them, frame by frame: those of no use are left out, and all that was done is told once.

    ``where``: the file, for sentences.
    """

    def __init__(self, where: Path) -> None:
        self.where = where
        self.lost: list[str] = []
        self.scaled: dict[str, float] = {}
        self.count = 0

    def read(self, listed: str, matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The rigid pose (4, 4) of the frame ``listed``; None where its matrix is not finite, as trackers write that they
        lost it.

        Raises:
            InputError: see rigid_pose.
        """
        self.count += 1
        if matrix.shape in ((3, 4), (4, 4)) and not np.isfinite(matrix).all():
            self.lost.append(listed)
            return None
        pose, scale = unscaled_pose(matrix)
        if scale != 1:
            self.scaled[listed] = scale
        return pose

    def messages(self) -> list[str]:
        """Sentences on what was left out or changed.

        Raises:
            InputError: more than half of the frames have no usable pose.
        """
        said = []
        if len(self.lost) > MOST_LOST * self.count:
            raise InputError(
                f"{self.where}: the poses of {len(self.lost)} of {self.count} frames hold NaN or infinity instead of finite "
                f"numbers ({named(self.lost)}), and too few are left"
            )
        if self.lost:
            said.append(
                f"{len(self.lost)} of {self.count} frames have no finite pose and are left out: {named(self.lost)}"
            )
        if self.scaled:
            factors = list(self.scaled.values())
            said.append(
                f"the axes of {len(factors)} of {self.count} poses are not of unit length (scaled by "
                f"{float(np.median(factors)):.3g}); that says nothing of the scene and was taken out"
            )
        return said


@dataclass(frozen=True)
class MaskFile:
    """Which pixels of an image are not to be looked at. ``black_is_out``: the black ones; else those that are not black."""

    path: Path
    black_is_out: bool = True


@dataclass(frozen=True, eq=False)
class Frame:
    """One listed image: as named by the file, where it is on disk (None if missing), its pose and calibration.

    ``masks``: files that say which of its pixels count; none by default. ``light``: the name of the light it was taken under,
    where the files tell several apart.
    """

    listed: str
    path: Path | None
    c2w: NDArray[np.float64]
    calibration: Calibration
    masks: tuple[MaskFile, ...] = ()
    light: str | None = None

    @property
    def file(self) -> Path:
        """The image's path; InputError where it is missing."""
        if self.path is None:
            raise InputError(f"{self.listed}: there is no such image")
        return self.path


@dataclass(eq=False)
class Listing:
    """The frames of one split, and of the training split (from which the scene bounds are worked out).

    ``source``: the file the poses came from. ``messages``: sentences a person should see. ``read_points``: reads the points
    found with the poses; None where the format has none.
    """

    frames: list[Frame]
    training: list[Frame]
    source: Path
    hint: BoundsHint = field(default_factory=BoundsHint)
    messages: list[str] = field(default_factory=list)
    read_points: Callable[[], ModelPoints] | None = None


def hold_out(frames: list[Frame], split: str) -> tuple[list[Frame], list[Frame], str]:
    """The built-in split where a file has none: frames of the split, training frames, a sentence.

    In the order of their names every 8th frame, beginning with the first, is held out, for validation and test alike:
    the field's convention for photo sets.
    """
    ordered = sorted(frames, key=lambda frame: frame.listed)
    held, kept = ordered[::HOLD_OUT_EVERY], [f for i, f in enumerate(ordered) if i % HOLD_OUT_EVERY]
    if not kept:
        return ordered, ordered, "a single view: it is used for training and for validation"
    share = f"{len(held)} of {len(ordered)}"
    sentence = f"no split in the file: every {HOLD_OUT_EVERY}th view by name is held out ({share})"
    return (kept if split == "train" else held), kept, sentence


class MaskFinder:
    """Masks by the conventions of other programs: what a file names, ``dynamic_mask_NAME`` and folders of masks."""

    def __init__(self, folder: Path, images: Path | None = None) -> None:
        """``folder``: of the data set; ``images``: of the photographs, where masks folders may lie too."""
        self._finder = ImageFinder(folder)
        self._beside: dict[Path, ImageFinder] = {}
        homes = [folder] if images is None or images == folder else [folder, images, images.parent]
        places = dict.fromkeys(home / name for home in homes for name in ("masks", "mask"))
        self._folders = [place for place in places if place.is_dir()]
        self._in_use: set[Path] = set()
        self.missing: list[str] = []

    def of(self, listed: str, path: Path | None, stated: str | None = None) -> tuple[MaskFile, ...]:
        """The masks of the image ``listed`` at ``path``; ``stated``: what its file names as such."""
        if path is None:
            return ()
        found = []
        if stated is not None:
            mask = self._finder.find(stated)
            if mask is None:
                self.missing.append(stated)
            else:
                found.append(MaskFile(mask))
        beside = self._beside.setdefault(path.parent, ImageFinder(path.parent))
        named_so = beside.mentions("mask")  # names of all that is looked for there
        for name in (f"dynamic_mask_{path.name}", f"dynamic_mask_{path.stem}") if named_so else ():
            if (mask := beside.find(name)) is not None:
                found.append(MaskFile(mask, black_is_out=False))
                break
        for name in _beside(path) if named_so and not found else ():
            if (mask := beside.find(name)) is not None and mask != path:
                return (MaskFile(mask),)
        if not found:
            found += self._in_folders(listed, path)
        return tuple(found)

    def _in_folders(self, listed: str, path: Path) -> list[MaskFile]:
        """COLMAP's: the image's name and .png, below a folder of masks; or the image's stem, alone or as Metashape ends it."""
        for folder in self._folders:
            finder = self._beside.setdefault(folder, ImageFinder(folder))
            inside = listed.replace("\\", "/")
            for name in (f"{inside}.png", f"{path.name}.png", inside, path.stem, *_beside(path)):
                if path.parent != folder and (mask := finder.find(name)) is not None and mask != path:
                    self._in_use.add(folder)
                    return [MaskFile(mask)]
        return []

    def messages(self, frames: Sequence[Frame]) -> list[str]:
        """Sentences on the masks of ``frames``."""
        with_mask = [frame.listed for frame in frames if frame.masks]
        said = []
        if with_mask:
            said.append(
                f"{len(with_mask)} of {len(frames)} images have masks: what those leave out takes no part in training "
                "and scores"
            )
        if idle := [folder for folder in self._folders if folder not in self._in_use and not with_mask and frames]:
            said.append(
                f"{idle[0]} is not used: none of its files is named like an image (NAME.png, NAME.jpg.png or NAME_mask.png)"
            )
        if self.missing:
            said.append(
                f"{len(self.missing)} masks that are named are not on disk, and their images count whole: {named(self.missing)}"
            )
        return said


def listed_names(frames: Sequence[Frame]) -> list[str]:
    """One unique name a frame, fit for a file name: the image's stem, or its path with _ for / where stems repeat."""
    paths = [Path(frame.listed.replace("\\", "/")) for frame in frames]
    paths = [p.with_suffix("") if p.suffix.lower() in SUFFIXES else p for p in paths]
    stems = [p.name for p in paths]
    if len(set(stems)) == len(stems):
        return stems
    long = ["_".join(part for part in p.parts if part not in (".", "..", "/")) for p in paths]
    return [f"{i:04d}_{name}" for i, name in enumerate(long)] if len(set(long)) < len(long) else long


def _beside(path: Path) -> tuple[str, str, str]:
    """What RealityCapture and Metashape call the mask of the image ``path``, without the suffix."""
    return f"{path.name}.mask", f"{path.stem}.mask", f"{path.stem}_mask"


def is_photograph(path: Path) -> bool:
    """Whether a file's name is a photograph's: a known suffix, no leftover of an operating system (``._a.jpg``), no mask."""
    return path.suffix.lower() in SUFFIXES and not is_left_aside(path)


def is_left_aside(path: Path) -> bool:
    """Whether a file's name says that it is no photograph whatever its suffix: hidden, or a mask."""
    is_mask = path.name.startswith("dynamic_mask_") or path.stem.endswith((".mask", "_mask"))
    return path.name.startswith(".") or is_mask


class ImageFinder:
    """Finds image files as formats name them: relative to a folder, with or without the suffix, in any case."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._listings: dict[Path, dict[str, Path]] = {}
        self._mentions: dict[str, bool] = {}

    def mentions(self, word: str) -> bool:
        """Whether the name of any file of the folder itself has ``word``, in small letters, in it."""
        if word not in self._mentions:
            self._mentions[word] = any(word in name for name in self._names(self._folder))
        return self._mentions[word]

    def find(self, listed: str) -> Path | None:
        """The file, or None if there is none.

        A path that leads nowhere is looked for by its last parts below the folder where it is an absolute one of another
        machine, else by its name in the folder itself; and as the address it may be (file:///a%20b).
        """
        try:
            found = self._find(self._folder / listed.replace("\\", "/")) or self._by_end(listed)
            address = unquote(re.sub("^file://", "", listed))
            return found if found is not None or address == listed else self.find(address)
        except (OSError, ValueError):  # a name too long, half a character
            return None

    def _by_end(self, listed: str) -> Path | None:
        absolute = listed.startswith(("/", "\\")) or listed[1:3] in (":\\", ":/") or listed.startswith("..")
        parts = [part for part in listed.replace("\\", "/").split("/") if part not in ("", ".", "..")]
        for first in range(len(parts)) if absolute else range(len(parts) - 1, len(parts)):
            if (found := self._find(self._folder.joinpath(*parts[first:]))) is not None:
                return found
        return None

    def _find(self, path: Path) -> Path | None:
        names, stem = self._names(path.parent), _plain(path.name)
        if stem in names:
            found = path if path.is_file() else names[stem]
            return found if found.is_file() else None
        for suffix in SUFFIXES:
            if stem + suffix in names:
                return names[stem + suffix]
        return None

    def _names(self, folder: Path) -> dict[str, Path]:
        if folder not in self._listings:
            try:
                entries = sorted(folder.iterdir())
            except OSError:  # a folder that is not there holds no images; the caller reports them as missing
                entries = []
            self._listings[folder] = {_plain(e.name): e for e in entries if not e.name.startswith(".")}
        return self._listings[folder]


def _plain(name: str) -> str:
    """A file's name in one spelling: macOS writes é as two characters."""
    return unicodedata.normalize("NFC", name).lower()
