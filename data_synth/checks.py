"""Values that come from outside: one place to say what was expected and what came."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from data_synth.errors import InputError

LIMITS: dict[str, tuple[float, float]] = {
    "resolution": (8, 1024), "steps": (1, 100_000), "smooth": (1, 16), "haze": (0, 1e6), "density": (0, 1e9),
    "coverage": (0, 1), "erosion": (0, 0.99), "seed": (0, 2**31 - 1), "height": (1e-9, 1e9), "sigma": (0, 1e9),
    "radius": (1e-9, 1e9), "roughness": (0.01, 1), "thickness": (0, 1e6), "heat": (0, 1e6),
    "kelvin": (300, 40_000), "scale": (0.1, 64), "g": (-0.9999, 0.9999), "rain": (0, 1), "bars": (1, 64), "detail": (0, 8),
    "threads": (2, 256), "leaves": (1, 64), "thinning": (0, 1e6),
}  # fmt: skip
"""Of the parameters of scenes, by name."""


def vector(value: ArrayLike, name: str) -> np.ndarray:
    """Three finite numbers."""
    try:
        a = np.asarray(value, float)
    except (TypeError, ValueError):
        a = np.zeros(0)
    if a.shape != (3,) or not np.isfinite(a).all():
        raise InputError(f"{name}: expected three finite numbers, got {value}")
    return a


def direction(value: ArrayLike, name: str) -> np.ndarray:
    """Three finite numbers that are not all 0, at unit length."""
    a = vector(value, name)
    if not np.any(a):
        raise InputError(f"{name}: expected a direction, got {value}")
    return a / np.abs(a).max() / np.linalg.norm(a / np.abs(a).max())


def parameter(scene: str, key: str, value: object, default: object) -> object:
    """A parameter of a scene as its default's type, within ``LIMITS``; None and text as they are."""
    if not isinstance(default, (int, float)) or isinstance(default, bool):
        if value is not None and not isinstance(value, str):
            raise InputError(f"scene {scene}: {key} expects a name, got {value}")
        return value
    what = "a whole number" if isinstance(default, int) else "a number"
    low, high = LIMITS.get(key, (-math.inf, math.inf))
    what += f" from {low:.10g} to {high:.10g}" if math.isfinite(high) else ""
    if (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and math.isfinite(value)
        and low <= value <= high
    ):
        if isinstance(default, float):
            return float(value)
        if value == int(value):
            return int(value)
    raise InputError(f"scene {scene}: {key} expects {what}, got {value}")
