"""The files of a COLMAP model, binary or text, as records: cameras, images and points in the order of the file.

Whatever the bytes, reading gives records or one InputError that names the file. Sources: docs/data.md.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.calibration import Calibration
from nerfvol.cameras.further_lenses import FieldOfView, Rational
from nerfvol.cameras.lens import BrownConrady, Fisheye, Lens
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_bytes, read_text
from nerfvol.files.entry import entry

# COLMAP's model ids, the lens they are, their parameters in its order; f stands for both focal lengths. What the lens has no
# coefficient for has a star and must be zero.
_MODELS: dict[str, tuple[int, type[Lens], str]] = {
    "SIMPLE_PINHOLE": (0, BrownConrady, "f cx cy"),
    "PINHOLE": (1, BrownConrady, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, BrownConrady, "f cx cy k1"),
    "RADIAL": (3, BrownConrady, "f cx cy k1 k2"),
    "OPENCV": (4, BrownConrady, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, Fisheye, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, Rational, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": (7, FieldOfView, "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": (8, Fisheye, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, Fisheye, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, Fisheye, "fx fy cx cy k1 k2 p1* p2* k3 k4 sx1* sy1*"),
    "SIMPLE_FISHEYE": (14, Fisheye, "f cx cy"),
    "FISHEYE": (15, Fisheye, "fx fy cx cy"),
}
_NAMES = {number: name for name, (number, *_) in _MODELS.items()}
_UNREAD = {11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 16: "EUCM",
           17: "EQUIRECTANGULAR"}  # fmt: skip
"""COLMAP's others, by name for the sentence that refuses them."""


class ImageRecord(NamedTuple):
    """``quaternion`` (4,), w first, and ``translation`` (3,): world to camera in OpenCV axes. ``camera``: its number."""

    number: int
    name: str
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    camera: int


class PointRecord(NamedTuple):
    """A place, its colour (0 to 255) and mean reprojection error in pixels; ``track``: numbers of the images that show it,
    as often as they do."""

    x: float
    y: float
    z: float
    red: int
    green: int
    blue: int
    error: float
    track: Sequence[int]


def model_files(model: Path) -> tuple[Path, Path] | None:
    """The files of a model's cameras and of its images, in any case: both binary where there are such, else both text, else
    one of each; None where one is missing."""
    found = {(stem, suffix): file for stem in ("cameras", "images") for suffix in (".bin", ".txt")
             if (file := entry(model, f"{stem}{suffix}")).is_file()}  # fmt: skip
    for kinds in ((".bin", ".bin"), (".txt", ".txt"), (".bin", ".txt"), (".txt", ".bin")):
        if ("cameras", kinds[0]) in found and ("images", kinds[1]) in found:
            return found["cameras", kinds[0]], found["images", kinds[1]]
    return None


def images_file(model: Path) -> Path:
    """The file of a model's images, also where that of its cameras is missing; InputError where there is none."""
    files = model_files(model)
    alone = (entry(model, f"images{suffix}") for suffix in (".bin", ".txt"))
    path = files[1] if files is not None else next((file for file in alone if file.is_file()), None)
    if path is None:
        raise InputError(f"{model}: expected a COLMAP model, but there is no images.bin or images.txt")
    return path


def points_file(model: Path) -> Path | None:
    """The file of a model's points; None where there is none."""
    files = (entry(model, f"points3D{suffix}") for suffix in (".bin", ".txt"))
    return next((path for path in files if path.is_file()), None)


def read_cameras(model: Path) -> dict[int, Calibration]:
    """The calibration of each camera of a model by its number; InputError where the file or a camera is unusable."""
    files = model_files(model)
    if files is None:
        raise InputError(f"{model}: expected a COLMAP model, cameras and images as .bin or .txt, but one is missing")
    path = files[0]
    return _cameras_binary(path) if path.suffix.lower() == ".bin" else _cameras_text(path)


def read_images(model: Path) -> Iterator[ImageRecord]:
    """The images of a model; InputError where the file is damaged."""
    path = images_file(model)
    return _images_binary(path) if path.suffix.lower() == ".bin" else _images_text(path)


def read_points(path: Path) -> Iterator[PointRecord]:
    """The points of a points3D.bin or points3D.txt; InputError where the file is damaged, when reading comes that far."""
    return _points_binary(path) if path.suffix.lower() == ".bin" else _points_text(path)


def _calibration(model: str, width: int, height: int, parameters: tuple[float, ...]) -> Calibration:
    _, lens, names = _MODELS[model]
    values = dict(zip(names.split(), parameters, strict=True))
    if beyond := [name for name, value in values.items() if name.endswith("*") and value]:
        raise InputError(
            f"the term {beyond[0][:-1]} of {model} is not supported unless it is zero; export undistorted images "
            "(colmap image_undistorter)"
        )
    if not all(np.isfinite(parameters)) or min(width, height) < 1:
        raise InputError(f"a camera must have a size and finite parameters, got {width}x{height} and {parameters}")
    focal = values.get("f")
    if lens is Rational and not any(values[name] for name in ("k4", "k5", "k6")):
        lens = BrownConrady
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

    def take(self, layout: str) -> tuple[Any, ...]:
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


