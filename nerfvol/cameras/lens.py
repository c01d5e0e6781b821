"""Lenses: where a direction lands on the image plane and back, in float64; one class a model.

Here axes are OpenCV's: x right, y down, z forward; positions on the image plane are in focal lengths from the principal
point. A further model is a class here, a row in the table of names that JSON files use (cameras/calibration.py) and a
row in COLMAP's (datasets/colmap_files.py).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError

Float = NDArray[np.float64]

TOLERANCE = 1e-12
"""Of an inverse, in focal lengths (relative beyond the first)."""
LARGEST = 1e100
"""Intrinsics beyond it overflow in the powers of a lens."""
_MAX_STEPS = 50
_PULL = 0.8


@dataclass(frozen=True)
class Lens(ABC):
    """A lens's model: a frozen dataclass whose fields are its coefficients, so that equal lenses share a table of rays.

    Unusable coefficients raise InputError.
    """

    KIND: ClassVar[str]
    """As messages call the model."""

    def __post_init__(self) -> None:
        for name, value in self.coefficients.items():
            if not abs(value) < LARGEST:
                raise InputError(f"camera intrinsic {name} must be a finite number, got {value}")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The coefficients' names, as files call them."""
        return tuple(field.name for field in fields(cls))

    @property
    def coefficients(self) -> dict[str, float]:
        """All coefficients by name."""
        return asdict(self)

    @property
    @abstractmethod
    def max_angle(self) -> float:
        """The limit of the model: the angle from the axis, in radians, up to which its radial terms are one to one."""

    @abstractmethod
    def distort(self, points: Float) -> Float:
        """Positions (n, 2) on the image plane of points or directions (n, 3); NaN for those it cannot see."""

    def undistort(self, plane: Float) -> Float:
        """Unit directions (n, 3) that land at positions (n, 2) of the image plane, by Newton's method to 1e-12.

        Raises:
            InputError: no direction does: beyond the radius where its polynomial turns back a lens has no inverse.
        """
        directions, found = self.undistort_where(plane)
        if not found.all():
            raise self._no_inverse(plane)
        return directions

    def undistort_where(self, plane: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Unit directions (n, 3) as of :meth:`undistort`, and where there is one, (n,) bool; elsewhere along the axis."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what overflows does not converge
            directions = self._undistort(plane)
        found = np.logical_and.reduce(np.isfinite(directions), axis=1)
        return np.where(found[:, None], directions, (0.0, 0.0, 1.0)), found

    @abstractmethod
    def _undistort(self, plane: Float) -> Float:
        """Unit directions (n, 3) of positions (n, 2); NaN where no direction lands there."""

    def _no_inverse(self, plane: Float) -> InputError:
        radius = float(np.sqrt((plane * plane).sum(axis=1)).max())
        names = ", ".join(f"{name}={value:g}" for name, value in self.coefficients.items() if value)
        return InputError(
            f"the {self.KIND} lens distortion ({names or 'none'}) cannot be undone at every pixel: the model turns back on "
            f"itself within the image, which reaches {radius:.3g} focal lengths from the axis"
        )


@dataclass(frozen=True)
class BrownConrady(Lens):
    """A pinhole with radial and tangential distortion (Brown 1966, Conrady 1919), as OpenCV's calib3d has it.

    With x = X/Z, y = Y/Z and s = x^2 + y^2:
        x' = x (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4) + 2 p1 x y + p2 (s + 2 x^2)
        y' = y (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4) + p1 (s + 2 y^2) + 2 p2 x y
    k1, k2, p1, p2, k3 are OpenCV's five parameters; k4 is the s^4 term nerfstudio adds, not OpenCV's rational k4. What
    is not before the camera (Z <= 0) is not seen.
    """

    KIND: ClassVar[str] = "pinhole"

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def max_angle(self) -> float:
        """The arctangent of the radius where the radial polynomial turns back; pi / 2 where it never does."""
        return math.atan(self._fold)

    @property
    def _radial(self) -> tuple[float, float, float, float]:
        return self.k1, self.k2, self.k3, self.k4

    @property
    def _fold(self) -> float:
        return _fold(self._radial)

    def _factor(self, s: Float) -> tuple[Float, Float]:
        """The radial factor and its derivative by s, (n,) each."""
        return _polynomial(s, self._radial)

    def distort(self, points: Float) -> Float:
        """As for :class:`Lens`: points with Z <= 0 are not seen."""
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        plane = points[:, :2] / z[:, None]
        x, y = plane[:, 0], plane[:, 1]
        p1, p2 = self.p1, self.p2
        s = x * x + y * y
        radial = self._factor(s)[0]
        return np.stack(
            [x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y],
            axis=1,
        )

    def _undistort(self, plane: Float) -> Float:
        flat = self._solve(plane) if any(self.coefficients.values()) else plane
        d = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        return d / np.sqrt((d * d).sum(axis=1, keepdims=True))

    def _solve(self, plane: Float) -> Float:
        """Undistorted positions (n, 2), on the branch that contains the axis: a step off it is pulled back inwards."""
        x, y = plane[:, 0].copy(), plane[:, 1].copy()
        p1, p2, fold = self.p1, self.p2, self._fold
        found = np.zeros(len(plane), dtype=bool)
        for _ in range(_MAX_STEPS):
            s = x * x + y * y
            radial, slope = self._factor(s)
            ex = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x) - plane[:, 0]
            ey = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y - plane[:, 1]
            jxx = radial + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
            jxy = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
            jyy = radial + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
            det = jxx * jyy - jxy * jxy
            good = (det > 0) & (jxx > 0)  # the region around the axis where the model is one to one
            done = good & (np.abs(ex) + np.abs(ey) <= TOLERANCE * (1 + np.sqrt(s)))
            safe = np.where(good, det, 1.0)
            x = np.where(good, x - (jyy * ex - jxy * ey) / safe, _PULL * x)
            y = np.where(good, y - (jxx * ey - jxy * ex) / safe, _PULL * y)
            found = done & (np.sqrt(x * x + y * y) <= fold)
            if found.all():
                break
        return np.where(found[:, None], np.stack([x, y], axis=1), np.nan)


