"""Settings: dataclasses filled from defaults < YAML file < command line, every value checked where it enters.

The machinery knows no setting by name: a dataclass field's type annotation says what fits, and nested dataclasses are
sections. ``Annotated[float | None, seconds]`` adds a parser that runs before the type is checked.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from nerfvol.config.values import coerce
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_bytes, write_text
from nerfvol.files.run_folder import CONFIG

T = TypeVar("T")


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
        if dataclasses.is_dataclass(current) and not isinstance(current, type):
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


def run_settings(target: str | os.PathLike[str]) -> dict[str, Any]:
    """The settings written in the run folder of RUN|FILE; empty where the file stands alone."""
    path = Path(target)
    config = (path if path.is_dir() else path.parent) / CONFIG
    return read_yaml(config) if config.is_file() else {}