def _cameras_binary(path: Path) -> dict[int, Calibration]:
    cursor = _Cursor(path)
    found = {}
    for _ in range(cursor.take("Q")[0]):
        camera, number, width, height = cursor.take("iiQQ")
        if number not in _NAMES:
            known, model = ", ".join(_MODELS), _UNREAD.get(number, number)
            raise InputError(f"{path}, camera {camera}: lens model {model} is not supported; known models: {known}")
        model = _NAMES[number]
        found[camera] = _checked(path, camera, model, width, height, cursor.take(f"{len(_MODELS[model][2].split())}d"))
    return found


def _cameras_text(path: Path) -> dict[int, Calibration]:
    found = {}
    for line in _lines(path):
        if not line:
            continue
        try:
            camera, model, width, height, *parameters = line.split()
            model, sizes = model.upper(), (float(width), float(height))
            numbers = int(camera), int(sizes[0]), int(sizes[1]), tuple(map(float, parameters))
            if numbers[1:3] != sizes:
                raise ValueError
        except (ValueError, OverflowError):
            raise InputError(f"{path}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line!r:.60}") from None
        if model not in _MODELS or len(numbers[3]) != len(_MODELS[model][2].split()):
            raise InputError(f"{path}, camera {camera}: unknown lens model or wrong number of parameters: {line!r:.60}")
        found[numbers[0]] = _checked(path, numbers[0], model, *numbers[1:])
    return found


def _checked(
    path: Path, camera: int, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> Calibration:
    try:
        return _calibration(model, width, height, parameters)
    except InputError as error:
        raise InputError(f"{path}, camera {camera}: {error}") from None


def _images_binary(path: Path) -> Iterator[ImageRecord]:
    cursor = _Cursor(path)
    for _ in range(cursor.take("Q")[0]):
        values = cursor.take("i7di")
        name = cursor.name()
        observations = 24 * cursor.take("Q")[0]  # (x, y, point id) of every feature
        cursor.require(observations)
        cursor.at += observations
        yield ImageRecord(values[0], name, np.array(values[1:5]), np.array(values[5:8]), values[8])


def _images_text(path: Path) -> Iterator[ImageRecord]:
    """An image is a line, and below it its features, which many scripts and editors leave out where there are none."""
    below = False
    for line in _lines(path):
        if below and _is_features(line):
            below = False
            continue
        below = bool(line)
        if line:
            yield _image_of(path, line)


def _is_features(line: str) -> bool:
    """Whether a line below an image lists its features: nothing, or triples of numbers, the third a whole one."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(map(np.isfinite, map(float, words))) and all(map(_is_whole, words[2::3]))
    except ValueError:
        return False


def _is_whole(word: str) -> bool:
    return word.lstrip("+-").isdigit()


def _image_of(path: Path, line: str) -> ImageRecord:
    try:
        number, *numbers, camera, name = line.split(maxsplit=9)
        values = [float(v) for v in numbers]
        if len(values) != 7:
            raise ValueError
        return ImageRecord(int(number), name, np.array(values[:4]), np.array(values[4:]), int(camera))
    except ValueError:
        fields = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        raise InputError(f"{path}: expected {fields}, got {line!r:.60}") from None


def count_images(model: Path) -> int:
    """How many images a model says it has; InputError where its file is damaged."""
    path = images_file(model)
    return _Cursor(path).take("Q")[0] if path.suffix.lower() == ".bin" else sum(1 for _ in _images_text(path))


def _points_binary(path: Path) -> Iterator[PointRecord]:
    cursor = _Cursor(path)
    for _ in range(cursor.take("Q")[0]):
        _, x, y, z, red, green, blue, error, length = cursor.take("Q3d3BdQ")
        cursor.require(8 * length)
        yield PointRecord(x, y, z, red, green, blue, error, cursor.take(f"{2 * length}i")[::2])


def _points_text(path: Path) -> Iterator[PointRecord]:
    for line in filter(None, _lines(path)):
        try:
            _, x, y, z, red, green, blue, error, *track = line.split()
            colour = int(red), int(green), int(blue)
            if not 0 <= min(colour) <= max(colour) <= 255:
                raise ValueError
            yield PointRecord(float(x), float(y), float(z), *colour, float(error), list(map(int, track[::2])))
        except ValueError:
            fields = "POINT3D_ID X Y Z R G B ERROR TRACK"
            raise InputError(f"{path}: expected {fields}, got {line!r:.60}") from None


def _lines(path: Path) -> Iterator[str]:
    """The lines without comments. Empty ones stay: an image without features has an empty second line."""
    try:
        text = read_text(path)
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected the text of a COLMAP model, got bytes that are no text") from None
    return (line.strip() for line in text.splitlines() if not line.startswith("#"))
