"""What else lies in the folder of a set: what nobody reads gets a sentence."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from nerfvol.datasets.formats import FORMATS, Format
from nerfvol.datasets.listing import named

_FOLDERS = {
    "depth", "depths", "depth_maps", "normal", "normals", "normal_maps", "segmentation", "segmentations", "semantic",
    "semantics", "labels", "confidence", "stereo", "flow", "optical_flow", "features", "dslr", "lidar", "imu",
}  # fmt: skip
_FILES = {
    "points3d.ply", "point_cloud.ply", "pointcloud.ply", "points.ply", "background.png", "background.jpg",
    "bbox.txt", "near_far.txt", "scene_gt.json",
}  # fmt: skip


def unread(folder: Path, used: Format) -> list[str]:
    """Sentences on poses in other formats than the one that is ``used``, and on what programs leave beside pictures."""
    if not folder.is_dir():
        return []
    said = []
    others = [row.looks_for for row in FORMATS if row is not used and row.reader.recognises(folder)]
    if others:
        said.append(f"{folder.name} holds {named(others)} too, which is not read: {used.looks_for} comes first")
    if found := sorted(_known(folder, used)):
        said.append(f"beside the images, and not used: {named(found, 6)}")
    return said


def _known(folder: Path, used: Format) -> Iterator[str]:
    for entry in folder.iterdir():
        name = entry.name.lower()
        if entry.is_dir() and name in _FOLDERS:
            yield f"{entry.name}/"
        elif name in _FILES and entry.is_file() and not (used.module == "nsvf" and name == "bbox.txt"):
            yield entry.name
