"""COLMAP models: cameras, images and points, binary or text, as written by COLMAP into ``sparse/0``, ``sparse/1``, ...

Poses are world-to-camera in OpenCV axes (x right, y down, z forward), a unit quaternion (w, x, y, z) and a translation;
the centre of the upper left pixel is (1/2, 1/2). Sources: docs/data.md.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.lens import BrownConrady
from nerfvol.cameras.pose import FARTHEST, rigid_pose
from nerfvol.datasets.colmap_files import (
    PointRecord,
    count_images,
    images_file,
    model_files,
    points_file,
    read_cameras,
    read_images,
    read_points,
)
from nerfvol.datasets.listing import Frame, ImageFinder, Listing, Poses, is_photograph, named
from nerfvol.datasets.llff import image_folder
from nerfvol.datasets.masks import MaskFinder
from nerfvol.datasets.points import ModelPoints
from nerfvol.datasets.split_lists import split_frames
from nerfvol.errors import InputError
from nerfvol.files.entry import entry

_PLACES = ("sparse", "colmap/sparse", "distorted/sparse", ".")
_MOST_POINTS = 20_000  # that are looked at: enough to tell whether poses fit
_AROUND = 1.25  # a lens's distortion may move a point by so much from where a pinhole would show it
_LARGE_ERROR = 2.0  # pixels: the middle reprojection error of a model's points is 0.4 to 1.2 where poses are good
_FITTING = (
    0.9  # of the observations, the fewest that lie inside their images; all do where poses and points belong together
)


def find_models(folder: Path) -> list[Path]:
    """The folders with cameras.bin and images.bin (or .txt) where COLMAP and its users put them, in order of their names."""
    found = []
    for place in _PLACES:
        inside = functools.reduce(entry, place.split("/"), folder)
        try:
            below = sorted(model for model in inside.iterdir() if model.is_dir()) if place != "." else []
        except OSError:
            continue
        below.sort(key=lambda model: (not model.name.isdigit(), int(model.name) if model.name.isdecimal() else 0))
        found += [model for model in (*below, inside) if model_files(model) is not None]
    return found


def recognises(path: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return bool(find_models(path))


def _largest(folder: Path, models: list[Path]) -> tuple[Path, list[str]]:
    """The model with the most images, for the mapper numbers them in the order it begins them; and a sentence on others."""
    counts = {}
    for model in models:
        try:
            counts[model] = count_images(model)
        except InputError:
            if len(models) == 1:
                raise
            counts[model] = -1  # damaged: another may do
    best = max(models, key=lambda model: counts[model])
    if len(models) == 1:
        return best, []
    others = named([f"{model.relative_to(folder)} ({max(counts[model], 0)})" for model in models if model != best])
    return best, [
        f"{len(models)} COLMAP models: {best.relative_to(folder)} with {counts[best]} images is used, not {others}"
    ]


def read(folder: Path, split: str) -> Listing:
    """The listing of one split: every 8th view by name is held out. The largest model and copy of the photographs are taken.

    Raises:
        InputError: there is no model, it is damaged or holds no images, or a pose or camera cannot be used.
    """
    models = find_models(folder)
    if not models:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, but found none")
    model, messages = _largest(folder, models)
    source, calibrations = images_file(model), read_cameras(model)
    if source.suffix.lower() == ".bin" and entry(model, "images.txt").is_file():
        messages.append(f"{model.relative_to(folder)} holds a model as text too, which is not read")
    photographs = _photographs(folder, source)
    finder, masks, poses = ImageFinder(photographs), MaskFinder(folder, photographs), Poses(source)
    frames, numbers, known = [], [], set()
    for number, name, quaternion, translation, camera in read_images(model):
        path = finder.find(name)
        known.add(path)
        try:
            if camera not in calibrations:
                raise InputError(f"its camera {camera} is not in the model's cameras")
            c2w = poses.read(name, _pose(quaternion, translation))
        except InputError as error:
            poses.leave_out(type(error)(f"{source}, image {name}: {error}"))
            continue
        if c2w is not None:
            frames.append(Frame(name, path, c2w, calibrations[camera], masks.of(name, path)))
            numbers.append(number)
    messages += poses.messages()
    listed = Counter(frame.listed for frame in frames)
    if twice := [name for name, count in listed.items() if count > 1]:
        messages.append(
            f"{len(twice)} images are in the model more than once, each with a pose of its own: {named(twice)}"
        )
    if not frames:
        raise InputError(f"{source}: the model holds no images")
    present = [frame for frame in frames if frame.path is not None]
    missing = [frame for frame in frames if frame.path is None]
    if not present:
        return Listing(frames, frames, source)
    messages += masks.messages(present) + _in_no_model(photographs, known)
    chosen, training, said = split_frames(present, split, [folder, model, model.parent, photographs])
    path = points_file(model)
    if path is None and (model / "points3D.ply").is_file():
        messages.append("points3D.ply is not read, and points3D.bin is not there: the model's points are not known")
    listing = Listing(chosen + missing, training, source, messages=messages + said)
    if path is not None:
        listing.messages += _doubt(path, dict(zip(numbers, frames, strict=True)))
        listing.read_points = lambda: model_points(path)
    return listing


def _photographs(folder: Path, source: Path) -> Path:
    """Where the photographs of the model of ``source`` lie: in ``folder`` or, where that is the model's own, above it."""
    name = next((record.name for record in read_images(source.parent)), "")
    homes = (folder, folder.parent, folder.parent.parent) if source.parent == folder else (folder,)
    found = [image_folder(home) for home in homes]
    found += sorted(entry for home in homes[:1] for entry in home.iterdir() if entry.is_dir())  # whatever it is called
    return next((place for place in found if ImageFinder(place).find(name) is not None), image_folder(folder))


