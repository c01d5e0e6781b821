"""Checked values: what a setting may hold, and the one way from what a person wrote to it."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from nerfvol.errors import InputError

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


_COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def seconds(value: Any) -> Any:
    """A duration in seconds from 120, "120", "120s", "5m", "1.5h"; "none" and None mean no limit."""
    if value is None or isinstance(value, str) and value.strip().lower() in ("none", "null", ""):
        return None
    text = str(value).strip().lower()
    number, unit = (text[:-1], text[-1]) if text[-1:] in _UNITS else (text, "s")
    try:
        duration = float(number) * _UNITS[unit]
    except ValueError:
        duration = math.nan
    if not (math.isfinite(duration) and duration > 0):
        raise ValueError(f"expected a duration such as 120s, 5m or 1h, got {value!r}")
    return duration


def colour(value: Any) -> Any:
    """An RGB colour with components in [0, 1] from "white", "black", "R,G,B" or a list of three numbers."""
    parts = value.split(",") if isinstance(value, str) else value
    if isinstance(value, str) and value.strip().lower() in _COLOURS:
        return _COLOURS[value.strip().lower()]
    try:
        components = tuple(float(part) for part in parts)
    except (TypeError, ValueError):
        components = ()
    if len(components) != 3 or not all(0.0 <= component <= 1.0 for component in components):
        raise ValueError(f"expected white, black or R,G,B with numbers from 0 to 1, got {value!r}")
    return components


Seconds = Annotated[float, seconds]


Colour = Annotated[tuple[float, float, float], colour]


def positive(value: Any) -> Any:
    """Refuses numbers below 1 (counts, sizes); what is no number is for the type's own check to refuse."""
    try:
        too_small = float(value) < 1
    except (TypeError, ValueError):
        return value
    if too_small:
        raise ValueError(f"expected a number of at least 1, got {value!r}")
    return value


Count = Annotated[int, positive]


def coerce(value: Any, hint: Any, place: str) -> Any:
    """``value`` as the type ``hint``, or an :class:`InputError` that starts with ``place``.

    Understands bool, int, float (finite), str, Path, None, Literal, unions, tuples, lists, dicts, dataclasses and
    ``Annotated`` parsers. Strings that spell a number are numbers, for YAML 1.1 reads 1e-3 as a string.
    """
    try:
        return _coerce(value, hint)
    except InputError as error:
        raise InputError(f"{place}: {error}") from error
    except ValueError as error:
        raise InputError(f"{place}: {error}") from error


def _coerce(value: Any, hint: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin is Annotated:
        for parse in filter(callable, arguments[1:]):
            value = parse(value)
        return _coerce(value, arguments[0])
    if origin is Literal:
        if value not in arguments or isinstance(value, bool) and not any(value is choice for choice in arguments):
            raise ValueError(f"expected {' or '.join(map(str, arguments))}, got {value!r}")
        return value
    if origin in (typing.Union, types.UnionType):
        return _coerce_union(value, arguments)
    if origin in (tuple, list):
        return _coerce_sequence(value, origin, arguments)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ValueError(f"expected keys and values, got {value!r}")
        return {_coerce(key, arguments[0]): _coerce(item, arguments[1]) for key, item in value.items()}
    return _SCALARS[hint](value) if hint in _SCALARS else value


def _coerce_union(value: Any, choices: tuple[Any, ...]) -> Any:
    if value is None and type(None) in choices:
        return None
    first_error = None
    for choice in choices:
        if choice is type(None):
            continue
        try:
            return _coerce(value, choice)
        except ValueError as error:
            first_error = first_error or error
    assert first_error is not None
    raise first_error


def _coerce_sequence(value: Any, kind: type, arguments: tuple[Any, ...]) -> Any:
    if isinstance(value, str):
        value = [part.strip() for part in value.split(",")]
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"expected a list, got {value!r}")
    if kind is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        if len(value) != len(arguments):
            raise ValueError(f"expected a list of {len(arguments)}, got {len(value)}: {value!r}")
        return tuple(_coerce(item, hint) for item, hint in zip(value, arguments, strict=True))
    return kind(_coerce(item, arguments[0]) for item in value)


def _boolean(value: Any) -> bool:
    words = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
    if isinstance(value, str) and value.strip().lower() in words:
        return words[value.strip().lower()]
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false, got {value!r}")
    return value


def _integer(value: Any) -> int:
    number = _number(value, "a whole number")
    if number != int(number):
        raise ValueError(f"expected a whole number, got {value!r}")
    return int(value) if isinstance(value, (int, str)) and str(value).strip().lstrip("+-").isdigit() else int(number)


def _number(value: Any, expected: str = "a number") -> float:
    if not isinstance(value, (int, float, str)) or isinstance(value, bool):
        raise ValueError(f"expected {expected}, got {value!r}")
    try:
        number = float(value)
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"expected {expected}, got {value!r}")
    return number


def _string(value: Any) -> str:
    if not isinstance(value, (str, Path)):
        raise ValueError(f"expected text, got {value!r}")
    return str(value)


_SCALARS: dict[Any, Callable[[Any], Any]] = {
    bool: _boolean,
    int: _integer,
    float: _number,
    str: _string,
    Path: lambda value: Path(_string(value)),
}


AOVS = ("depth", "median_depth", "opacity", "normal")


def image_size(value: Any) -> Any:
    """(width, height) from "WxH" or a list of two whole numbers; at most 16384 a side."""
    parts = value.lower().replace("×", "x").split("x") if isinstance(value, str) else value
    try:
        size = tuple(int(part) for part in parts)
    except (TypeError, ValueError):
        size = ()
    if len(size) != 2 or not all(1 <= side <= 16384 for side in size):
        raise ValueError(f"expected a size such as 800x600 (1 to 16384 pixels a side), got {value!r}")
    return size


def aov_names(value: Any) -> Any:
    """Names of extra pictures from "depth,normal" or a list."""
    names = [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value
    for name in names:
        if name not in AOVS:
            raise ValueError(f"expected names out of {', '.join(AOVS)}, got {name!r}")
    return tuple(names)


def fraction(value: Any) -> Any:
    """A number in [0, 1)."""
    number = float(value)
    if not 0.0 <= number < 1.0:
        raise ValueError(f"expected a number from 0 (exact) to below 1, got {value!r}")
    return number


def pixels(value: Any) -> Any:
    """A finite number >= 0."""
    number = float(value)
    if not 0.0 <= number < math.inf:
        raise ValueError(f"expected a number of pixels, 0 (off) or more, got {value!r}")
    return number


def box(value: Any) -> Any:
    """Two corners from "x0,y0,z0,x1,y1,z1" or a list of six numbers, the first below the second; None stays."""
    if value is None or isinstance(value, str) and value.strip().lower() in ("none", "null", ""):
        return None
    parts = value.split(",") if isinstance(value, str) else value
    try:
        numbers = tuple(float(part) for part in parts)
    except (TypeError, ValueError):
        numbers = ()
    low, high = numbers[:3], numbers[3:]
    if len(numbers) != 6 or not all(a < b and math.isfinite(b - a) for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"expected x0,y0,z0,x1,y1,z1 with the first corner below the second on each axis, got {value!r}"
        )
    return numbers


Size = Annotated[tuple[int, int], image_size]
