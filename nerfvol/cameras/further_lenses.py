"""Lenses that fewer programs write: OpenCV's rational model and COLMAP's field of view. Axes and units as in lens.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from nerfvol.cameras.lens import BrownConrady, Float, Lens
from nerfvol.errors import InputError


@dataclass(frozen=True)
class Rational(BrownConrady):
    """OpenCV's eight parameters (calib3d, CALIB_RATIONAL_MODEL), COLMAP's FULL_OPENCV: a BrownConrady lens whose radial
    factor is (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)."""

    KIND: ClassVar[str] = "rational"

    k5: float = 0.0
    k6: float = 0.0

    @property
    def _parts(self) -> tuple[list[float], list[float]]:
        """Numerator and denominator, the highest power of s first."""
        return [self.k3, self.k2, self.k1, 1.0], [self.k6, self.k5, self.k4, 1.0]

    def _factor(self, s: Float) -> tuple[Float, Float]:
        above, below = self._parts
        n, d = np.polyval(above, s), np.polyval(below, s)
        slope = np.polyval(np.polyder(above), s) * d - n * np.polyval(np.polyder(below), s)
        safe = np.where(d == 0, np.nan, d)
        return n / safe, slope / (safe * safe)

    @property
    def _fold(self) -> float:
        """Where r times the factor first turns back, or the factor has a pole."""
        above, below = self._parts
        bend = np.polysub(np.polymul(np.polyder(above), below), np.polymul(above, np.polyder(below)))
        turns = np.polyadd(np.polymul(above, below), np.polymul([2.0, 0.0], bend))
        roots = np.concatenate([np.roots(turns), np.roots(below)])
        real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(np.sqrt(real.min())) if len(real) else math.inf


@dataclass(frozen=True)
class FieldOfView(Lens):
    """COLMAP's FOV (Devernay and Faugeras 2001): a direction at r = tan(angle from the axis) lands at the radius
    atan(2 r tan(omega / 2)) / omega; ``omega``, in radians, from 0 (a pinhole) to below pi. What is not before the camera
    is not seen."""

    KIND: ClassVar[str] = "field-of-view"

    omega: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.omega < math.pi:
            raise InputError(f"camera intrinsic omega must be from 0 to below pi radians, got {self.omega:g}")

    @property
    def max_angle(self) -> float:
        """It never turns back before pi / 2."""
        return math.pi / 2

    def distort(self, points: Float) -> Float:
        """As for :class:`Lens`: points with Z <= 0 are not seen."""
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        plane = points[:, :2] / z[:, None]
        if self.omega < _SMALLEST:
            return plane
        r = np.hypot(plane[:, 0], plane[:, 1])
        ratio = np.arctan(2 * r * math.tan(self.omega / 2)) / (self.omega * np.where(r > 0, r, 1.0))
        return plane * np.where(r > 0, ratio, 2 * math.tan(self.omega / 2) / self.omega)[:, None]

    def _undistort(self, plane: Float) -> Float:
        flat = plane
        if self.omega >= _SMALLEST:
            r = np.hypot(plane[:, 0], plane[:, 1])
            inside = r * self.omega < math.pi / 2
            turned = np.tan(np.where(inside, r * self.omega, 0.0)) / (2 * math.tan(self.omega / 2))
            ratio = np.where(r > 0, turned / np.where(r > 0, r, 1.0), self.omega / (2 * math.tan(self.omega / 2)))
            flat = plane * np.where(inside, ratio, np.nan)[:, None]
        d = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        return d / np.sqrt((d * d).sum(axis=1, keepdims=True))


_SMALLEST = 1e-4
"""Radians of omega, below which the lens is a pinhole to 1e-9."""
