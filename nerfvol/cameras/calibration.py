"""How files state a camera: calibration with figures left open, and its reading from JSON keys."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Intrinsics
from nerfvol.cameras.further_lenses import FieldOfView, Rational
from nerfvol.cameras.lens import PINHOLE, BrownConrady, Fisheye, Lens
from nerfvol.errors import InputError, shown


@dataclass(frozen=True)
class Calibration:
    """Intrinsics as a file states them; what it leaves open (None) follows from the image's size.

    Images that are uniformly larger or smaller than (width, height) get figures of their own size. ``resizable``: by any
    factor, as formats mean it that keep the original photographs' figures; else by 1.3 or more, and less is an error.
    """

    width: int | None = None
    height: int | None = None
    fx: float | None = None
    fy: float | None = None
    angle_x: float | None = None
    angle_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    lens: Lens = PINHOLE
    resizable: bool = False

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """The intrinsics of an image of width x height pixels.

        Raises:
            InputError: no focal length is stated, a field of view outside (0, pi), an image of another size than is stated
                unless it is uniformly resized, or figures that Intrinsics refuses.
        """
        sx, sy = self._resize(width, height)
        fx = self.fx * sx if self.fx is not None else _focal(self.angle_x, width)
        fy = self.fy * sy if self.fy is not None else _focal(self.angle_y, height)
        fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)  # square pixels where only one is given
        if fx is None or fy is None:
            raise InputError("the focal length is missing: expected fl_x (pixels) or camera_angle_x (radians)")
        if isinstance(self.lens, BrownConrady) and min(fx, fy) > 0 and max(width / fx, height / fy) > _WIDEST:
            degrees = math.degrees(2 * math.atan(0.5 * max(width / fx, height / fy)))
            raise InputError(
                f"a focal length of {min(fx, fy):g} pixels in a picture of {width}x{height} is a field of view of "
                f"{degrees:.1f} degrees: is it in millimetres, or a share of the picture's width? State it in pixels"
            )
        cx = 0.5 * width if self.cx is None else self.cx * sx
        cy = 0.5 * height if self.cy is None else self.cy * sy
        return Intrinsics(width, height, fx, fy, cx, cy, self.lens)

    def made_for(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) of the pictures that the figures are for, where the image has width x height pixels.

        Stated sizes count; else a principal point far from the middle of the image tells: where it is the middle of pictures
        that are uniformly larger or smaller, it is theirs.
        """
        if self.width is not None or self.height is not None:
            return (self.width or width), (self.height or height)
        if self.cx is None or self.cy is None or not (self.fx or self.fy):
            return width, height
        sx, sy = 2 * self.cx / width, 2 * self.cy / height
        resized = not 1 / _DELIBERATE < (sx + sy) / 2 < _DELIBERATE and abs(sx - sy) < _ALIKE * (sx + sy) / 2
        return (round(sx * width), round(sy * height)) if resized and min(sx, sy) > 0 else (width, height)

    def is_off(self, width: int, height: int) -> bool:
        """Whether the principal point is more than a quarter of the image from its middle, as a crop or a mistake has it."""
        lens = self.intrinsics(width, height)
        return max(abs(lens.cx - width / 2) / width, abs(lens.cy - height / 2) / height) > 0.25

    def turns(self, width: int, height: int) -> bool:
        """Whether the figures are for the picture of width x height pixels lying on its side, and not as it is."""
        if width == height:
            return False
        if self.width is not None and self.height is not None:
            return not _uniform((self.width, self.height), (width, height)) and _uniform(
                (self.width, self.height), (height, width)
            )
        if self.cx is None or self.cy is None:
            return False
        as_is = max(abs(2 * self.cx / width - 1), abs(2 * self.cy / height - 1))
        on_side = max(abs(2 * self.cx / height - 1), abs(2 * self.cy / width - 1))
        return on_side < 0.1 < as_is and on_side < as_is / 2

    def _resize(self, width: int, height: int) -> tuple[float, float]:
        stated = self.made_for(width, height)
        if stated == (width, height):
            return 1.0, 1.0
        sx, sy = width / stated[0], height / stated[1]
        if _uniform(stated, (width, height)) and (self.resizable or not 1 / _DELIBERATE < sx < _DELIBERATE):
            return sx, sy
        expected = f"{stated[0]}x{stated[1]} pixels as its calibration states"
        raise InputError(f"expected an image of {expected}, got {width}x{height}")


_WIDEST = 2 * math.tan(math.radians(80))
"""A picture's width in focal lengths: a lens without a fisheye's model sees less than 160 degrees."""
_DELIBERATE = 1.3
"""Pictures of another size than is stated are taken for resized ones by at least this factor; by less it is a mistake."""
_ALIKE = 0.03


def _uniform(stated: tuple[int, int], found: tuple[int, int]) -> bool:
    """Whether one scale makes ``found`` of ``stated``, (width, height): a resized side is rounded to whole pixels, so that
    the two scales agree to about a pixel over the smaller image."""
    return abs(found[0] / stated[0] - found[1] / stated[1]) * min(stated) <= 2


