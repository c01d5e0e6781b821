"""Lens distortion, both ways, in float64: OpenCV's pinhole (Brown-Conrady) and fisheye (Kannala-Brandt) models.

Here axes are OpenCV's: x right, y down, z forward. ``coefficients`` are (k1, k2, k3, k4, p1, p2).

Pinhole, with x = X/Z, y = Y/Z and s = x^2 + y^2:
    x' = x (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4) + 2 p1 x y + p2 (s + 2 x^2)
    y' = y (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4) + p1 (s + 2 y^2) + 2 p2 x y
k1, k2, p1, p2, k3 are the five parameters of OpenCV's calib3d; k4 is the s^4 term nerfstudio adds, not OpenCV's
rational k4.
Fisheye, with theta the angle from the axis: |(x', y')| = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError

Float = NDArray[np.float64]
Coefficients = tuple[float, float, float, float, float, float]

TOLERANCE = 1e-12
_MAX_STEPS = 50
_PULL = 0.8


def distort(points: Float, coefficients: Coefficients, fisheye: bool = False) -> Float:
    """Positions (n, 2) on the distorted image plane of points or directions (n, 3); NaN behind a pinhole (z <= 0)."""
    if fisheye:
        across = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(across, points[:, 2])
        radius = _fisheye_radius(theta, coefficients)[0]
        on_axis = across == 0
        ratio = np.where(on_axis, 0.0, radius / np.where(on_axis, 1.0, across))
        return points[:, :2] * ratio[:, None]
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    return _brown(points[:, :2] / z[:, None], coefficients)


def undistort(plane: Float, coefficients: Coefficients, fisheye: bool = False) -> Float:
    """Unit directions (n, 3) that land at positions (n, 2) of the distorted plane, by Newton's method to 1e-12.

    Raises InputError where no direction does: beyond the radius where its polynomial turns back a lens has no inverse.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows does not converge, and is refused
        return _undistort(plane, coefficients, fisheye)


def _undistort(plane: Float, coefficients: Coefficients, fisheye: bool) -> Float:
    if fisheye:
        theta_d = np.hypot(plane[:, 0], plane[:, 1])
        theta = _solve_fisheye(theta_d, coefficients)
        scale = np.where(theta_d > 0, np.sin(theta) / np.where(theta_d > 0, theta_d, 1.0), 1.0)
        return np.concatenate([plane * scale[:, None], np.cos(theta)[:, None]], axis=1)
    flat = _solve_brown(plane, coefficients) if any(coefficients) else plane
    d = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    return d / np.sqrt((d * d).sum(axis=1, keepdims=True))


def _radial(s: Float, c: Coefficients) -> tuple[Float, Float]:
    """1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4 and its derivative by s."""
    value = 1 + s * (c[0] + s * (c[1] + s * (c[2] + s * c[3])))
    slope = c[0] + s * (2 * c[1] + s * (3 * c[2] + s * 4 * c[3]))
    return value, slope


def _fold(c: Coefficients) -> float:
    """The radius (or angle) at which r (1 + k1 r^2 + ...) first turns back; beyond it lie false branches."""
    roots = np.roots([1.0, 3 * c[0], 5 * c[1], 7 * c[2], 9 * c[3]])  # the derivative's, in 1 / r^2
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(1 / np.sqrt(real.max())) if len(real) else np.inf


def _brown(plane: Float, c: Coefficients) -> Float:
    x, y = plane[:, 0], plane[:, 1]
    p1, p2 = c[4], c[5]
    s = x * x + y * y
    radial = _radial(s, c)[0]
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y], axis=1
    )


def _solve_brown(plane: Float, c: Coefficients) -> Float:
    """Undistorted plane positions, on the branch that contains the axis: a step off it is pulled back inwards."""
    x, y = plane[:, 0].copy(), plane[:, 1].copy()
    p1, p2 = c[4], c[5]
    for _ in range(_MAX_STEPS):
        s = x * x + y * y
        radial, slope = _radial(s, c)
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
        if done.all() and np.sqrt(x * x + y * y).max(initial=0.0) <= _fold(c):
            return np.stack([x, y], axis=1)
    raise _no_inverse(plane, c, "pinhole")


def _fisheye_radius(theta: Float, c: Coefficients) -> tuple[Float, Float]:
    """theta (1 + k1 theta^2 + ...) and its derivative by theta."""
    s = theta * theta
    value, slope = _radial(s, c)
    return theta * value, value + 2 * s * slope


def _solve_fisheye(theta_d: Float, c: Coefficients) -> Float:
    theta = theta_d.copy()
    for _ in range(_MAX_STEPS):
        value, slope = _fisheye_radius(theta, c)
        error = value - theta_d
        good = (slope > 0) & (theta <= np.pi)
        done = good & (np.abs(error) <= TOLERANCE * (1 + theta))
        theta = np.where(good, theta - error / np.where(good, slope, 1.0), _PULL * theta)
        if done.all() and theta.max(initial=0.0) <= _fold(c):
            return theta
    raise _no_inverse(theta_d[:, None], c, "fisheye")


def _no_inverse(plane: Float, c: Coefficients, model: str) -> InputError:
    radius = float(np.sqrt((plane * plane).sum(axis=1)).max())
    names = ", ".join(f"{n}={v:g}" for n, v in zip(("k1", "k2", "k3", "k4", "p1", "p2"), c, strict=True) if v)
    return InputError(
        f"the {model} lens distortion ({names or 'none'}) cannot be undone at every pixel: the model turns back on "
        f"itself within the image, which reaches {radius:.3g} focal lengths from the axis"
    )
