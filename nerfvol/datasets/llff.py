"""LLFF: ``poses_bounds.npy`` next to a folder of photographs (``images``, ``images_4``, ``images_8``, ...).

Each row holds 17 numbers: a 3x5 matrix, row by row, and the near and far depth of what the image sees. The matrix is a
camera-to-world pose whose axes are (down, right, backwards), and a last column (height, width, focal length) of the
original photographs. Source: docs/data.md.
"""

from __future__ import annotations

import struct
import tokenize
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.cameras.camera import rigid_pose
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.images import SUFFIXES
from nerfvol.datasets.listing import Frame, Listing, hold_out
from nerfvol.errors import InputError

POSES = "poses_bounds.npy"
# numpy parses the header as Python literals, so a damaged one can raise whatever that parser does
_LOAD_ERRORS = (
    OSError, ValueError, EOFError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError, OverflowError,
    struct.error, tokenize.TokenError, zipfile.BadZipFile,
)  # fmt: skip


def recognises(path: Path) -> bool:
    """Whether the folder holds LLFF poses."""
    return (path / POSES).is_file()


def read(folder: Path, split: str) -> Listing:
    """The listing of one split: every 8th view by name is held out. The largest copy of the photographs is taken.

    Raises:
        InputError: the file of poses is damaged, does not have as many as there are images, or holds a pose, lens or range
            of depths that cannot be used.
    """
    path = folder / POSES
    rows = _load_rows(path)
    images = image_folder(folder)
    names = sorted(entry.name for entry in images.iterdir() if entry.suffix.lower() in SUFFIXES)
    if len(names) != len(rows):
        raise InputError(f"{path}: holds {len(rows)} poses, but {images.name} holds {len(names)} images")
    frames = []
    for name, row in zip(names, rows, strict=True):
        matrix = row[:15].reshape(3, 5)
        down, right, back, position = matrix[:, :4].T
        try:
            c2w = rigid_pose(np.stack([right, -down, back, position], axis=1))
            frames.append(Frame(name, images / name, c2w, _calibration(matrix[:, 4])))
        except InputError as error:
            raise InputError(f"{path}, image {name}: {error}") from None
    chosen, training, sentence = hold_out(frames, split)
    near, far = float(rows[:, 15].min()), float(rows[:, 16].max())
    if not 0 < near < far < 1e15:
        raise InputError(f"{path}: expected finite depths with 0 < near < far, got {near:g} and {far:g}")
    return Listing(chosen, training, path, BoundsHint(near_far=(near, far)), [sentence])


def image_folder(folder: Path) -> Path:
    """images, or the least reduced of images_2, images_4, ...; a folder without them holds the photographs itself."""
    found = [entry for entry in folder.iterdir() if entry.is_dir() and entry.name.startswith("images")]
    factors = {entry: entry.name.removeprefix("images").removeprefix("_") or "1" for entry in found}
    usable = [entry for entry in found if factors[entry].isdigit()]
    return min(usable, key=lambda entry: int(factors[entry])) if usable else folder


def _load_rows(path: Path) -> NDArray[np.float64]:
    try:
        rows = np.load(path, allow_pickle=False)
    except _LOAD_ERRORS as error:
        raise InputError(f"{path}: expected a numpy array of poses, but it cannot be read ({error})") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise InputError(f"{path}: expected an array of shape (views, 17), got {getattr(rows, 'shape', type(rows))}")
    if not np.issubdtype(rows.dtype, np.floating) or not np.isfinite(rows).all():
        raise InputError(f"{path}: expected finite floating-point numbers, got {rows.dtype} with NaN or infinity")
    return rows.astype(np.float64)


def _calibration(column: NDArray[np.float64]) -> Calibration:
    height, width, focal = map(float, column)
    if min(height, width) < 1 or height != int(height) or width != int(width):
        raise InputError(f"the image size must be whole numbers of pixels, got {width:g}x{height:g}")
    return Calibration(width=int(width), height=int(height), fx=focal, fy=focal, resizable=True)
