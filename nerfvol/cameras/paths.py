"""Where to look from: camera paths in JSON files, and paths that fit a scene. docs/cli.md has the JSON's fields.

The JSON is that of ``transforms*.json`` files without images: intrinsics at the top, overridden frame by frame, and a
list of camera-to-world matrices, so a data set's own file can be given as a path.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfvol.cameras.calibration import Calibration, finite_number, lens_keys, read_calibration, read_matrix
from nerfvol.cameras.camera import Camera, Intrinsics, orbit
from nerfvol.cameras.focus import focus_point
from nerfvol.cameras.path_files import as_own_document
from nerfvol.cameras.pose import orbit_axes
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json

DEFAULT_SIZE = (800, 800)
DEFAULT_ANGLE_X = 0.6911
"""Horizontal field of view, radians (40 degrees), where a file states none: that of the NeRF-synthetic scenes."""
ONE_SIDE = 120.0
"""Degrees: cameras within such an arc have seen one side of the scene."""
LARGEST_SIDE = 16384


@dataclass(frozen=True)
class CameraPath:
    """What a file says: its cameras; loop: the last is followed by the first; keyframes: whether to interpolate between
    them; fps
    and seconds: None where it does not say; said: sentences on what of it is not used or only guessed."""

    cameras: list[Camera]
    loop: bool = False
    keyframes: bool = False
    fps: float | None = None
    seconds: float | None = None
    said: Sequence[str] = ()


def load_cameras(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> list[Camera]:
    """The cameras of :func:`load_path`."""
    return load_path(path, size).cameras


def load_path(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> CameraPath:
    """The camera path in a JSON file of ours or another tool's (path_files.py), resized to ``size`` (width, height) where
    given;
    800x800 where nobody states one.

    Raises:
        InputError: not JSON, no frames, a matrix that is no rigid pose, intrinsics that are unusable.
    """
    document, said = as_own_document(path, read_json(path))
    shared = {key: value for key, value in document.items() if key != "frames"}
    cameras = []
    for index, frame in enumerate(document["frames"]):
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise InputError(f"{path}, frame {index}: expected an object with a transform_matrix")
        try:
            camera = _camera(read_calibration({**shared, **frame}), read_matrix(frame["transform_matrix"]), size)
        except InputError as error:
            raise InputError(f"{path}, frame {index}: {error}") from error
        cameras.append(camera)
    try:
        timing = {key: finite_number(document, key) for key in ("fps", "seconds")}
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if bad := [key for key, value in timing.items() if value is not None and value <= 0]:
        raise InputError(f"{path}: {bad[0]} must be positive, got {timing[bad[0]]:g}")
    return CameraPath(cameras, document.get("loop") is True, document.get("keyframes") is True, **timing, said=said)


def _camera(calibration: Calibration, c2w: np.ndarray, size: tuple[int, int] | None) -> Camera:
    width, height = calibration.width, calibration.height
    if width is None or height is None:
        width, height = size or DEFAULT_SIZE
    if max(width, height) > LARGEST_SIDE:
        raise InputError(f"pictures have at most {LARGEST_SIDE} pixels a side, got {width}x{height}")
    if all(focal is None for focal in (calibration.fx, calibration.fy, calibration.angle_x, calibration.angle_y)):
        calibration = dataclasses.replace(calibration, angle_x=DEFAULT_ANGLE_X)
    camera = Camera(calibration.intrinsics(width, height), c2w)
    return camera.resized(*size) if size else camera


def cameras_document(cameras: Sequence[Camera], names: Sequence[str]) -> dict[str, Any]:
    """``cameras`` as a document that :func:`load_cameras` reads; ``names`` become the frames' file_path."""
    frames = []
    for camera, name in zip(cameras, names, strict=True):
        lens = camera.intrinsics
        frame: dict[str, Any] = {
            "file_path": name, "w": lens.width, "h": lens.height,
            "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy,
            **lens_keys(lens.lens),
            "transform_matrix": camera.c2w.tolist(),
        }  # fmt: skip
        frames.append(frame)
    return {"frames": frames}


