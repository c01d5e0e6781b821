"""``transforms*.json``: NeRF-synthetic (Blender), instant-ngp and nerfstudio.

The three share one layout: calibration at the top or in each frame (a frame's own figures win), ``file_path`` and a
camera-to-world ``transform_matrix`` in OpenGL axes. Formats and sources: docs/data.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import (
    CALIBRATION_KEYS,
    Calibration,
    calibration_doubts,
    finite_number,
    read_calibration,
    read_matrix,
)
from nerfvol.datasets.bounds import INSTANT_NGP_SCALE, BoundsHint
from nerfvol.datasets.formats import SPLITS
from nerfvol.datasets.listing import Frame, ImageFinder, Listing, Poses, named
from nerfvol.datasets.masks import MaskFinder
from nerfvol.datasets.split_lists import chosen_by_lists, resolved, split_frames
from nerfvol.errors import InputError, shown
from nerfvol.files.atomic import read_json
from nerfvol.files.entry import entry as file_of
from nerfvol.files.unchanged import while_unchanged
from nerfvol.region import check_box


def recognises(path: Path) -> bool:
    """Whether the folder holds a transforms*.json this module reads, or is such a file itself."""
    names = ("transforms.json", *(f"transforms_{split}.json" for split in SPLITS))
    return (path.is_file() and path.suffix.lower() == ".json") or any(file_of(path, name).is_file() for name in names)


def read(path: Path, split: str) -> Listing:
    """The listing of one split of a folder with transforms*.json, or of one such file.

    transforms_{train,val,test}.json are used as they are; where only one of val and test has pictures it is used for both. A
    single transforms.json is split by its own train/val/test_filenames or, without them, by holding out every 8th view.

    Raises:
        InputError: a file is no such JSON, there is none for the split, or a frame's name, pose or calibration cannot be used.
    """
    if path.is_file():
        return _single(_File(path), split)
    files = {s: file for s in SPLITS if (file := file_of(path, f"transforms_{s}.json")).is_file()}
    if not files:
        return _single(_File(file_of(path, "transforms.json")), split)
    if "train" not in files and split == "train":
        raise InputError(f"{path}: expected transforms_train.json for the train views, but there is no such file")
    read_files = {name: _File(file) for name, file in files.items()}
    messages = []
    if "train" in files:
        for name in [name for name in ("val", "test") if name in files and not read_files[name].present]:
            n = len(read_files.pop(name).frames)
            messages.append(
                f"{files[name].name} lists {n} cameras without pictures: it cannot be scored against, and is left out"
            )
    if (path / "transforms.json").is_file():
        messages.append(f"transforms.json is not read: {' and '.join(file.name for file in files.values())} come first")
    if "val" not in read_files and "test" not in read_files:
        listing = _single(read_files["train"], split)
        listing.messages[:0] = messages
        return listing
    used = split
    other = {"val": "test", "test": "val"}.get(split)
    if split not in read_files and other is not None and other in read_files:
        messages.append(f"there is no transforms_{split}.json: the {other} views are used instead")
        used = other
    own = read_files[used]
    train = read_files.get("train", own)
    messages += _unused(path, files, split) + own.messages
    trained = {frame.path for frame in train.frames if frame.path is not None}
    if own is not train and (both := sorted(f.listed for f in own.frames if f.path in trained)):
        messages.append(f"{len(both)} views are trained on and held out too, so that scores flatter: {named(both)}")
    return Listing(own.frames, train.frames, own.path, train.hint, messages)


def _unused(path: Path, files: Mapping[str, Path], split: str) -> list[str]:
    """Further transforms of the folder, which no split reads."""
    others = sorted(other.name for other in path.glob("transforms*.json") if other.name != "transforms.json"
                    and other not in files.values() and not other.name.startswith("."))  # fmt: skip
    return [f"not read: {named(others)}"] if others and split == "train" else []


def _single(file: _File, split: str) -> Listing:
    """A split of one file, by its own lists or by holding out."""
    frames, messages = file.frames, list(file.messages)
    if file.lists:
        chosen, training, said = chosen_by_lists(frames, file.lists, split, file.path)
        return Listing(chosen, training, file.path, file.hint, messages + said)
    if not file.present:
        return Listing(frames, frames, file.path, file.hint, messages)
    chosen, training, said = split_frames(frames, split, [file.path.parent])
    missing = [frame for frame in frames if frame.path is None]
    return Listing(chosen + missing, training, file.path, file.hint, messages + said)


class _File:
    """One transforms*.json, read: frames, lists of splits, bounds, and what there is to say.

    Raises InputError where it cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        stated = _stated(path)
        data, poses = stated.data, stated.poses
        self.lists = _named_splits(data, path)
        if stated.test and not self.lists:
            self.lists = {"test": stated.test}
        finder, masks = ImageFinder(path.parent), MaskFinder(path.parent)
        self.frames = []
        for entry in stated.entries:
            image = finder.find(entry.listed)
            mask = masks.of(entry.listed, image, entry.mask)
            self.frames.append(Frame(entry.listed, image, entry.c2w, entry.calibration, mask, entry.light))
        try:
            self.hint = _hint(data)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        self.messages = poses.messages() + masks.messages([f for f in self.frames if f.path is not None])
        self.messages += _not_used(path, data)
        points = data.get("ply_file_path")
        if isinstance(points, str) and "\0" not in points and not (path.parent / points).is_file():
            self.messages.append(f"{path.name} names points in {shown(points)}, which is not on disk")
        if stated.doubts:
            self.messages.append(f"{path.name} states {named(stated.doubts)}")
        doubled = _doubled(self.frames)
        if doubled:
            self.frames = [frame for frame in self.frames if id(frame) not in doubled]
            names = [doubled[key] for key in doubled]
            self.messages.append(
                f"{len(names)} frames are in the file twice, with the same pose: once is enough: {named(names)}"
            )
        if len({frame.listed for frame in self.frames}) < len(self.frames):
            listed = [frame.listed for frame in self.frames]
            twice = sorted({name for name in listed if listed.count(name) > 1})
            self.messages.append(
                f"{len(twice)} images are listed more than once, each with a pose of its own: {named(twice)}"
            )

    @property
    def present(self) -> bool:
        """Whether any of its images is there."""
        return any(frame.path is not None for frame in self.frames)


