"""Camera paths that other tools save, as documents of our own (cameras/paths.py reads those).

- nerfstudio's viewer, ``camera_path.json``: ``camera_path`` with ``camera_to_world`` of 16 numbers (OpenGL axes) and
  ``fov``, vertical, degrees; ``render_width``, ``render_height``, ``fps``, ``seconds``, ``is_cycle``. Its poses are in the
  coordinates of its data loader, x' = scale (R x + t); where ``dataparser_transforms.json`` lies beside the path they are
  taken back to the data set's.
- 3D Gaussian splatting, ``cameras.json``: a list of ``position``, ``rotation`` (camera to world, OpenCV axes), ``fx``,
  ``fy``, ``width``, ``height``.
- instant-ngp, ``base_cam.json``: ``path`` of ``R`` (a quaternion x, y, z, w), ``T`` and ``fov`` (vertical, degrees), in its
  unit cube: positions 0.33 x + 0.5, then axes cycled (y, z, x), OpenCV axes of the camera; ``loop``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json
from nerfvol.rotations import rotations

NGP_SCALE, NGP_OFFSET = 0.33, 0.5
Float = NDArray[np.float64]


def as_own_document(path: str | os.PathLike[str], document: Any) -> tuple[dict[str, Any], list[str]]:
    """``document`` as {"frames": [...], ...} with the keys of transforms.json, and "fps", "seconds", "loop" where stated; and
    sentences on what of it is not used or only guessed.

    Raises:
        InputError: it is no camera path of a known kind, or a frame lacks what its kind has; names the file and the frame.
    """
    frames = document.get("frames") if isinstance(document, dict) else None
    if isinstance(frames, list) and frames:
        return document, []
    if isinstance(document, list) and document and isinstance(document[0], dict) and "rotation" in document[0]:
        return {"frames": _each(path, document, _inria)}, []
    if isinstance(document, dict) and isinstance(document.get("camera_path"), list) and document["camera_path"]:
        return _nerfstudio(path, document), _doubts(path, document)
    if isinstance(document, dict) and isinstance(document.get("path"), list) and document["path"]:
        own = {"frames": _each(path, document["path"], _ngp), "loop": document.get("loop") is True, "keyframes": True}
        return own, []
    raise InputError(
        f"{path}: expected a camera path, an object with a non-empty list 'frames' (or the path of nerfstudio's viewer, "
        "cameras.json of 3D Gaussian splatting, base_cam.json of instant-ngp)"
    )


def _each(path: str | os.PathLike[str], entries: list[Any], read: Callable[[Mapping[str, Any]], dict]) -> list[dict]:
    frames = []
    for index, entry in enumerate(entries):
        try:
            if not isinstance(entry, dict):
                raise InputError(f"expected an object, got {entry!r:.40}")
            frames.append(read(entry))
        except InputError as error:
            raise InputError(f"{path}, frame {index}: {error}") from error
    return frames


def _numbers(entry: Mapping[str, Any], key: str, *shape: int) -> Float:
    if key not in entry:
        raise InputError(f"it has no {key!r}")
    try:
        values = np.array(entry[key], np.float64)
        good = values.size == math.prod(shape) and bool(np.isfinite(values).all())
    except (TypeError, ValueError, OverflowError):
        good, values = False, np.zeros(0)
    if not good:
        what = " x ".join(map(str, shape)) or "1"
        raise InputError(f"{key} should be {what} finite numbers, got {entry[key]!r:.60}")
    return values.reshape(shape)


def _number(entry: Mapping[str, Any], key: str, low: float = 0.0, high: float = math.inf) -> float:
    value = float(_numbers(entry, key))
    if not low < value < high:
        raise InputError(f"{key} must lie between {low:g} and {high:g}, got {value:g}")
    return value


def _pose(rotation: Float, position: Float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix.tolist()


_TO_OPENGL = np.array([1.0, -1.0, -1.0])  # of the camera's axes: y and z of OpenCV's point the other way


def _inria(entry: Mapping[str, Any]) -> dict:
    rotation = _numbers(entry, "rotation", 3, 3) * _TO_OPENGL
    return {
        "transform_matrix": _pose(rotation, _numbers(entry, "position", 3)),
        "w": int(_number(entry, "width")), "h": int(_number(entry, "height")),
        "fl_x": _number(entry, "fx"), "fl_y": _number(entry, "fy"),
    }  # fmt: skip


def _ngp(entry: Mapping[str, Any]) -> dict:
    x, y, z, w = _numbers(entry, "R", 4)
    if not math.hypot(x, y, z, w) > 1e-12:
        raise InputError("R is a quaternion of length 0")
    rotation = np.roll(rotations([[w, x, y, z]])[0] * _TO_OPENGL, 1, axis=0)
    position = np.roll((_numbers(entry, "T", 3) - NGP_OFFSET) / NGP_SCALE, 1)
    return {"transform_matrix": _pose(rotation, position), "y_fov": _number(entry, "fov", 0, 180)}


def _nerfstudio(path: str | os.PathLike[str], document: Mapping[str, Any]) -> dict[str, Any]:
    if document.get("camera_type", "perspective") != "perspective":
        raise InputError(f"{path}: camera_type {document['camera_type']!r:.40} is not supported, expected perspective")
    back = _nerfstudio_frame(Path(path).parent / _DATAPARSER)

    def read(entry: Mapping[str, Any]) -> dict:
        pose = _numbers(entry, "camera_to_world", 4, 4)
        rotation, position = back(pose[:3, :3], pose[:3, 3])
        return {"transform_matrix": _pose(rotation, position), "y_fov": _number(entry, "fov", 0, 180)}

    shared: dict[str, Any] = {}
    for ours, theirs in (("w", "render_width"), ("h", "render_height")):
        if document.get(theirs) is not None:
            shared[ours] = document[theirs]
    timing = {key: document[key] for key in ("fps", "seconds") if isinstance(document.get(key), int | float)}
    return {
        **shared,
        **timing,
        "loop": document.get("is_cycle") is True,
        "frames": _each(path, document["camera_path"], read),
    }


_DATAPARSER = "dataparser_transforms.json"


def _doubts(path: str | os.PathLike[str], document: Mapping[str, Any]) -> list[str]:
    said = []
    if not (Path(path).parent / _DATAPARSER).is_file():
        said.append(
            f"{_DATAPARSER} is not beside {path}: its poses are taken as the data set's, which nerfstudio turns, moves and "
            "scales unless told not to"
        )
    if document.get("crop"):
        said.append(f"{path} states a crop, which is not used")
    return said


def _nerfstudio_frame(beside: Path) -> Callable[[Float, Float], tuple[Float, Float]]:
    """From the data loader's coordinates to the data set's: rotation and position of a camera."""
    if not beside.is_file():
        return lambda rotation, position: (rotation, position)
    stated = read_json(beside)
    try:
        if not isinstance(stated, dict):
            raise InputError("expected an object")
        matrix, scale = _numbers(stated, "transform", 3, 4), _number(stated, "scale")
    except InputError as error:
        raise InputError(f"{beside}: {error}") from error
    turn, shift = matrix[:, :3], matrix[:, 3]
    return lambda rotation, position: (turn.T @ rotation, turn.T @ (position / scale - shift))
