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
    raise InputError(f"{path}: expected posed images, but found {', '.join(others)} and {last}")