def _focal(angle: float | None, size: int) -> float | None:
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        hint = ": is it in degrees, which x_fov states?" if math.pi <= angle < 180 else ""
        raise InputError(f"the field of view must be between 0 and pi radians, got {angle:g}{hint}")
    return 0.5 * size / math.tan(0.5 * angle)


_MATRICES = ("K", "intrinsics", "intrinsic_matrix", "camera_intrinsics", "camera_matrix")
"""What scripts call a calibration matrix; it counts where no other key states a focal length."""
_ALIASES = {"fl_x": "fx", "fl_y": "fy", "w": "width", "h": "height"}
CALIBRATION_KEYS = {
    "camera_model", "is_fisheye", "ftheta_p0", "latlong", "equirectangular", "w", "h", "fl_x", "fl_y", "cx", "cy", "x_fov",
    "y_fov", "camera_angle_x", "camera_angle_y", "fx", "fy", "width", "height", *_MATRICES, *Rational.names(),
    *Fisheye.names(), *FieldOfView.names(),
}  # fmt: skip
"""What :func:`read_calibration` looks at."""
CAMERA_MODELS: dict[str, type[Lens]] = {
    "OPENCV": BrownConrady,
    "PINHOLE": BrownConrady,
    "SIMPLE_PINHOLE": BrownConrady,
    "SIMPLE_RADIAL": BrownConrady,
    "RADIAL": BrownConrady,
    "PERSPECTIVE": BrownConrady,
    "FULL_OPENCV": Rational,
    "OPENCV_FISHEYE": Fisheye,
    "SIMPLE_RADIAL_FISHEYE": Fisheye,
    "RADIAL_FISHEYE": Fisheye,
    "SIMPLE_FISHEYE": Fisheye,
    "FISHEYE": Fisheye,
    "FOV": FieldOfView,
}
"""The lens that a JSON file's ``camera_model`` names; of several names a lens is written with its first."""
_DEFAULT_MODEL = "OPENCV"


def read_matrix(value: Any) -> NDArray[np.float64]:
    """The float64 array of a JSON list of numbers, in the shape of the list, and in rows of 4 where it is one of 12 or 16.

    InputError where it is none.
    """
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"transform_matrix must be 4 rows of 4 numbers, got {shown(value):.60}") from None
    return matrix.reshape(-1, 4) if matrix.shape in ((12,), (16,)) else matrix


