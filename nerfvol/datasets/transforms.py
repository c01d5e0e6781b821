"""``transforms*.json``: NeRF-synthetic (Blender), instant-ngp and nerfstudio.

The three share one layout: calibration at the top or in each frame (a frame's own figures win), ``file_path`` and a
camera-to-world ``transform_matrix`` in OpenGL axes. Formats and sources: docs/data.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerfvol.cameras.calibration import finite_number, read_calibration, read_matrix
from nerfvol.cameras.camera import rigid_pose
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.formats import SPLITS
from nerfvol.datasets.listing import Frame, ImageFinder, Listing, hold_out
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json
from nerfvol.region import check_box


def recognises(path: Path) -> bool:
    """Whether the folder holds a transforms*.json this module reads, or is such a file itself."""
    names = ("transforms.json", *(f"transforms_{split}.json" for split in SPLITS))
    return path.is_file() or any((path / name).is_file() for name in names)


def read(path: Path, split: str) -> Listing:
    """The listing of one split of a folder with transforms*.json, or of one such file.

    transforms_{train,val,test}.json are used as they are; where only one of val and test exists it is used for both. A
    single transforms.json is split by its own train/val/test_filenames or, without them, by holding out every 8th view.

    Raises:
        InputError: a file is no such JSON, there is none for the split, or a frame's name, pose or calibration cannot be used.
    """
    if path.is_file():
        return _read_single(path, split)
    files = {s: path / f"transforms_{s}.json" for s in SPLITS if (path / f"transforms_{s}.json").is_file()}
    if not files:
        return _read_single(path / "transforms.json", split)
    if "val" not in files and "test" not in files:
        return _read_single(files["train"], split)
    messages = []
    other = {"val": "test", "test": "val"}.get(split)
    if split not in files and other is not None and other in files:
        messages.append(f"there is no transforms_{split}.json: the {other} views are used instead")
        files[split] = files[other]
    if split not in files:
        raise InputError(f"{path}: expected transforms_{split}.json for the {split} views, but there is no such file")
    frames, hint = _read_file(files[split])
    training, hint = _read_file(files["train"]) if "train" in files and split != "train" else (frames, hint)
    return Listing(frames, training, files[split], hint, messages)


def _read_single(path: Path, split: str) -> Listing:
    data = _load_json(path)
    frames, hint = _parse(data, path)
    present = [frame for frame in frames if frame.path is not None]
    missing = [frame for frame in frames if frame.path is None]
    named = _named_splits(data, path)
    held = named.get("test", named.get("val"))
    if "train" in named and held is not None:
        wanted = named.get(split, held)
        chosen = [f for f in present if f.listed in wanted]
        training = [f for f in present if f.listed in named["train"]]
        return Listing(chosen + [f for f in missing if f.listed in wanted], training, path, hint)
    if not present:
        return Listing(frames, frames, path, hint)
    chosen, training, sentence = hold_out(present, split)
    return Listing(chosen + missing, training, path, hint, [sentence])


def _named_splits(data: Mapping[str, Any], path: Path) -> dict[str, set[str]]:
    """nerfstudio's train_filenames, val_filenames and test_filenames, those that are there."""
    named = {}
    for split in SPLITS:
        names = data.get(f"{split}_filenames")
        if not names:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {split}_filenames must be a list of file names, got {names!r:.60}")
        named[split] = set(names)
    return named


def _read_file(path: Path) -> tuple[list[Frame], BoundsHint]:
    return _parse(_load_json(path), path)


def _load_json(path: Path) -> dict[str, Any]:
    try:
        data = read_json(path)
    except InputError:
        raise
    except ValueError as error:  # a number of more digits than Python converts
        raise InputError(f"{path} is not usable JSON: {error}") from error
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f'{path}: expected a JSON object with a non-empty list "frames"')
    return data


def _parse(data: Mapping[str, Any], path: Path) -> tuple[list[Frame], BoundsHint]:
    finder = ImageFinder(path.parent)
    shared = {key: value for key, value in data.items() if key != "frames"}
    frames = []
    for number, entry in enumerate(data["frames"]):
        where = f"{path}, frame {number}"
        if not isinstance(entry, dict):
            raise InputError(f"{where}: expected an object with file_path and transform_matrix, got {entry!r:.40}")
        listed = entry.get("file_path")
        if not isinstance(listed, str) or not listed or "\0" in listed:
            raise InputError(f"{where}: expected file_path to name an image, got {listed!r:.40}")
        where = f"{where} ({listed})"
        if "transform_matrix" not in entry:
            raise InputError(f"{where}: transform_matrix is missing")
        try:
            c2w = rigid_pose(read_matrix(entry["transform_matrix"]))
            calibration = read_calibration({**shared, **entry})
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        frames.append(Frame(listed, finder.find(listed), c2w, calibration))
    try:
        return frames, _hint(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _hint(data: Mapping[str, Any]) -> BoundsHint:
    aabb = data.get("aabb")
    box = None if aabb is None else check_box(aabb, "aabb")
    scale = finite_number(data, "aabb_scale")
    if scale is not None and scale <= 0:
        raise InputError(f"aabb_scale must be positive, got {scale:g}")
    return BoundsHint(aabb=box, aabb_scale=scale)
