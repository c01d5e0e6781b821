"""Settings: dataclasses filled from defaults < YAML file < command line, every value checked where it enters.

The machinery knows no setting by name: a dataclass field's type annotation says what fits, and nested dataclasses are
sections. ``Annotated[float | None, seconds]`` adds a parser that runs before the type is checked.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml

from nerfvol.errors import InputError
from nerfvol.files import read_bytes, write_text
from nerfvol.settings import DistillConfig, FieldConfig, OctreeConfig

T = TypeVar("T")
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


@dataclass
class Config:
    """Everything one training run depends on. ``nerfvol train`` writes it, resolved, to RUN/config.yaml."""

    data: str = ""
    """Folder (or transforms JSON) of posed images."""
    out: str = ""
    """Run folder."""
    init: Literal["mlp", "direct"] = "direct"
    """Where the octree starts: a small MLP field that is trained and distilled, or a thin, nearly empty octree."""
    time_budget: Annotated[float | None, seconds] = None
    """Seconds of wall clock for everything, from the start of the process; None: the sections' numbers of steps."""
    background: Colour = (1.0, 1.0, 1.0)
    """Colour behind the scene, RGB in [0, 1]; images with alpha are composited on it."""
    downscale: Count = 1
    """Images are area-averaged by this whole factor."""
    threads: int = 0
    """CPU threads; 0: all cores this process may use."""
    seed: int = 0
    resume: bool = False
    """Go on from RUN's checkpoint."""
    checkpoint_every: Seconds = 30.0
    """Seconds between checkpoints."""
    storage: Literal["float32", "float16", "compact"] = "compact"
    """How octree files hold their values: exactly, halved, or quantised to about a tenth (docs/file_format.md)."""
    compare_views: Count = 2
    """Held-out views on which field, distilled and fine-tuned octree are compared (a field renders slowly)."""
    field: Any = dataclasses.field(default_factory=FieldConfig)
    """Section: the MLP field (nerfvol.settings.FieldConfig)."""
    distill: Any = dataclasses.field(default_factory=DistillConfig)
    """Section: the field's way into the octree (nerfvol.settings.DistillConfig)."""
    octree: OctreeConfig = dataclasses.field(default_factory=OctreeConfig)
    """Section: the octree and its optimisation (nerfvol.settings.OctreeConfig)."""


def assemble(cls: type[T], *layers: tuple[Mapping[str, Any], str]) -> T:
    """An instance of the dataclass ``cls``: its defaults, then each ``(mapping, source name)`` on top of the last.

    Raises:
        InputError: an unknown key (the nearest known one is named) or a value that does not fit its annotation.
    """
    settings = cls()
    for mapping, source in layers:
        _update(settings, mapping, source, "")
    return settings


def read_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML file, read with the loader that builds plain values only."""
    try:
        document = yaml.safe_load(read_bytes(path).decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a config file: it is not UTF-8 text") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError(f"{path} is not a config file: {problem}{place}") from error
    except RecursionError as error:
        raise InputError(f"{path} is not a config file: it is nested too deeply") from error
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path} is not a config file: expected keys and values, got a {type(document).__name__}")
    return document


def to_plain(settings: Any) -> dict[str, Any]:
    """The dataclass ``settings`` as nested dicts and lists, as :func:`assemble` takes them."""
    return {field.name: _plain(getattr(settings, field.name)) for field in dataclasses.fields(settings)}


def write_yaml(path: str | os.PathLike[str], settings: Any) -> None:
    """Write the dataclass ``settings`` to ``path`` as YAML, atomically, in the order of its fields."""
    write_text(path, yaml.safe_dump(to_plain(settings), sort_keys=False, allow_unicode=True))


def parse_assignment(text: str) -> dict[str, Any]:
    """``"octree.sh_degree=2"`` as ``{"octree": {"sh_degree": 2}}``; the value is read as YAML."""
    key, equals, value = text.partition("=")
    if not equals or not all(part.isidentifier() for part in key.split(".")):
        raise InputError(f"--set expects KEY=VALUE such as octree.sh_degree=2, got {text!r}")
    try:
        nested: Any = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise InputError(f"--set {key}: {value!r} is not a YAML value") from error
    for part in reversed(key.split(".")):
        nested = {part: nested}
    return nested


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_plain(value)
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return str(value) if isinstance(value, Path) else value


def _update(settings: Any, mapping: Mapping[str, Any], source: str, prefix: str) -> None:
    known = {field.name for field in dataclasses.fields(settings) if field.init}
    hints = typing.get_type_hints(type(settings), include_extras=True)
    values = {}
    for key, value in mapping.items():
        name = str(key).replace("-", "_")
        if name not in known:
            raise InputError(f"{source}: unknown key {prefix + str(key)!r}{_nearest(name, known, prefix)}")
        current = getattr(settings, name)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(f"{source}: {prefix}{name} is a section, expected keys and values, got {value!r}")
            current = dataclasses.replace(current)
            _update(current, value, source, f"{prefix}{name}.")
            values[name] = current
        else:
            values[name] = coerce(value, hints[name], f"{source}: {prefix}{name}")
    for name, value in values.items():
        object.__setattr__(settings, name, value)  # also for frozen sections
    check = getattr(settings, "__post_init__", None)
    if values and check is not None:
        try:
            check()
        except InputError as error:
            raise InputError(f"{source}: {error}") from error


def _nearest(name: str, known: set[str], prefix: str) -> str:
    close = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.0)
    return f"; did you mean {prefix + close[0]!r}?" if close else ""


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
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ValueError(f"expected keys and values, got {value!r}")
        return assemble(typing.cast(type, hint), (value, "entry"))
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
