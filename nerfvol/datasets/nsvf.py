"""NSVF: ``intrinsics.txt`` next to ``pose/*.txt`` and ``rgb/*.png``, as NSVF's scenes and its BlendedMVS and Tanks and
Temples come.

A pose is a camera-to-world 4x4 matrix in OpenCV axes (x right, y down, z forward), named like its image. Names begin with
0_ for training, 1_ for validation, 2_ for test. Source: docs/data.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.listing import MOST_LOST, Frame, Listing, Poses, hold_out, is_photograph, named
from nerfvol.datasets.masks import MaskFinder
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_text
from nerfvol.region import check_box

INTRINSICS, BOX = "intrinsics.txt", "bbox.txt"
_IMAGES, _POSES = "rgb", "pose"
_PREFIXES: dict[str, str] = {"0_": "train", "1_": "val", "2_": "test"}


def recognises(path: Path) -> bool:
    """Whether the folder has NSVF's file and two folders."""
    return (path / INTRINSICS).is_file() and all((path / name).is_dir() for name in (_IMAGES, _POSES))


def read(folder: Path, split: str) -> Listing:
    """The listing of one split, by the first two letters of the images' names; without such every 8th is held out.

    Where only one of validation and test exists it is used for both. ``bbox.txt``, where there is one, is the aabb.

    Raises:
        InputError: there are no images, one has no pose, or a file of intrinsics, pose or box cannot be used.
    """
    calibration, source = _calibration(folder / INTRINSICS), folder / INTRINSICS
    hint = BoundsHint(aabb=_box(folder / BOX) if (folder / BOX).is_file() else None)
    frames: dict[str, list[Frame]] = {}
    everything = []
    poses, masks = Poses(folder / _POSES), MaskFinder(folder, folder / _IMAGES)
    images = sorted(p for p in (folder / _IMAGES).iterdir() if is_photograph(p))
    bare = [image.name for image in images if not (folder / _POSES / f"{image.stem}.txt").is_file()]
    if len(bare) > MOST_LOST * len(images):
        raise InputError(f"{folder / _POSES}: {len(bare)} of {len(images)} images have no pose there ({named(bare)})")
    for image in images:
        if image.name in bare:
            continue
        try:
            c2w = _pose(poses, image.name, folder / _POSES / f"{image.stem}.txt")
        except InputError as error:
            poses.leave_out(error)
            continue
        if c2w is None:
            continue
        frame = Frame(image.name, image, c2w, calibration, masks.of(image.name, image))
        everything.append(frame)
        frames.setdefault(_PREFIXES.get(image.name[:2], ""), []).append(frame)
    without = [f"{len(bare)} of {len(images)} images have no pose in {_POSES}, and are left out: {named(bare)}"]
    said = (without if bare else []) + poses.messages() + masks.messages(everything) + _without_image(folder)
    if not everything:
        raise InputError(f"{folder / _IMAGES}: expected images, but there are none")
    if "" in frames or "train" not in frames or len(frames) == 1:
        chosen, training, sentence = hold_out(everything, split)
        return Listing(chosen, training, source, hint, [*said, sentence])
    if split in frames:
        return Listing(frames[split], frames["train"], source, hint, said)
    other = {"val": "test", "test": "val"}[split]
    message = f"no image is named for the {split} views: the {other} views are used instead"
    return Listing(frames[other], frames["train"], source, hint, [*said, message])


def _rows(path: Path) -> list[list[float]]:
    """The numbers of a text file, line by line, with or without commas; empty lines drop out."""
    try:
        rows = [[float(word) for word in line.replace(",", " ").split()] for line in read_text(path).splitlines()]
    except ValueError:  # UnicodeDecodeError is one
        raise InputError(f"{path}: expected lines of numbers, got other text") from None
    return [row for row in rows if row]


def _matrix(path: Path, rows: list[list[float]]) -> NDArray[np.float64]:
    """A 4x4, 3x4 or 3x3 matrix from its rows, or a square one from 16 or 9 numbers in one."""
    if len(rows) == 1 and len(rows[0]) in (9, 16):
        return np.array(rows[0]).reshape(4 if len(rows[0]) == 16 else 3, -1)
    shape = (len(rows), len(rows[0]) if rows else 0)
    if shape not in ((4, 4), (3, 4), (3, 3)) or any(len(row) != shape[1] for row in rows):
        raise InputError(
            f"{path}: expected a 4x4 matrix, got {len(rows)} rows of {sorted({len(r) for r in rows})} numbers"
        )
    return np.array(rows)


def _calibration(path: Path) -> Calibration:
    """fx, fy, cx, cy in pixels from a matrix, or from a first line f, cx, cy, 0 as older files have it; no distortion."""
    rows = _rows(path)
    if len(rows) > 1 and len(rows[0]) == 4 and len(rows[1]) != 4:
        fx = fy = rows[0][0]
        cx, cy = rows[0][1:3]
    else:
        matrix = _matrix(path, rows)
        fx, fy, cx, cy = (float(matrix[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Calibration(fx=fx, fy=fy, cx=cx, cy=cy)


def _without_image(folder: Path) -> list[str]:
    """A sentence on poses that no image has."""
    images = {path.stem for path in (folder / _IMAGES).iterdir() if is_photograph(path)}
    left = sorted(
        p.name for p in (folder / _POSES).glob("*.txt") if p.stem not in images and not p.name.startswith(".")
    )
    return [f"{len(left)} poses are of no image in {_IMAGES}, and are left out: {named(left)}"] if left else []


def _pose(poses: Poses, listed: str, path: Path) -> NDArray[np.float64] | None:
    matrix = _matrix(path, _rows(path))
    try:
        matrix[:3, 1:3] *= -1  # OpenCV axes to OpenGL axes
        return poses.read(listed, matrix)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def _box(path: Path) -> NDArray[np.float64]:
    """The first six numbers of bbox.txt: two corners; a seventh is the side of NSVF's first voxels."""
    numbers = [number for row in _rows(path) for number in row]
    try:
        return check_box(numbers[:6], "the box")
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
