"""What a person writes for a setting, as its value: durations, colours, sizes, frames, boxes.

They stand in ``Annotated`` hints (config/values.py): what is a value already stays as it is, and a ValueError says what was
expected.
"""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Annotated, Any

from nerfvol.config.values import finite_number
from nerfvol.errors import shown

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def seconds(value: Any) -> Any:
    """A duration in seconds from 120, "120", "120s", "5m", "1.5h"; "none" and None mean no limit. ValueError for others."""
    if value is None or isinstance(value, str) and value.strip().lower() in ("none", "null", ""):
        return None
    try:
        text = str(value).strip().lower() if isinstance(value, (str, int, float)) else ""
        number, unit = (text[:-1], text[-1]) if text[-1:] in _UNITS else (text, "s")
        duration = float(number) * _UNITS[unit]
    except ValueError:
        duration = math.nan
    if not (math.isfinite(duration) and duration > 0):
        raise ValueError(f"expected a duration such as 120s, 5m or 1h, got {shown(value)}")
    return duration


def colour(value: Any) -> Any:
    """An RGB colour with components in [0, 1] from "white", "black", "R,G,B" or a list of three numbers.

    Raises ValueError for others.
    """
    parts = value.split(",") if isinstance(value, str) else value
    if isinstance(value, str) and value.strip().lower() in _COLOURS:
        return _COLOURS[value.strip().lower()]
    try:
        components = tuple(float(part) for part in parts)
    except (TypeError, ValueError, OverflowError):
        components = ()
    if len(components) != 3 or not all(0.0 <= component <= 1.0 for component in components):
        raise ValueError(f"expected white, black or R,G,B with numbers from 0 to 1, got {shown(value)}")
    return components


Seconds = Annotated[float, seconds]
Colour = Annotated[tuple[float, float, float], colour]


AOVS = ("depth", "median_depth", "opacity", "normal")


def image_size(value: Any) -> Any:
    """(width, height) from "WxH" or a list of two whole numbers, 1 to 16384 pixels a side; ValueError for others."""
    parts = value.lower().replace("×", "x").split("x") if isinstance(value, str) else value
    try:
        size = tuple(int(part) for part in parts)
    except (TypeError, ValueError, OverflowError):
        size = ()
    if len(size) != 2 or not all(1 <= side <= 16384 for side in size):
        raise ValueError(f"expected a size such as 800x600 (1 to 16384 pixels a side), got {shown(value)}")
    return size


def aov_names(value: Any) -> Any:
    """Names of extra pictures, of those in AOVS, from "depth,normal" or a list; ValueError for another name."""
    names = [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value
    for name in names if isinstance(names, (list, tuple)) else (names,):
        if name not in AOVS:
            raise ValueError(f"expected names out of {', '.join(AOVS)}, got {shown(name)}")
    return tuple(names)


@dataclasses.dataclass(frozen=True)
class Frames:
    """Of a path: ``count`` pictures, or those from ``first`` to ``last`` in steps of ``step``."""

    count: int | None = None
    first: int = 0
    last: int = 0
    step: int = 1


def frame_choice(value: Any) -> Any:
    """Frames from "N", "A-B" or "A-B/S"; None stays. ValueError for others."""
    if value is None or isinstance(value, Frames):
        return value
    match = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9})(?:/(\d{1,9}))?)?", str(value).strip(), re.ASCII)
    if match is None:
        raise ValueError(f"expected a number of frames, or the frames A-B or A-B/S of a path, got {shown(value)}")
    first, last, step = (None if part is None else int(part) for part in match.groups())
    if last is None:
        if not first:
            raise ValueError("expected at least one frame, got 0")
        return Frames(count=first)
    if last < (first or 0) or step == 0:
        raise ValueError(f"expected the frames A-B/S with A up to B and S at least 1, got {shown(value)}")
    return Frames(None, first or 0, last, step or 1)


def fraction(value: Any) -> Any:
    """A number in [0, 1); ValueError for another."""
    number = finite_number(value)
    if not 0.0 <= number < 1.0:
        raise ValueError(f"expected a number from 0 (exact) to below 1, got {shown(value)}")
    return number


def pixels(value: Any) -> Any:
    """A finite number >= 0; ValueError for another."""
    number = finite_number(value)
    if not 0.0 <= number < math.inf:
        raise ValueError(f"expected a number of pixels, 0 (off) or more, got {shown(value)}")
    return number


def byte_count(value: Any) -> Any:
    """Bytes from a number or "2MB", "500kB", "1.5 GB" (powers of ten); None stays. Raises ValueError for others."""
    if value is None or type(value) is int and value > 0:
        return value
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kMG]?)B?\s*", str(value), re.IGNORECASE)
    if match is None or not (count := round(float(match[1]) * 1000 ** " kmg".index(match[2].lower() or " "))):
        raise ValueError(f"expected bytes such as 2000000, 500kB or 2MB, got {value!r}")
    return count


def box(value: Any) -> Any:
    """Two corners from "x0,y0,z0,x1,y1,z1" or a list of six numbers, the first below the second; None stays.

    Raises ValueError for others.
    """
    if value is None or isinstance(value, str) and value.strip().lower() in ("none", "null", ""):
        return None
    parts = value.split(",") if isinstance(value, str) else value
    try:
        numbers = tuple(float(part) for part in parts)
    except (TypeError, ValueError, OverflowError):
        numbers = ()
    low, high = numbers[:3], numbers[3:]
    if len(numbers) != 6 or not all(a < b and math.isfinite(b - a) for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"expected x0,y0,z0,x1,y1,z1 with the first corner below the second on each axis, got {shown(value)}"
        )
    return numbers


Size = Annotated[tuple[int, int], image_size]