def _doubled(frames: list[Frame]) -> dict[int, str]:
    """Names, by id, of the frames that say the same as one before them."""
    first: dict[tuple[str, str | None], Frame] = {}
    found = {}
    for frame in frames:
        same = first.setdefault((frame.listed, frame.light), frame)
        if same is not frame and np.array_equal(same.c2w, frame.c2w):
            found[id(frame)] = frame.listed
    return found


@dataclass(frozen=True, eq=False)
class _Entry:
    """A frame as the file states it: the picture's name, pose (4, 4), calibration, and what it names as mask and light."""

    listed: str
    c2w: NDArray[np.float64]
    calibration: Calibration
    mask: str | None
    light: str | None


@dataclass(frozen=True, eq=False)
class _Stated:
    """What a file says, whatever else is on the disk: all of it, its entries that have a pose, what became of poses, the
    names of those that it has as test frames, and doubts about calibrations."""

    data: dict[str, Any]
    entries: list[_Entry]
    poses: Poses
    test: set[str]
    doubts: list[str]


@while_unchanged(3)
def _stated(path: Path) -> _Stated:
    """The file's content."""
    data, poses, entries = _load_json(path), Poses(path), []
    shared = {key: value for key, value in data.items() if key not in ("frames", "test_frames")}
    tests = data.get("test_frames")
    tests = tests if isinstance(tests, list) else []  # ScanNet++
    doubts: dict[str, int] = {}
    common: Calibration | None = None
    for number, entry in enumerate([*data["frames"], *tests]):
        where = f"{path}, frame {number}"
        try:
            if not isinstance(entry, dict):
                raise InputError(
                    f"{where}: expected an object with file_path and transform_matrix, got {shown(entry):.60}"
                )
            own = not CALIBRATION_KEYS.isdisjoint(entry)
            found = _entry(where, entry, shared, poses, None if own else common)
        except InputError as error:
            poses.leave_out(error)
            continue
        if found is not None:
            if own or common is None:
                for doubt in calibration_doubts({**shared, **entry}):
                    doubts[doubt] = doubts.get(doubt, 0) + 1
            common = common if own else found.calibration
            entries.append(found)
    listed = {e["file_path"] for e in tests if isinstance(e, dict) and isinstance(e.get("file_path"), str)}
    return _Stated(data, entries, poses, listed & {entry.listed for entry in entries}, list(doubts))