def describe_orbit(cameras: Sequence[Camera], aabb: Any) -> dict[str, Any]:
    """The orbit that continues the training cameras, JSON-able, for the octree's metadata (key "orbit").

    The centre is the point nearest to all viewing axes where those meet (photographs taken around something), else
    the middle of ``aabb`` (2, 3); radius and elevation are the medians over the cameras; up is their mean up. Where all
    cameras stand on one side, "azimuth_deg" and "arc_deg" say where and how wide: nothing is known of the other sides.
    """
    positions = np.stack([camera.position for camera in cameras])
    box = np.asarray(aabb, dtype=np.float64)
    focus = focus_point(cameras)
    inside = bool(np.all(focus.point >= box[0]) and np.all(focus.point <= box[1]))
    center = focus.point if focus.is_clear and inside else box.mean(axis=0)
    up = _mean_up(cameras)
    offsets = positions - center
    radii = np.linalg.norm(offsets, axis=1)
    radius = float(np.median(radii))
    if not radius > 0:
        radius = float(np.linalg.norm(box[1] - box[0]))
    height = (offsets @ up) / np.maximum(radii, 1e-12)
    elevation = math.degrees(math.asin(float(np.clip(np.median(height), -1.0, 1.0))))
    lens = cameras[0].intrinsics
    return {
        "center": center.tolist(), "radius": radius, "elevation_deg": float(np.clip(elevation, -80.0, 80.0)),
        "up": up.tolist(), "camera_angle_x": 2.0 * math.atan(0.5 * lens.width / lens.fx),
        "size": [lens.width, lens.height], **_arc(cameras, offsets, up),
    }  # fmt: skip


def _arc(cameras: Sequence[Camera], offsets: np.ndarray, up: np.ndarray) -> dict[str, float]:
    """Middle and width, degrees, of the arc that holds all cameras but one in ten, seen from the orbit's centre.

    offsets: (n, 3) from the centre to the cameras. Empty where they stand on more than one side, or do not look at the centre.
    """
    _, start, side = orbit_axes(up)
    across, along = offsets @ side, offsets @ start
    inward = [
        camera.forward @ -offset > 0.5 * np.linalg.norm(offset) for camera, offset in zip(cameras, offsets, strict=True)
    ]
    if np.mean(inward) < 0.9 or np.median(np.hypot(across, along)) < 0.2 * np.median(np.linalg.norm(offsets, axis=1)):
        return {}
    angle = np.arctan2(across, along)
    middle = math.atan2(np.sin(angle).mean(), np.cos(angle).mean())
    apart = np.abs((angle - middle + np.pi) % (2 * np.pi) - np.pi)
    width = 2 * math.degrees(float(np.quantile(apart, 0.9)))
    return {"azimuth_deg": math.degrees(middle), "arc_deg": width} if len(offsets) > 2 and width < ONE_SIDE else {}


def orbit_cameras(count: int, description: Mapping[str, Any], size: tuple[int, int] | None) -> list[Camera]:
    """``count`` cameras on the orbit of :func:`describe_orbit` (missing keys: see :func:`default_orbit`).

    A full circle; where the description has an arc, they sway within it, there and back.
    """
    width, height = size or tuple(description.get("size") or DEFAULT_SIZE)
    focal = 0.5 * width / math.tan(0.5 * float(description.get("camera_angle_x", DEFAULT_ANGLE_X)))
    lens = Intrinsics(int(width), int(height), focal, focal, 0.5 * width, 0.5 * height)
    azimuths = None
    if "arc_deg" in description:
        sway = 0.5 * float(description["arc_deg"]) * np.sin(2 * np.pi * np.arange(count) / max(count, 1))
        azimuths = np.radians(float(description.get("azimuth_deg", 0.0)) + sway)
    return orbit(
        count, azimuths=azimuths, center=description["center"], radius=float(description["radius"]),
        elevation_deg=float(description["elevation_deg"]), intrinsics=lens, up=description.get("up", (0.0, 0.0, 1.0)),
    )  # fmt: skip


def default_orbit(aabb: Any) -> dict[str, Any]:
    """An orbit that shows the whole box ``aabb`` (2, 3) from 25 degrees above, where no training camera is known."""
    box = np.asarray(aabb, dtype=np.float64)
    sphere = 0.5 * float(np.linalg.norm(box[1] - box[0]))
    radius = sphere / math.sin(0.5 * DEFAULT_ANGLE_X)
    return {"center": box.mean(axis=0).tolist(), "radius": radius, "elevation_deg": 25.0}


def _mean_up(cameras: Sequence[Camera]) -> np.ndarray:
    """The mean of the cameras' up axes; the world axis nearest to it where one is within 20 degrees."""
    mean = np.sum([camera.c2w[:3, 1] for camera in cameras], axis=0)
    length = np.linalg.norm(mean)
    if length < 1e-6 * len(cameras):
        return np.array([0.0, 0.0, 1.0])
    mean /= length
    axis = int(np.argmax(np.abs(mean)))
    return np.sign(mean[axis]) * np.eye(3)[axis] if abs(mean[axis]) > math.cos(math.radians(20.0)) else mean
