"""Files by their names, however a disk or an archive spelt them."""

from __future__ import annotations

from pathlib import Path


def entry(folder: Path, name: str) -> Path:
    """What ``folder`` holds as ``name``, else the first by name in other letters (``Transforms.JSON``); where there is
    neither, the path that ``name`` would have."""
    path = folder / name
    if path.exists():
        return path
    try:
        others = [other for other in folder.iterdir() if other.name.lower() == name.lower()]
    except OSError:  # no folder, or not to be read: there is no such file in it
        return path
    return min(others, default=path)
