"""COLMAP models: cameras, images and points, binary or text, as written by COLMAP into ``sparse/0``.

Poses are world-to-camera in OpenCV axes (x right, y down, z forward), a unit quaternion (w, x, y, z) and a translation;
the centre of the upper left pixel is (1/2, 1/2). Sources: docs/data.md.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.cameras.camera import rigid_pose
from nerfvol.cameras.lens import BrownConrady, Fisheye, Lens
from nerfvol.datasets.listing import Frame, ImageFinder, Listing, hold_out
from nerfvol.datasets.llff import image_folder
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_bytes

_PLACES = ("sparse/0", "colmap/sparse/0", "sparse", ".")
# COLMAP's model ids, the lens they are, their parameters in its order; f stands for both focal lengths. What the lens has no
# coefficient for must be zero.
_MODELS: dict[str, tuple[int, type[Lens], str]] = {
    "SIMPLE_PINHOLE": (0, BrownConrady, "f cx cy"),
    "PINHOLE": (1, BrownConrady, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, BrownConrady, "f cx cy k1"),
    "RADIAL": (3, BrownConrady, "f cx cy k1 k2"),
    "OPENCV": (4, BrownConrady, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, Fisheye, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, BrownConrady, "fx fy cx cy k1 k2 p1 p2 k3 rational4 rational5 rational6"),
    "SIMPLE_RADIAL_FISHEYE": (8, Fisheye, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, Fisheye, "f cx cy k1 k2"),
}
_NAMES = {number: name for name, (number, *_) in _MODELS.items()}
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
    """The listing of one split: every 8th view by name is held out. The largest copy of the photographs is taken."""
    model = find_model(folder)
    if model is None:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, but found none")
    binary = (model / "cameras.bin").is_file() and (model / "images.bin").is_file()
    source = model / ("images.bin" if binary else "images.txt")
    calibrations = _binary_cameras(model / "cameras.bin") if binary else _text_cameras(model / "cameras.txt")
    finder = ImageFinder(image_folder(folder))
    frames, numbers = [], []
    for number, name, quaternion, translation, camera in _binary_images(source) if binary else _text_images(source):
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
    doubt = _doubt(model, dict(zip(numbers, frames, strict=True)))
    return Listing(chosen + missing, training, source, messages=[sentence, *doubt])


def _doubt(model: Path, frames: dict[int, Frame]) -> list[str]:
    """A sentence where the model's points lie outside the images that it says show them; ``frames`` by image number."""
    binary = model / "points3D.bin"
    path = binary if binary.is_file() else model / "points3D.txt"
    if not path.is_file() or any(not isinstance(frame.calibration.lens, BrownConrady) for frame in frames.values()):
        return []
    shown: dict[int, list[tuple[float, ...]]] = {}
    points = _binary_points(path) if path == binary else _text_points(path)
    for place, track in itertools.islice(points, _MOST_POINTS):
        for number in track:
            shown.setdefault(number, []).append(place)
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


def _calibration(model: str, width: int, height: int, parameters: tuple[float, ...]) -> Calibration:
    _, lens, names = _MODELS[model]
    values = dict(zip(names.split(), parameters, strict=True))
    rational = [name for name in ("rational4", "rational5", "rational6") if values.get(name)]
    if rational:
        raise InputError("the rational terms k4, k5, k6 of FULL_OPENCV are not supported; export undistorted images")
    if not all(np.isfinite(parameters)) or min(width, height) < 1:
        raise InputError(f"a camera must have a size and finite parameters, got {width}x{height} and {parameters}")
    focal = values.get("f")
    return Calibration(
        width=width,
        height=height,
        fx=values.get("fx", focal),
        fy=values.get("fy", focal),
        cx=values["cx"],
        cy=values["cy"],
        lens=lens(**{name: values[name] for name in lens.names() if name in values}),
        resizable=True,
    )