@dataclass(frozen=True)
class Fisheye(Lens):
    """OpenCV's fisheye lens (Kannala and Brandt 2006): with theta the angle from the axis, a direction lands at the
    radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8). It sees behind itself too, up to 180 degrees."""

    KIND: ClassVar[str] = "fisheye"

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def max_angle(self) -> float:
        """The angle where the polynomial turns back, pi at most."""
        return min(math.pi, _fold(self._radial))

    @property
    def _radial(self) -> tuple[float, float, float, float]:
        return self.k1, self.k2, self.k3, self.k4

    def _radius(self, theta: Float) -> tuple[Float, Float]:
        """theta (1 + k1 theta^2 + ...) and its derivative by theta."""
        s = theta * theta
        value, slope = _polynomial(s, self._radial)
        return theta * value, value + 2 * s * slope

    def distort(self, points: Float) -> Float:
        """As for :class:`Lens`: every direction has a position, beyond ``max_angle`` a false one; none is NaN."""
        across = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(across, points[:, 2])
        radius = self._radius(theta)[0]
        on_axis = across == 0
        ratio = np.where(on_axis, 0.0, radius / np.where(on_axis, 1.0, across))
        return points[:, :2] * ratio[:, None]

    def _undistort(self, plane: Float) -> Float:
        theta_d = np.hypot(plane[:, 0], plane[:, 1])
        theta = self._solve(theta_d)
        scale = np.where(theta_d > 0, np.sin(theta) / np.where(theta_d > 0, theta_d, 1.0), 1.0)
        return np.concatenate([plane * scale[:, None], np.cos(theta)[:, None]], axis=1)

    def _solve(self, theta_d: Float) -> Float:
        theta, fold = theta_d.copy(), _fold(self._radial)
        found = np.zeros(len(theta_d), dtype=bool)
        for _ in range(_MAX_STEPS):
            value, slope = self._radius(theta)
            error = value - theta_d
            good = (slope > 0) & (theta <= np.pi)
            done = good & (np.abs(error) <= TOLERANCE * (1 + theta))
            theta = np.where(good, theta - error / np.where(good, slope, 1.0), _PULL * theta)
            found = done & (theta <= fold)
            if found.all():
                break
        return np.where(found, theta, np.nan)


PINHOLE = BrownConrady()
"""No distortion at all."""


def with_coefficients(lens: Lens, given: Mapping[str, float | bool]) -> Lens:
    """``lens`` with coefficients replaced by name: k1 ... p2, and ``fisheye`` for the choice of the model.

    The one place that knows how intrinsics stated their lens before lenses were classes; zeros for coefficients that
    the model lacks are accepted, as files and callers write them.

    Raises:
        InputError: a coefficient that the model lacks is not zero.
    """
    values = dict(given)
    fisheye = values.pop("fisheye", isinstance(lens, Fisheye))
    model = type(lens) if fisheye == isinstance(lens, Fisheye) else (Fisheye if fisheye else BrownConrady)
    unknown = values.keys() - {*BrownConrady.names(), *model.names()}
    if unknown:
        raise TypeError(f"Intrinsics has no argument {min(unknown)!r}")
    for name in values.keys() - set(model.names()):
        if values[name]:
            raise InputError(f"a {model.KIND} lens has no coefficient {name}, got {name}={values[name]:g}")
    merged = {**lens.coefficients, **values}
    return model(**{name: merged[name] for name in model.names() if name in merged})


def _polynomial(s: Float, k: tuple[float, float, float, float]) -> tuple[Float, Float]:
    """1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4 and its derivative by s, (n,) each."""
    value = 1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    slope = k[0] + s * (2 * k[1] + s * (3 * k[2] + s * 4 * k[3]))
    return value, slope


def _fold(k: tuple[float, float, float, float]) -> float:
    """The radius (or angle) at which r (1 + k1 r^2 + ...) first turns back; beyond it lie false branches."""
    roots = np.roots([1.0, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])  # the derivative's, in 1 / r^2
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(1 / np.sqrt(real.max())) if len(real) else np.inf
