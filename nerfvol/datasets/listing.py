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
from nerfvol.cameras.pose import ShearedPose, unscaled_pose
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.images import SUFFIXES
from nerfvol.datasets.points import ModelPoints
from nerfvol.errors import InputError

HOLD_OUT_EVERY = 8
MOST_LOST = 0.5
"""Share of the frames that may lack a usable pose; a set that loses more is refused."""
FEW, ENOUGH_TO_JUDGE = 0.1, 10
"""Share of the frames that may be left out because they are damaged or do not fit the others, and of how many at least."""


PHOTOGRAPHS = re.compile(r"images_?(\d*)|(input|image|rgb|color)")
"""Names of folders of photographs, in small letters; the number says by how much they are reduced."""


def are_few(wrong: int, n: int) -> bool:
    """Whether so many of ``n`` frames may be left out."""
    return wrong <= max(1, FEW * n) and n >= ENOUGH_TO_JUDGE


def require_few(wrong: Sequence[InputError], n: int) -> None:
    """The first of the errors, raised where so many of ``n`` frames may not be left out."""
    if wrong and not are_few(len(wrong), n):
        raise wrong[0]


def with_count(errors: Sequence[InputError]) -> str:
    """The first of the errors, and how many more there are."""
    return f"{errors[0]}" + (f" (and {len(errors) - 1} more)" if len(errors) > 1 else "")


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
        self.unusable: list[InputError] = []
        self.count = 0

    def leave_out(self, error: InputError) -> None:
        """A frame that cannot be used, for the reason that ``error`` says; a ShearedPose is raised again."""
        if isinstance(error, ShearedPose):
            raise error
        self.count += 1
        self.unusable.append(error)

    def read(self, listed: str, matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The rigid pose (4, 4) of the frame ``listed``; None where its matrix is not finite, as trackers write that they
        lost it.

        Raises:
            InputError: see rigid_pose; the frame does not count yet.
        """
        if matrix.shape in ((3, 4), (4, 4)) and not np.isfinite(matrix).all():
            self.count += 1
            self.lost.append(listed)
            return None
        pose, scale = unscaled_pose(matrix)
        self.count += 1
        if scale != 1:
            self.scaled[listed] = scale
        return pose

    def messages(self) -> list[str]:
        """Sentences on what was left out or changed.

        Raises:
            InputError: more than half of the frames have no finite pose, or more than a few cannot be used.
        """
        require_few(self.unusable, self.count)
        said = []
        if self.unusable:
            n = len(self.unusable)
            said.append(f"{n} of {self.count} frames cannot be used and are left out: {with_count(self.unusable)}")
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


def listed_names(frames: Sequence[Frame]) -> list[str]:
    """One unique name a frame, fit for a file name: the image's stem, or its path with _ for / where stems repeat."""
    paths = [Path(frame.listed.replace("\\", "/")) for frame in frames]
    paths = [p.with_suffix("") if p.suffix.lower() in SUFFIXES else p for p in paths]
    stems = [p.name for p in paths]
    if len(set(stems)) == len(stems):
        return stems
    long = ["_".join(part for part in p.parts if part not in (".", "..", "/")) for p in paths]
    return [f"{i:04d}_{name}" for i, name in enumerate(long)] if len(set(long)) < len(long) else long


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
        listed = listed.strip()
        try:
            found = self._find(self._folder / listed.replace("\\", "/")) or self._by_end(listed) or self._nearby(listed)
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

    def _nearby(self, listed: str) -> Path | None:
        """Where the folder that is named is not there: its name in other letters, or the least reduced photographs."""
        *folders, name = [part for part in listed.replace("\\", "/").split("/") if part not in ("", ".")]
        if not folders or (self._folder / "/".join(folders)).is_dir():
            return None
        place: Path | None = self._folder
        for part in folders:
            place = None if place is None else self._names(place).get(_plain(part))
        if place is not None and (found := self._find(place / name)) is not None:
            return found
        others = [
            (int(number[1] or 0), folder)
            for folder in self._names(self._folder).values()
            if (number := PHOTOGRAPHS.fullmatch(folder.name.lower())) and folder.is_dir()
        ]
        return next((found for _, folder in sorted(others) if (found := self._find(folder / name))), None)

    def _find(self, path: Path) -> Path | None:
        names, stem = self._names(path.parent), _plain(path.name)
        if stem in names:
            found = path if path.is_file() else names[stem]
            return found if found.is_file() else None
        for suffix in SUFFIXES:
            if stem + suffix in names:
                return names[stem + suffix]
        bare, _, end = stem.rpartition(".")
        others = [
            names[bare + suffix] for suffix in SUFFIXES if bare and f".{end}" in SUFFIXES and bare + suffix in names
        ]
        return others[0] if len(others) == 1 else None  # pictures that were converted after they were listed

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
