"""COLMAP models: cameras, images and points, binary or text, as written by COLMAP into ``sparse/0``.

Poses are world-to-camera in OpenCV axes (x right, y down, z forward), a unit quaternion (w, x, y, z) and a translation;
the centre of the upper left pixel is (1/2, 1/2). Sources: docs/data.md.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import FARTHEST, rigid_pose
from nerfvol.cameras.lens import BrownConrady
from nerfvol.datasets.colmap_files import images_file, points_file, read_cameras, read_images, read_points
from nerfvol.datasets.listing import Frame, ImageFinder, Listing, hold_out
from nerfvol.datasets.llff import image_folder
from nerfvol.datasets.points import ModelPoints
from nerfvol.errors import InputError

_PLACES = ("sparse/0", "colmap/sparse/0", "sparse", ".")
_MOST_POINTS = 20_000  # that are looked at: enough to tell whether poses fit
_AROUND = 1.25  # a lens's distortion may move a point by so much from where a pinhole would show it
_FITTING = (
    0.9  # of the observations, the fewest that lie inside their images; all do where poses and points belong together
)


def find_model(folder: Path) -> Path | None:
    """The folder with cameras.bin and images.bin (or .txt), or None."""
    for place in _PLACES:
        for suffix in (".bin", ".txt"):
            if all((folder / place / f"{stem}{suffix}").is_file() for stem in ("cameras", "images")):
                return folder / place
    return None


def recognises(path: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return find_model(path) is not None


def read(folder: Path, split: str) -> Listing:
    """The listing of one split: every 8th view by name is held out. The largest copy of the photographs is taken.

    Raises:
        InputError: there is no model, it is damaged or holds no images, or a pose or camera cannot be used.
    """
    model = find_model(folder)
    if model is None:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, but found none")
    source, calibrations = images_file(model), read_cameras(model)
    finder = ImageFinder(image_folder(folder))
    frames, numbers = [], []
    for number, name, quaternion, translation, camera in read_images(model):
        if camera not in calibrations:
            raise InputError(f"{source}, image {name}: its camera {camera} is not in the model's cameras")
        try:
            frames.append(Frame(name, finder.find(name), _pose(quaternion, translation), calibrations[camera]))
            numbers.append(number)
        except InputError as error:
            raise InputError(f"{source}, image {name}: {error}") from None
    if not frames:
        raise InputError(f"{source}: the model holds no images")
    present = [frame for frame in frames if frame.path is not None]
    missing = [frame for frame in frames if frame.path is None]
    if not present:
        return Listing(frames, frames, source)
    chosen, training, sentence = hold_out(present, split)
    path = points_file(model)
    listing = Listing(chosen + missing, training, source, messages=[sentence])
    if path is not None:
        listing.messages += _doubt(path, dict(zip(numbers, frames, strict=True)))
        listing.read_points = lambda: model_points(path)
    return listing


def model_points(path: Path) -> ModelPoints:
    """The points of a points3D.bin or points3D.txt. Points that are nowhere (not finite, or beyond 1e15) are left out.

    Raises:
        InputError: the file is damaged.
    """
    rows = ((*point[:7], len(point.track)) for point in read_points(path))
    table = np.fromiter(rows, dtype=np.dtype([*((name, "f8") for name in "xyz"), *((c, "u1") for c in "rgb"),
                                              ("error", "f8"), ("track", "i8")]))  # fmt: skip
    positions = np.stack([table[name] for name in "xyz"], axis=1)
    there = (np.abs(positions) < FARTHEST).all(axis=1)
    colours = np.stack([table[name] for name in "rgb"], axis=1)
    return ModelPoints(positions[there], colours[there], table["track"][there], table["error"][there], str(path))


def _doubt(path: Path, frames: dict[int, Frame]) -> list[str]:
    """A sentence where the model's points lie outside the images that it says show them; ``frames`` by image number."""
    if any(not isinstance(frame.calibration.lens, BrownConrady) for frame in frames.values()):
        return []
    shown: dict[int, list[tuple[float, ...]]] = {}
    for point in itertools.islice(read_points(path), _MOST_POINTS):
        for number in point.track:
            shown.setdefault(number, []).append(point[:3])
    inside = total = 0
    for number, places in shown.items():
        if number not in frames:
            continue
        frame = frames[number]
        lens, (width, height) = frame.calibration, (frame.calibration.width or 0, frame.calibration.height or 0)
        # Distances from the middle of the image, in pixels, times -back: nothing behind a camera is within a negative bound,
        # and a point that is nowhere (NaN, infinity) is in no image.
        with np.errstate(invalid="ignore", over="ignore"):
            right, up, back = ((np.array(places) - frame.c2w[:3, 3]) @ frame.c2w[:3, :3]).T
            x = np.abs((lens.fx or 0) * right - ((lens.cx or 0) - width / 2) * back)
            y = np.abs((lens.fy or 0) * -up - ((lens.cy or 0) - height / 2) * back)
            inside += int(((x < -back * _AROUND * width / 2) & (y < -back * _AROUND * height / 2)).sum())
        total += len(places)
    if not total or inside >= _FITTING * total:
        return []
    return [
        f"{path}: only {100 * inside / total:.0f} % of what its tracks list lies inside the images, by the model's poses: "
        "these are not the poses of the photographs, so expect no picture of them; run COLMAP again"
    ]


def _pose(quaternion: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world (4, 4) in OpenGL axes."""
    length = np.linalg.norm(quaternion) if (np.abs(quaternion) < 2).all() else np.inf
    if not np.isfinite(translation).all() or not abs(length - 1) <= 0.1:
        numbers = " ".join(f"{v:g}" for v in (*quaternion, *translation))
        raise InputError(f"a pose must be a unit quaternion and a finite translation, got {numbers}")
    w, x, y, z = quaternion / length  # COLMAP itself normalises on reading: other tools write lengths like 1.01
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    position = -rotation.T @ translation
    return rigid_pose(np.concatenate([rotation.T * (1, -1, -1), position[:, None]], axis=1))