class _Cursor:
    """Reads little-endian values and refuses to run past the end."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        self.require(size)
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return values

    def require(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise InputError(f"{self.path}: the file is truncated, or no COLMAP model ({len(self.data)} bytes)")

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path}: the file is truncated: an image name has no end")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(f"{self.path}: expected an image name, got bytes that are no text") from None


def _binary_cameras(path: Path) -> dict[int, Calibration]:
    cursor = _Cursor(path)
    found = {}
    for _ in range(cursor.take("Q")[0]):
        camera, number, width, height = cursor.take("iiQQ")
        if number not in _NAMES:
            known = ", ".join(_MODELS)
            raise InputError(f"{path}, camera {camera}: lens model {number} is not supported; known models: {known}")
        model = _NAMES[number]
        found[camera] = _checked(path, camera, model, width, height, cursor.take(f"{len(_MODELS[model][2].split())}d"))
    return found


def _text_cameras(path: Path) -> dict[int, Calibration]:
    found = {}
    for line in _lines(path):
        if not line:
            continue
        try:
            camera, model, width, height, *parameters = line.split()
            numbers = int(camera), int(width), int(height), tuple(map(float, parameters))
        except ValueError:
            raise InputError(f"{path}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line!r:.60}") from None
        if model not in _MODELS or len(numbers[3]) != len(_MODELS[model][2].split()):
            raise InputError(f"{path}, camera {camera}: unknown lens model or wrong number of parameters: {line!r:.60}")
        found[numbers[0]] = _checked(path, numbers[0], model, *numbers[1:])
    return found


def _checked(path: Path, camera: int, model: str, width: int, height: int, parameters: tuple) -> Calibration:
    try:
        return _calibration(model, width, height, parameters)
    except InputError as error:
        raise InputError(f"{path}, camera {camera}: {error}") from None


_Image = tuple[int, str, NDArray[np.float64], NDArray[np.float64], int]  # number, name, quaternion, translation, camera
_Point = tuple[tuple[float, ...], Sequence[int]]  # place, numbers of the images that show it


def _binary_images(path: Path) -> Iterator[_Image]:
    cursor = _Cursor(path)
    for _ in range(cursor.take("Q")[0]):
        values = cursor.take("i7di")
        name = cursor.name()
        observations = 24 * cursor.take("Q")[0]  # (x, y, point id) of every feature
        cursor.require(observations)
        cursor.at += observations
        yield values[0], name, np.array(values[1:5]), np.array(values[5:8]), values[8]


def _text_images(path: Path) -> Iterator[_Image]:
    for line in list(_lines(path))[::2]:  # every second line lists the features of the image above it
        if not line:
            continue
        try:
            number, *numbers, camera, name = line.split(maxsplit=9)
            values = [float(v) for v in numbers]
            if len(values) != 7:
                raise ValueError
            yield int(number), name, np.array(values[:4]), np.array(values[4:]), int(camera)
        except ValueError:
            fields = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise InputError(f"{path}: expected {fields}, got {line!r:.60}") from None


def _binary_points(path: Path) -> Iterator[_Point]:
    cursor = _Cursor(path)
    for _ in range(cursor.take("Q")[0]):
        _, x, y, z, *_, length = cursor.take("Q3d3BdQ")
        cursor.require(8 * length)
        yield (x, y, z), cursor.take(f"{2 * length}i")[::2]


def _text_points(path: Path) -> Iterator[_Point]:
    for line in filter(None, _lines(path)):
        try:
            _, x, y, z, _, _, _, _, *track = line.split()
            yield (float(x), float(y), float(z)), list(map(int, track[::2]))
        except ValueError:
            fields = "POINT3D_ID X Y Z R G B ERROR TRACK"
            raise InputError(f"{path}: expected {fields}, got {line!r:.60}") from None


def _lines(path: Path) -> Iterator[str]:
    """The lines without comments. Empty ones stay: an image without features has an empty second line."""
    try:
        text = read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected the text of a COLMAP model, got bytes that are no text") from None
    return (line.strip() for line in text.splitlines() if not line.startswith("#"))