def finite_number(data: Mapping[str, Any], *keys: str) -> float | None:
    """The first of the keys that is there, as a finite number; None where none is.

    Raises:
        InputError: it is no number, or not below 1e300.
    """
    for key in keys:
        value = data.get(key)
        if value is None:
            continue
        if isinstance(value, str):  # some exporters quote their numbers
            with contextlib.suppress(ValueError):
                value = float(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
            raise InputError(f"{key} must be a finite number, got {shown(value):.60}")
        return float(value)
    return None


def _in_our_words(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The keys with what others call fl_x, fl_y, cx, cy, w and h under these names, where they are not there themselves."""
    found = {key: data[other] for key, other in _ALIASES.items() if data.get(other) is not None}
    for name in () if _has_focal({**data, **found}) else (name for name in _MATRICES if data.get(name) is not None):
        try:
            matrix = np.array(data[name], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.zeros(())
        if matrix.shape in ((9,), (16,)):
            matrix = matrix.reshape(3 if len(matrix) == 9 else 4, -1)
        if matrix.shape not in ((3, 3), (4, 4), (3, 4)) or not np.allclose(matrix[1, 0], 0) or matrix[2, 2] != 1:
            raise InputError(f"{name} must be a calibration matrix of 3 rows of 3 numbers, got {shown(data[name]):.60}")
        found |= {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    return {**found, **{key: value for key, value in data.items() if value is not None}} if found else data


def _has_focal(data: Mapping[str, Any]) -> bool:
    return any(
        data.get(key) is not None for key in ("fl_x", "fl_y", "x_fov", "y_fov", "camera_angle_x", "camera_angle_y")
    )


def _idle(data: Mapping[str, Any]) -> list[str]:
    """Others' keys whose values do not count, for ours say something else."""
    idle = [
        other
        for key, other in _ALIASES.items()
        if data.get(other) is not None and data.get(key) not in (None, data[other])
    ]
    return idle + [name for name in _MATRICES if data.get(name) is not None and _has_focal(data)]


def read_calibration(data: Mapping[str, Any]) -> Calibration:
    """The calibration that the keys of a transforms.json state (docs/data.md lists them).

    Raises:
        InputError: a value that is no number, an unknown or unsupported camera_model.
    """
    data = _in_our_words(data)
    model = data.get("camera_model") or _DEFAULT_MODEL
    model = model.strip().upper() if isinstance(model, str) else model
    if not isinstance(model, str) or model not in CAMERA_MODELS:
        raise InputError(f"camera_model {shown(model):.60} is not supported; known models: {', '.join(CAMERA_MODELS)}")
    unsupported = [key for key in ("ftheta_p0", "latlong", "equirectangular") if data.get(key)]
    if unsupported:
        raise InputError(f"lens model {unsupported[0]} is not supported: expected a pinhole or OpenCV fisheye camera")
    lens = Fisheye if is_true(data.get("is_fisheye")) else CAMERA_MODELS[model]
    if lens is BrownConrady and any(finite_number(data, key) for key in ("k5", "k6")):
        lens = Rational  # OpenCV's eight coefficients: there is no other model with six k
    if lens is Rational and not any(finite_number(data, key) for key in ("k4", "k5", "k6")):
        lens = BrownConrady
    coefficients = {name: finite_number(data, name) or 0.0 for name in lens.names()}
    degrees = {key: finite_number(data, key) for key in ("x_fov", "y_fov")}
    angles = [None if v is None else math.radians(v) for v in degrees.values()]
    width, height = (_size(data, key) for key in ("w", "h"))
    return Calibration(
        width=width,
        height=height,
        fx=finite_number(data, "fl_x"),
        fy=finite_number(data, "fl_y"),
        angle_x=finite_number(data, "camera_angle_x") if angles[0] is None else angles[0],
        angle_y=finite_number(data, "camera_angle_y") if angles[1] is None else angles[1],
        cx=finite_number(data, "cx"),
        cy=finite_number(data, "cy"),
        lens=lens(**coefficients),
    )


def is_true(value: Any) -> bool:
    """Whether a JSON value says yes: true, 1, or one of both in quotes."""
    return (
        value is True
        or (type(value) in (int, float) and value == 1)
        or str(value).strip().lower() in ("true", "1", "yes")
    )


_COEFFICIENTS = {
    "PINHOLE": (), "SIMPLE_PINHOLE": (), "PERSPECTIVE": (), "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"),
    "SIMPLE_FISHEYE": (), "FISHEYE": (), "SIMPLE_RADIAL_FISHEYE": ("k1",), "RADIAL_FISHEYE": ("k1", "k2"),
}  # fmt: skip
"""What a model of that name has, by COLMAP; where it has less than its lens here."""


def calibration_doubts(data: Mapping[str, Any]) -> list[str]:
    """Words on what the keys state and :func:`read_calibration` does not use, or uses although they contradict each other.

    ``data``: keys that it has read without an error.
    """
    lens, model = read_calibration(data).lens, str(data.get("camera_model") or _DEFAULT_MODEL).strip().upper()
    stated = [key for key in sorted(_ALL_COEFFICIENTS) if finite_number(data, key)]
    said = []
    if unused := [key for key in stated if key not in lens.names()]:
        said.append(f"{', '.join(unused)} (a {lens.KIND} lens has no such coefficient, and they are not used)")
    if idle := _idle(data):
        said.append(f"{', '.join(idle)} (other keys for the same come first)")
    beyond = [key for key in stated if key in lens.names() and key not in _COEFFICIENTS.get(model, lens.names())]
    if beyond and type(lens) is CAMERA_MODELS[model]:
        said.append(f"camera_model {model} and {', '.join(beyond)}, which it has not (they are used)")
    for focal, size, *others in (("fl_x", "w", "camera_angle_x", "x_fov"), ("fl_y", "h", "camera_angle_y", "y_fov")):
        pixels, side = finite_number(data, focal), finite_number(data, size)
        for key in others:
            angle = finite_number(data, key)
            if pixels and side and angle and not isinstance(lens, Fisheye):
                stated_angle = math.radians(angle) if key.endswith("fov") else angle
                other = 2 * math.atan(0.5 * side / pixels)
                if abs(stated_angle - other) > 0.02 * other:
                    unit = "degrees" if key.endswith("fov") else "radians"
                    value = math.degrees(other) if key.endswith("fov") else other
                    said.append(f"{key} {angle:.4g} where {focal} and {size} mean {value:.4g} {unit} ({focal} counts)")
    return said


_ALL_COEFFICIENTS = {*Rational.names(), *Fisheye.names(), *FieldOfView.names()}


def lens_keys(lens: Lens) -> dict[str, Any]:
    """What :func:`read_calibration` reads as ``lens``: its coefficients that are not zero, and its model unless default."""
    keys: dict[str, Any] = {name: value for name, value in lens.coefficients.items() if value}
    if type(lens) is not CAMERA_MODELS[_DEFAULT_MODEL]:
        keys["camera_model"] = next(name for name, model in CAMERA_MODELS.items() if model is type(lens))
    return keys


def _size(data: Mapping[str, Any], key: str) -> int | None:
    value = finite_number(data, key)
    if value is not None and (value < 1 or value != int(value)):
        raise InputError(f"{key} must be a whole number of pixels, got {value:g}")
    return None if value is None else int(value)