def _entry(
    where: str, entry: dict[str, Any], shared: Mapping[str, Any], poses: Poses, calibration: Calibration | None
) -> _Entry | None:
    """The entry, with ``calibration`` where that is known; None where its pose was lost."""
    listed = entry.get("file_path")
    if not isinstance(listed, str) or not listed or "\0" in listed:
        raise InputError(f"{where}: expected file_path to name an image, got {shown(listed):.60}")
    where = f"{where} ({listed if len(listed) <= LONGEST_NAME else shown(listed)})"
    if "transform_matrix" not in entry:
        raise InputError(f"{where}: transform_matrix is missing")
    everything = {**shared, **entry}
    mask = everything.get("mask_path")
    if mask is not None and (not isinstance(mask, str) or "\0" in mask):
        raise InputError(f"{where}: expected mask_path to name an image, got {shown(mask):.60}")
    try:
        calibration = calibration or read_calibration(everything)
        c2w = poses.read(listed, read_matrix(entry["transform_matrix"]))
    except InputError as error:
        raise type(error)(f"{where}: {error}") from None
    light = everything.get("light")
    light = light if isinstance(light, str) and light else None
    return None if c2w is None else _Entry(listed, c2w, calibration, mask or None, light)


LONGEST_NAME = 200
"""Letters of a picture's name that sentences show whole."""
_USED = {"frames", "file_path", "transform_matrix", "mask_path", "aabb", "aabb_scale", "ply_file_path",
         "test_frames", "scale", *CALIBRATION_KEYS, *(f"{split}_filenames" for split in SPLITS)}  # fmt: skip
_EMPTY = (None, "", [], {}, 0, 0.0, False)


def _not_used(path: Path, data: Mapping[str, Any]) -> list[str]:
    """A sentence on what the file says and nothing here looks at. Keys that say nothing (zero, empty, null) do not count."""

    def unused(key: str, value: Any) -> bool:
        named_light = key == "light" and isinstance(value, str)  # others' lights are no names
        return key not in _USED and value not in _EMPTY and not named_light

    top = sorted(key for key, value in data.items() if unused(key, value))
    entries = [entry for entry in data["frames"] if isinstance(entry, dict)]
    inside = {key for entry in entries for key, value in entry.items() if unused(key, value)}
    told = [*top, *(f"{key} (of frames)" for key in sorted(inside))]
    return [f"{path.name} states what is not used: {named(told, 8)}"] if told else []


def _named_splits(data: Mapping[str, Any], path: Path) -> dict[str, set[str]]:
    """nerfstudio's train_filenames, val_filenames and test_filenames, those that are there; ./ and \\ as frames have them."""
    entries = [entry for entry in data["frames"] if isinstance(entry, dict)]
    listed = [entry["file_path"] for entry in entries if isinstance(entry.get("file_path"), str)]
    found = {}
    for split in SPLITS:
        names = data.get(f"{split}_filenames")
        if not names:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {split}_filenames must be a list of file names, got {shown(names):.60}")
        found[split] = resolved(names, listed)
    return found


def _load_json(path: Path) -> dict[str, Any]:
    data = read_json(path)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f'{path}: expected a JSON object with a non-empty list "frames"')
    return data


def _hint(data: Mapping[str, Any]) -> BoundsHint:
    aabb = data.get("aabb")
    box = None if aabb is None else check_box(aabb, "aabb")
    scale = finite_number(data, "aabb_scale")
    if scale is not None and scale <= 0:
        raise InputError(f"aabb_scale must be positive, got {scale:g}")
    unit = finite_number(data, "scale") if scale is not None else None
    return BoundsHint(aabb=box, aabb_scale=scale, unit=unit if unit is not None and unit > 0 else INSTANT_NGP_SCALE)
