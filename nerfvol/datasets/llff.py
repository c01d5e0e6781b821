"""LLFF: ``poses_bounds.npy`` next to a folder of photographs (``images``, ``images_4``, ``images_8``, ...).

Each row holds 17 numbers: a 3x5 matrix, row by row, and the near and far depth of what the image sees. The matrix is a
camera-to-world pose whose axes are (down, right, backwards), and a last column (height, width, focal length) of the
original photographs. Source: docs/data.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.datasets.bounds import BoundsHint
from nerfvol.datasets.colmap_files import read_images
from nerfvol.datasets.images import SUFFIXES
from nerfvol.datasets.listing import PHOTOGRAPHS, Frame, Listing, Poses, is_photograph, named
from nerfvol.datasets.masks import MaskFinder
from nerfvol.datasets.split_lists import split_frames
from nerfvol.errors import InputError
from nerfvol.files.entry import entry
from nerfvol.files.numpyfile import read_npy

POSES = "poses_bounds.npy"


def recognises(path: Path) -> bool:
    """Whether the folder holds LLFF poses."""
    return entry(path, POSES).is_file()


def read(folder: Path, split: str) -> Listing:
    """The listing of one split: every 8th view by name is held out. The largest copy of the photographs is taken.

    Raises:
        InputError: the file of poses is damaged, does not have as many as there are images, or holds a pose, lens or range
            of depths that cannot be used.
    """
    path = entry(folder, POSES)
    rows = _load_rows(path)
    images = image_folder(folder)
    names = sorted(entry.name for entry in images.iterdir() if is_photograph(entry))
    poses, masks = Poses(path), MaskFinder(folder, images)
    said = []
    if len(names) != len(rows):
        names, said = _registered(folder, images, names, len(rows))
    frames = []
    for name, row in zip(names, rows, strict=True):
        matrix = row[:15].reshape(3, 5)
        down, right, back, position = matrix[:, :4].T
        try:
            calibration = _calibration(matrix[:, 4])
            c2w = poses.read(name, np.stack([right, -down, back, position], axis=1))
            if c2w is not None:
                frames.append(Frame(name, images / name, c2w, calibration, masks.of(name, images / name)))
        except InputError as error:
            poses.leave_out(type(error)(f"{path}, image {name}: {error}"))
    said += poses.messages() + masks.messages(frames)
    chosen, training, split_said = split_frames(frames, split, [folder])
    depths = rows[(rows[:, 15] > 0) & (rows[:, 15] < rows[:, 16]) & (rows[:, 16] < 1e15), 15:]
    if not len(depths):
        near, far = rows[0, 15:]
        raise InputError(f"{path}: expected finite depths with 0 < near < far, got {near:g} and {far:g}")
    if len(depths) < len(rows):
        said.append(f"{len(rows) - len(depths)} of {len(rows)} rows of {path.name} state no depths with 0 < near < far: the "
                    "others' count")  # fmt: skip
    near, far = float(depths[:, 0].min()), float(depths[:, 1].max())
    return Listing(chosen, training, path, BoundsHint(near_far=(near, far)), said + split_said)


def _registered(folder: Path, images: Path, names: list[str], count: int) -> tuple[list[str], list[str]]:
    """The photographs that have poses, in order, by the COLMAP model that the poses were made from; and a sentence.

    Raises:
        InputError: there is no such model, or it does not have as many images as there are poses.
    """
    one = _one_of_each(names, count)
    if one is not None:
        return one, [f"{images.name} holds each photograph as {named(sorted({Path(n).suffix for n in names}))}: "
                     f"{Path(one[0]).suffix} is used"]  # fmt: skip
    wrong = f"{folder / POSES}: holds {count} poses, but {images.name} holds {len(names)} images"
    sparse, names_of = entry(folder, "sparse"), ("images.bin", "images.txt")
    models = [entry(sparse, "0"), sparse]
    model = next((m for m in models if any(entry(m, name).is_file() for name in names_of)), None)
    if model is None:
        raise InputError(
            f"{wrong}, so that which pose is whose is not known; take out the images that structure from motion left out, or "
            "keep the COLMAP model in sparse/0 next to them"
        )
    listed = sorted(record.name for record in read_images(model))
    if len(listed) != count or not set(listed) <= set(names):
        raise InputError(f"{wrong}, and the model in {model} lists {len(listed)}; convert it to poses again")
    left = sorted(set(names) - set(listed))
    return listed, [
        f"{len(left)} images have no pose, as {model.relative_to(folder)} says, and are left out: {named(left)}"
    ]


def _one_of_each(names: list[str], count: int) -> list[str] | None:
    """The names of one suffix, the first of SUFFIXES, where all ``count`` photographs are there under each of several."""
    by_suffix: dict[str, list[str]] = {}
    for name in names:
        by_suffix.setdefault(Path(name).suffix.lower(), []).append(name)
    stems = {tuple(Path(name).stem for name in group) for group in by_suffix.values()}
    if len(by_suffix) < 2 or len(stems) > 1 or len(names) != count * len(by_suffix):
        return None
    return by_suffix[min(by_suffix, key=SUFFIXES.index)]


def image_folder(folder: Path) -> Path:
    """images, or the least reduced of images_2, images_4, ..., in any case; else input, as Gaussian splatting's scripts call
    it, image, rgb or color; a folder without them holds the photographs itself."""
    factors = {}
    for inside in sorted(folder.iterdir()):
        factor = PHOTOGRAPHS.fullmatch(inside.name.lower())
        if factor is not None and inside.is_dir():
            factors[inside] = np.inf if factor[2] else int(factor[1] or 1)
    return min(factors, key=lambda inside: factors[inside]) if factors else folder


def _load_rows(path: Path) -> NDArray[np.float64]:
    rows = read_npy(path, "a numpy array of poses")
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise InputError(f"{path}: expected an array of shape (views, 17), got {rows.shape}")
    if not np.issubdtype(rows.dtype, np.floating):
        raise InputError(f"{path}: expected floating-point numbers, got {rows.dtype}")
    rows, stated = rows.copy(), np.isfinite(rows[:, [4, 9, 14]]).all(axis=1)
    lost = ~stated & ~np.isfinite(rows[:, :15]).any(axis=1)
    if stated.any():  # a view without a pose is left out later, whatever its lens
        rows[np.ix_(lost, np.array([4, 9, 14]))] = rows[stated.argmax(), [4, 9, 14]]
    if not stated.any():
        raise InputError(f"{path}: expected finite sizes and focal lengths, got NaN or infinity")
    return rows.astype(np.float64)


def _calibration(column: NDArray[np.float64]) -> Calibration:
    height, width, focal = map(float, column)
    if not np.isfinite(column).all():
        raise InputError(f"expected a finite size and focal length, got {width:g}x{height:g} and {focal:g}")
    if min(height, width) < 1 or height != int(height) or width != int(width):
        raise InputError(f"the image size must be whole numbers of pixels, got {width:g}x{height:g}")
    return Calibration(width=int(width), height=int(height), fx=focal, fy=focal, resizable=True)
