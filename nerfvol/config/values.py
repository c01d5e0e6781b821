"""Checked values: what a setting may hold, and the one way from what was written to it (for what people write: parsers.py)."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

from nerfvol.errors import InputError, shown


@dataclasses.dataclass(frozen=True)
class Interval:
    """Numbers from ``low`` to ``high``, both included; without ``low`` itself where it is ``open``."""

    low: float = -math.inf
    high: float = math.inf
    open: bool = False

    def check(self, value: float) -> None:
        """A ValueError where ``value`` lies outside."""
        if not self.low <= value <= self.high or self.open and value == self.low:
            raise ValueError(f"expected a number {self}, got {shown(value)}")

    def __str__(self) -> str:
        low, high = f"{self.low:.12g}", f"{self.high:.12g}"
        if self.open:
            return f"above {low}" + ("" if self.high == math.inf else f" and at most {high}")
        if self.high == math.inf:
            return f"of at least {low}"
        return f"of at most {high}" if self.low == -math.inf else f"from {low} to {high}"


def at_least(low: float) -> Interval:
    """For ``Annotated``: numbers of at least ``low``."""
    return Interval(low)


def above(low: float, high: float = math.inf) -> Interval:
    """For ``Annotated``: numbers above ``low``, up to ``high``."""
    return Interval(low, high, open=True)


def within(low: float, high: float) -> Interval:
    """For ``Annotated``: numbers from ``low`` to ``high``."""
    return Interval(low, high)


Count = Annotated[int, at_least(1)]
Rate = Annotated[float, within(0, 1e3)]
Share = Annotated[float, within(0, 1)]
Decay = Annotated[float, above(0, 1)]
Weight = Annotated[float, at_least(0)]


def coerce(value: Any, hint: Any, place: str) -> Any:
    """``value`` as the type ``hint``, or an :class:`InputError` that starts with ``place``.

    Understands bool, int, float (finite), str, Path, None, Literal, unions, tuples, lists, dicts, dataclasses, and in
    ``Annotated`` parsers, which run before the type is checked, and an :class:`Interval`, which is checked after it.
    Strings that spell a number are numbers, for YAML 1.1 reads 1e-3 as a string.
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
        value = _coerce(value, arguments[0])
        for interval in arguments[1:]:
            if isinstance(interval, Interval):
                interval.check(value)
        return value
    if origin is Literal:
        if value not in arguments or isinstance(value, bool) and not any(value is choice for choice in arguments):
            raise ValueError(f"expected {' or '.join(map(str, arguments))}, got {shown(value)}")
        return value
    if origin in (typing.Union, types.UnionType):
        return _coerce_union(value, arguments)
    if origin in (tuple, list):
        return _coerce_sequence(value, origin, arguments)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ValueError(f"expected keys and values, got {shown(value)}")
        return {_coerce(key, arguments[0]): _coerce(item, arguments[1]) for key, item in value.items()}
    if dataclasses.is_dataclass(hint) and isinstance(hint, type) and not isinstance(value, hint):
        raise ValueError(f"expected {hint.__name__}(...), got {shown(value)}")
    return _SCALARS[hint](value) if hint in _SCALARS else value


class Checked:
    """A dataclass of settings whose values are checked by their annotations however it is made: from a file, the command
    line or a call. ``section`` is its place among the settings ("octree"; "" at the top).

    former: settings that are no more, by name: the present name of the same thing, which is then set, with a sentence; or a
    reason with a blank in it ("it is always 8") where there is none, with which the setting is refused.
    """

    section: ClassVar[str] = ""
    former: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        prefix = f"{self.section}." if self.section else ""
        for name, hint in hints_of(type(self)).items():
            value = coerce(getattr(self, name), hint, prefix + name)
            object.__setattr__(self, name, value)  # also in frozen sections
        self.check()

    def check(self) -> None:
        """An InputError where settings do not fit each other; each alone is right."""


@functools.cache
def hints_of(cls: type) -> dict[str, Any]:
    """The annotations of a dataclass's fields by name, ``Annotated`` as it is written."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cast(Any, cls)) if field.init}


def same_length(settings: Checked, *names: str) -> None:
    """An InputError unless these lists of ``settings`` have as many entries as the first, and that some."""
    n = len(getattr(settings, names[0]))
    if not n:
        raise InputError(f"{settings.section}.{names[0]} must have an entry for each stage, got none")
    for name in names[1:]:
        if (got := len(getattr(settings, name))) != n:
            raise InputError(
                f"{settings.section}.{name} must have one entry per stage, as many as {settings.section}.{names[0]} ({n}), "
                f"got {got}"
            )


def increasing_to_one(settings: Checked, name: str) -> None:
    """An InputError unless this list of ``settings`` increases and ends with 1."""
    ends = list(getattr(settings, name))
    if ends != sorted(ends) or ends[-1] != 1:
        raise InputError(f"{settings.section}.{name} must increase and end with 1, got {ends}")


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
        raise ValueError(f"expected a list, got {shown(value)}")
    if kind is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        if len(value) != len(arguments):
            raise ValueError(f"expected a list of {len(arguments)}, got {len(value)}: {shown(value)}")
        return tuple(_coerce(item, hint) for item, hint in zip(value, arguments, strict=True))
    return kind(_coerce(item, arguments[0]) for item in value)


def _boolean(value: Any) -> bool:
    words = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
    if isinstance(value, str) and value.strip().lower() in words:
        return words[value.strip().lower()]
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false, got {shown(value)}")
    return value


def _integer(value: Any) -> int:
    number = finite_number(value, "a whole number")
    if number != int(number):
        raise ValueError(f"expected a whole number, got {shown(value)}")
    return int(value) if isinstance(value, (int, str)) and str(value).strip().lstrip("+-").isdigit() else int(number)


def finite_number(value: Any, expected: str = "a number") -> float:
    """``value``, a number or its spelling, as a float; ValueError with what was ``expected`` for others."""
    if not isinstance(value, (int, float, str)) or isinstance(value, bool):
        raise ValueError(f"expected {expected}, got {shown(value)}")
    try:
        number = float(value)
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"expected {expected}, got {shown(value)}")
    return number


def _string(value: Any) -> str:
    if not isinstance(value, (str, Path)):
        raise ValueError(f"expected text, got {shown(value)}")
    return str(value)


_SCALARS: dict[Any, Callable[[Any], Any]] = {
    bool: _boolean,
    int: _integer,
    float: finite_number,
    str: _string,
    Path: lambda value: Path(_string(value)),
}


T = TypeVar("T")


def filled(settings: T, automatic: Mapping[str, Any]) -> T:
    """The dataclass ``settings`` with a value of ``automatic`` for each of these that is None."""
    chosen = {name: value for name, value in automatic.items() if getattr(settings, name) is None}
    return dataclasses.replace(cast(Any, settings), **chosen)
