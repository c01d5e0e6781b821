"""What a format reader hands over: a listing of posed image files, before any image is decoded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.images import SUFFIXES
from nerfvol.datasets.points import ModelPoints
from nerfvol.errors import InputError

HOLD_OUT_EVERY = 8


@dataclass(frozen=True, eq=False)
class Frame:
    """One listed image: as named by the file, where it is on disk (None if missing), its pose and calibration."""

    listed: str
    path: Path | None
    c2w: NDArray[np.float64]
    calibration: Calibration

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


class ImageFinder:
    """Finds image files as formats name them: relative to a folder, with or without the suffix, in any case."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._listings: dict[Path, dict[str, Path]] = {}

    def find(self, listed: str) -> Path | None:
        """The file, or None if there is none."""
        path = self._folder / listed.replace("\\", "/")
        names = self._names(path.parent)
        if path.name in names or path.name.lower() in names:
            found = path if path.is_file() else names[path.name.lower()]
            return found if found.is_file() else None
        stem = path.name.lower()
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
            self._listings[folder] = {entry.name.lower(): entry for entry in entries}
        return self._listings[folder]
