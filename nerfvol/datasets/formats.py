"""The formats of posed images, one row each: a further format is one file of this folder and one row here.

Free of numpy, so that help and mistakes answer at once: a row names its file, which is imported when first asked.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.datasets.listing import Listing

SPLITS = ("train", "val", "test")


class Reader(Protocol):
    """What the file of a format defines."""

    def recognises(self, path: Path, /) -> bool:
        """Whether ``path``, a folder or a file, is in this format; looks at names only."""
        ...

    def read(self, path: Path, split: str, /) -> Listing:
        """The listing of one of SPLITS; InputError, one sentence that names the file, where it cannot be used."""
        ...


@dataclass(frozen=True)
class Format:
    """``name``: who writes it. ``looks_for``: by which files it is known, without an article. ``module``: its Reader."""

    name: str
    looks_for: str
    module: str

    @property
    def reader(self) -> Reader:
        """The format's file, imported now."""
        return cast(Any, importlib.import_module(f"{__package__}.{self.module}"))


FORMATS = (
    Format("NeRF-synthetic, instant-ngp, nerfstudio", "transforms.json or transforms_train.json", "transforms"),
    Format("LLFF", "poses_bounds.npy", "llff"),
    Format("COLMAP", "cameras and images in sparse/0", "colmap"),
    Format("NSVF, BlendedMVS", "intrinsics.txt next to pose and rgb", "nsvf"),
)
"""In this order: a folder that several recognise is read by the first."""


def formats_help() -> str:
    """What a folder of posed images may hold, for the help of an option that takes one."""
    *others, last = (f"{row.looks_for} ({row.name})" for row in FORMATS)
    return f"posed images: a folder with {', '.join(others)}, or {last}"


def find_format(path: Path) -> Format:
    """The row that recognises ``path``; InputError where none does."""
    if not path.exists():
        raise InputError(f"{path}: expected a folder with posed images, but there is no such folder")
    for row in FORMATS:
        if row.reader.recognises(path):
            return row
    *others, last = (f"no {row.looks_for}" for row in FORMATS)
    raise InputError(f"{path}: expected posed images, but found {', '.join(others)} and {last}{_what_there_is(path)}")


_ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".gz", ".7z", ".rar", ".bz2", ".xz")
_OTHER_PROGRAMS = {
    "keyframes": "Polycam's raw data, which `ns-process-data polycam` converts",
    "rgbd": "Record3D's, which `ns-process-data record3d` converts",
    "cameras_sphere.npz": "IDR's and NeuS' (DTU), which is not read",
    "opensfm": "OpenDroneMap's, which `ns-process-data odm` converts",
    "reconstruction.json": "OpenSfM's, which `opensfm export_colmap` converts",
    "cameras.xml": "Metashape's, which `ns-process-data metashape` converts",
    "cameras.sfm": "Meshroom's, which is not read",
    "bundle.out": "Bundler's, which is not read",
    "groundtruth.txt": "TUM's tracks, which are not read",
    "database.db": "COLMAP's of features and matches: poses are in the model that its mapper writes, which is missing",
    "pose": "ScanNet's, 7-Scenes' or NSVF's without intrinsics.txt, which is not read",
}
"""By what a folder of other programs is known, whose it is, and what makes of it something that is read."""


def _what_there_is(path: Path) -> str:
    """The end of a sentence on what no format recognises: where one lies near it, or whose it looks like."""
    if path.name.lower().endswith(_ARCHIVES):
        return "; it is an archive: unpack it first"
    if path.is_file():
        return "; poses of a video or of photographs are found by `nerfvol capture`"
    try:
        below = [entry for entry in path.iterdir() if entry.is_dir() and entry.name != "__MACOSX"]
        below += [entry for folder in below for entry in folder.iterdir() if entry.is_dir()]
    except OSError:
        return ""
    if near := [
        place for place in (path.parent, *sorted(below)) if any(row.reader.recognises(place) for row in FORMATS)
    ]:
        return f"; {' and '.join(map(str, near[:3]))} {'is one' if len(near) == 1 else 'are such'}"
    for name, whose in _OTHER_PROGRAMS.items():
        if (path / name).exists():
            return f"; {name} is {whose}"
    names = sorted(entry.name for entry in path.iterdir() if not entry.name.startswith("."))
    if packed := [name for name in names if name.lower().endswith(_ARCHIVES)]:
        return f"; {packed[0]} is an archive: unpack it first"
    if stated := [name for name in names if name.lower().endswith(".json") and "transforms" in name.lower()]:
        return f"; is {stated[0]} meant? Name the file itself"
    suffixes = (".jpg", ".jpeg", ".png", ".heic")
    if any(entry.suffix.lower() in suffixes for folder in (path, path / "images") for entry in folder.glob("*")):
        return "; of photographs without poses, `nerfvol capture` or --poses auto finds them"
    return ""
