"""The points of a model with their colours: where structure from motion found the same spot in several photographs.

nerfstudio's transforms.json names a PLY file of them (``ply_file_path``). COLMAP's are read from next to the poses,
``points3D.bin`` or ``points3D.txt`` (COLMAP documentation, "Output Format"): id, x y z, r g b, reprojection error in pixels,
and the track, the observations that a point was found by.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_bytes, read_json
from nerfvol.splats.points import PointCloud, read_points

SHORTEST_TRACK = 3
LARGEST_ERROR = 2.0
"""Pixels. Points seen by two photographs alone, or off by more, are as often wrong as right."""
_FARTHEST = 1e15
_ROW = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def points_file(dataset: Dataset) -> Path | None:
    """The file with the points of the model that the dataset's poses are from; None where there is none."""
    source = Path(dataset.source)
    if source.suffix == ".json" and source.is_file():
        named = read_json(source).get("ply_file_path")
        return source.parent / named if isinstance(named, str) and _is_file(source.parent, named) else None
    if source.name not in ("images.bin", "images.txt"):
        return None
    for name in ("points3D" + source.suffix, "points3D.bin", "points3D.txt"):
        if (source.parent / name).is_file():
            return source.parent / name
    return None


def _is_file(folder: Path, name: str) -> bool:
    """Whether the folder has such a PLY file."""
    return "\0" not in name and name.lower().endswith(".ply") and (folder / name).is_file()


def model_points(dataset: Dataset) -> tuple[PointCloud, str]:
    """The model's points and a sentence on what was found; of COLMAP's those with at least 3 observations and an error
    below 2 pixels.

    The cloud is empty where there is no model or no such point; the sentence says so.

    Raises:
        InputError: the file is there and damaged.
    """
    path = points_file(dataset)
    if path is None:
        return PointCloud.empty(), f"{dataset.source} comes without the points of a model"
    if path.suffix.lower() == ".ply":
        cloud = read_points(path)
        return cloud, f"{len(cloud)} points of {path}"
    positions, colours, errors, tracks = _read_binary(path) if path.suffix == ".bin" else _read_text(path)
    good = (tracks >= SHORTEST_TRACK) & (errors < LARGEST_ERROR) & (np.abs(positions) < _FARTHEST).all(axis=1)
    cloud = PointCloud(positions[good], (colours[good] / 255).astype(np.float32))
    return cloud, f"{len(cloud)} of the {len(good)} points of {path} (seen 3 times or more, error below 2 pixels)"


_Columns = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]


def _read_binary(path: Path) -> _Columns:
    data = read_bytes(path)
    truncated = InputError(f"{path}: the file is truncated, or no COLMAP model ({len(data)} bytes)")
    if len(data) < 8:
        raise truncated
    count = int.from_bytes(data[:8], "little")
    if count * _ROW.itemsize > len(data) - 8:
        raise truncated
    rows = np.empty(count, np.int64)
    at, length = 8, struct.Struct("<Q")
    for i in range(count):
        if at + _ROW.itemsize > len(data):
            raise truncated
        rows[i] = at
        at += _ROW.itemsize + 8 * length.unpack_from(data, at + _ROW.itemsize - 8)[0]
    if at > len(data):
        raise truncated
    bytes_at = rows[:, None] + np.arange(_ROW.itemsize)
    table = np.frombuffer(data, np.uint8)[bytes_at].reshape(-1).view(_ROW)
    return table["xyz"].copy(), table["rgb"].astype(np.float64), table["error"].copy(), table["track"].astype(np.int64)


def _read_text(path: Path) -> _Columns:
    rows: list[list[float]] = []
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected the text of a COLMAP model, got bytes that are no text") from None
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            numbers = [float(word) for word in words[1:8]]
            if len(numbers) != 7 or len(words) % 2:
                raise ValueError
        except ValueError:
            fields = "POINT3D_ID X Y Z R G B ERROR TRACK"
            raise InputError(f"{path}: expected {fields}, got {line!r:.60}") from None
        rows.append([*numbers, (len(words) - 8) / 2])
    table = np.array(rows, np.float64).reshape(-1, 8)
    return table[:, :3], np.clip(np.nan_to_num(table[:, 3:6]), 0, 255), table[:, 6], table[:, 7].astype(np.int64)
