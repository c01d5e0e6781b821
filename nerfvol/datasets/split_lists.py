"""Which views train and which are held out, as lists say: those of transforms.json, or files that other programs leave beside.

``train.txt``, ``test.txt``, ``val_list.txt``, ...: a name a line (3D Gaussian splatting has test.txt in sparse/0). JSON with
lists ``train``, ``val``, ``test`` or ``train_ids``, ``val_ids``: ``train_test_lists.json`` (ScanNet++), ``splits.json``,
``dataset.json`` (Nerfies).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nerfvol.datasets.formats import SPLITS
from nerfvol.datasets.listing import Frame, hold_out, named
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json, read_text

Lists = dict[str, set[str]]
_TEXT = ("{}.txt", "{}_list.txt", "{}_images.txt", "{}_filenames.txt", "{}_ids.txt")
_JSON = ("train_test_lists.json", "train_test_split.json", "splits.json", "split.json", "dataset.json")
_KEYS = ("{}", "{}_ids", "{}_filenames", "{}_images", "{}_list")


def resolved(names: Sequence[str], listed: Sequence[str]) -> set[str]:
    """The images of ``listed`` that ``names`` mean: by their paths, without suffixes, or by their names alone where that tells;
    a name that is none stays as it is."""
    by_name = {_plain(name): name for name in listed}
    by_end: dict[str, str | None] = {}
    for plain, name in by_name.items():
        for end in {plain.rpartition("/")[2], _stem(plain.rpartition("/")[2])}:
            by_end[end] = None if end in by_end else name
    by_stem = {_stem(plain): name for plain, name in by_name.items()}

    def meant(plain: str) -> str:
        end = plain.rpartition("/")[2]
        found = by_name.get(plain) or by_stem.get(_stem(plain)) or by_end.get(end) or by_end.get(_stem(end))
        return found or plain

    return {meant(_plain(name)) for name in names}


def _plain(name: str) -> str:
    """A path in one spelling."""
    return "/".join(part for part in name.replace("\\", "/").split("/") if part not in ("", "."))


def _stem(plain: str) -> str:
    return plain.rpartition(".")[0] or plain


def chosen_by_lists(
    frames: Sequence[Frame], lists: Lists, split: str, where: Path
) -> tuple[list[Frame], list[Frame], list[str]]:
    """The frames of the split, those that train and have a picture, and sentences.

    Raises:
        InputError: no frame is left for the split; names the file ``where`` the lists are.
    """
    messages = []
    everything = {frame.listed for frame in frames}
    unknown = sorted(name for names in lists.values() for name in names - everything)
    if unknown:
        messages.append(f"{len(unknown)} names in the lists of {where.name} are no frame's: {named(unknown)}")
    taken = lists.get("train")
    held = lists.get("test" if split == "test" else "val") or lists.get("val") or lists.get("test")
    if taken is None:
        taken = everything - set().union(*lists.values())
        messages.append(f"{where.name} lists views to hold out and none to train on: all others are trained on")
    if held is None:
        held = everything - taken
        messages.append(
            f"{where.name} lists views to train on and none to hold out: the {len(held)} others are held out"
        )
    left = everything - taken - set().union(*(lists.get(name, set()) for name in ("val", "test")), held)
    if left:
        messages.append(f"{len(left)} frames are in no list of {where.name} and are not used: {named(sorted(left))}")
    if both := sorted(taken & held):
        messages.append(f"{len(both)} views are trained on and held out too, so that scores flatter: {named(both)}")
    wanted = taken if split == "train" else held
    held_present = any(frame.listed in held and frame.path is not None for frame in frames)
    if not wanted & everything or (split != "train" and not held_present):
        which = "train" if split == "train" else "val"
        raise InputError(
            f"{where}: no frame is left for the {which} views; list some in {which}_filenames, or leave the lists out"
        )
    training = [frame for frame in frames if frame.listed in taken and frame.path is not None]
    return [frame for frame in frames if frame.listed in wanted], training, messages


def split_frames(
    frames: Sequence[Frame], split: str, places: Sequence[Path]
) -> tuple[list[Frame], list[Frame], list[str]]:
    """As :func:`chosen_by_lists` by the lists in the folders ``places``; where there are none every 8th frame is held out.

    Raises:
        InputError: see chosen_by_lists.
    """
    present = [frame for frame in frames if frame.path is not None]
    messages = []
    names = [frame.listed for frame in present]
    for where, found in _lists_of(places):
        lists = {name: resolved(listed, names) for name, listed in found.items()}
        if any(listed & set(names) for listed in lists.values()):
            chosen, training, said = chosen_by_lists(present, lists, split, where)
            told = ", ".join(f"{name} {len(listed & set(names))}" for name, listed in sorted(lists.items()))
            return chosen, training, [*messages, f"split: as {where.name} says ({told})", *said]
        messages.append(f"{where.name} is not used: none of its names is an image's")
    chosen, training, sentence = hold_out(present, split)
    return chosen, training, [*messages, sentence]


def _lists_of(places: Sequence[Path]) -> list[tuple[Path, dict[str, list[str]]]]:
    """The lists in the folders: a file that names them, the names by split."""
    found = []
    for place in dict.fromkeys(places):
        for pattern in _TEXT:
            files = {name: place / pattern.format(name) for name in SPLITS if (place / pattern.format(name)).is_file()}
            lists = {name: _lines(file) for name, file in files.items()}
            if lists := {name: lines for name, lines in lists.items() if lines}:
                found.append((next(files[name] for name in lists), lists))
        for name in _JSON:
            if (place / name).is_file() and (lists := _of_document(read_json(place / name))):
                found.append((place / name, lists))
    return found


def _lines(path: Path) -> list[str]:
    try:
        text = read_text(path)
    except UnicodeDecodeError:
        return []
    return [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]


def _of_document(document: Any) -> dict[str, list[str]]:
    """The lists of names in a JSON document; none where it has no such."""
    if not isinstance(document, Mapping):
        return {}
    found = {}
    for split in SPLITS:
        for key in _KEYS:
            value = document.get(key.format(split))
            if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
                found[split] = value
                break
    return found