def _in_no_model(photographs: Path, known: set[Path | None]) -> list[str]:
    """A sentence on photographs of the folder that the model, which names those ``known``, does not have."""
    folders = {path.parent for path in known if path is not None} | {photographs}
    everything = {entry for folder in folders for entry in folder.iterdir() if is_photograph(entry) and entry.is_file()}
    left = sorted(entry.name for entry in everything - known)
    if not left:
        return []
    return [f"{len(left)} of {len(everything)} photographs are not in the model, and are left out: {named(left)}"]


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
    """Sentences where the model's points lie outside the images that it says show them, or beside what these show;
    ``frames`` by image number."""
    points = list(itertools.islice(read_points(path), _MOST_POINTS))
    errors = [point.error for point in points if point.error > 0]  # COLMAP writes -1 where it has not computed any
    doubts = []
    if errors and (middle := float(np.median(errors))) > _LARGE_ERROR:
        doubts = [
            f"{path}: half of its points are {middle:.1f} pixels or more from where the photographs show them, where 1 is "
            "usual: the poses fit badly, so expect blur; find them anew (nerfvol poses), or try --refine-poses"
        ]
    return doubts + _outside(path, points, frames)


def _outside(path: Path, points: Sequence[PointRecord], frames: dict[int, Frame]) -> list[str]:
    """A sentence where the points lie outside the images that the model says show them."""
    if any(not isinstance(frame.calibration.lens, BrownConrady) for frame in frames.values()):
        return []
    shown: dict[int, list[tuple[float, ...]]] = {}
    for point in points:
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
    """Camera-to-world (4, 4) in OpenGL axes; NaN where the file's numbers are not finite."""
    if not (np.isfinite(translation).all() and np.isfinite(quaternion).all()):
        return np.full((4, 4), np.nan)
    length = np.linalg.norm(quaternion) if (np.abs(quaternion) < 2).all() else np.inf
    if not abs(length - 1) <= 0.1:
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
