"""Settings: dataclasses filled from defaults < YAML file < command line, every value checked where it enters.

The machinery knows no setting by name: a dataclass field's type annotation says what fits, and nested dataclasses are
sections. ``Annotated[float | None, seconds]`` adds a parser, ``Annotated[float, within(0, 1)]`` a range; what a section
``Checked`` requires between its settings is looked at when all layers lie on each other.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from nerfvol.config.values import Checked, coerce, hints_of
from nerfvol.errors import InputError, shown
from nerfvol.files.atomic import read_text, write_text
from nerfvol.files.run_folder import CONFIG

T = TypeVar("T")


class _Loader(yaml.SafeLoader):
    """Plain values only, without aliases (which make a gigabyte of some lines) and with each key once."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem="aliases are not read", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key, _ in node.value:
            name = key.value if isinstance(key.value, str) else None
            if name is not None and name in seen:
                raise yaml.MarkedYAMLError(problem=f"{shown(name)} is stated twice", problem_mark=key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep=deep)


def _to_standard_error(sentence: str) -> None:
    print(f"nerfvol: {sentence}", file=sys.stderr)


def assemble(
    cls: type[T], *layers: tuple[Mapping[str, Any], str], say: Callable[[str], object] = _to_standard_error
) -> T:
    """An instance of the dataclass ``cls``: its defaults, then each ``(mapping, source name)`` on top of the last.

    A key that was renamed is taken for what it is called now; ``say`` gets a sentence about it.

    Raises:
        InputError: an unknown key (a near one is named), a value that does not fit
            its annotation, or settings that do not fit each other.
    """
    settings = cls()
    for mapping, source in layers:
        _update(settings, mapping, source, "", say)
    _check(settings)
    return settings


def _packaged(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    """``path``; where there is no such file, one of that name that comes with the package (``configs/smoke.yaml``)."""
    if os.path.exists(path) or Path(path).parent.name not in ("", "configs"):
        return path
    package = Path(__file__).resolve().parents[1]
    places = (package / "configs" / Path(path).name, package.parent / "configs" / Path(path).name)
    return next((place for place in places if place.is_file()), path)


def read_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML file, read with the loader that builds plain values only; empty where the file is.

    Raises:
        InputError: the file cannot be read, is no YAML, or holds something else than keys and values.
    """
    try:
        document = yaml.load(read_text(_packaged(path)), Loader=_Loader)
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a config file: it is not UTF-8 text") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError(f"{path} is not a config file: {problem}{place}") from error
    except RecursionError as error:
        raise InputError(f"{path} is not a config file: it is nested too deeply") from error
    except InputError:
        raise
    except ValueError as error:  # a number of more digits than Python converts, a date that is none
        raise InputError(f"{path} is not a config file: it holds a number or date that cannot be read") from error
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path} is not a config file: expected keys and values, got a {type(document).__name__}")
    return document


def to_plain(settings: Any) -> dict[str, Any]:
    """The dataclass ``settings`` as nested dicts and lists, as :func:`assemble` takes them."""
    return {field.name: _plain(getattr(settings, field.name)) for field in dataclasses.fields(settings)}


def write_yaml(path: str | os.PathLike[str], settings: Mapping[str, Any]) -> None:
    """Write ``settings``, as :func:`to_plain` makes them, to ``path`` as YAML, atomically and in their order."""
    write_text(path, yaml.safe_dump(dict(settings), sort_keys=False, allow_unicode=True))


def parse_assignment(text: str) -> dict[str, Any]:
    """``"octree.sh_degree=2"`` as ``{"octree": {"sh_degree": 2}}``; the value is read as YAML.

    Raises:
        InputError: it is no KEY=VALUE, or the value is no YAML.
    """
    key, equals, value = text.partition("=")
    if not equals or not all(part.isidentifier() for part in key.split(".")):
        raise InputError(f"--set expects KEY=VALUE such as octree.sh_degree=2, got {text!r}")
    try:
        nested: Any = yaml.load(value, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"--set {key}: {shown(value)} is not a YAML value") from error
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


def _update(settings: Any, mapping: Mapping[str, Any], source: str, prefix: str, say: Callable[[str], object]) -> None:
    hints = hints_of(type(settings))
    given: dict[str, str] = {}
    for key, value in mapping.items():
        name = str(key).replace("-", "_")
        now = settings.former.get(name) if isinstance(settings, Checked) else None
        if now in hints:
            say(f"{source}: {prefix}{name} is called {prefix}{now} now, and taken for it")
            name = now
        if name in given:
            raise InputError(f"{source}: {prefix}{name} is stated twice, as {given[name]} and as {key}")
        given[name] = str(key)
        if name not in hints:
            raise InputError(f"{source}: {_unknown(settings, name, prefix + str(key), prefix)}")
        current = getattr(settings, name)
        if _is_section(current):
            if not isinstance(value, Mapping):
                raise InputError(f"{source}: {prefix}{name} is a section, expected keys and values, got {shown(value)}")
            current = copy.copy(current)
            _update(current, value, source, f"{prefix}{name}.", say)
            value = current
        else:
            value = coerce(value, hints[name], f"{source}: {prefix}{name}")
        object.__setattr__(settings, name, value)  # also in frozen sections


def _check(settings: Any) -> None:
    for name in hints_of(type(settings)):
        if _is_section(section := getattr(settings, name)):
            _check(section)
    if isinstance(settings, Checked):
        settings.check()


def _is_section(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _unknown(settings: Any, name: str, key: str, prefix: str) -> str:
    """What is wrong with a key that is no setting, and what it may have meant."""
    former = settings.former.get(name) if isinstance(settings, Checked) else None
    if former is not None:
        return f"{key} is no longer a setting: {former}"
    known = list(hints_of(type(settings)))
    near = difflib.get_close_matches(name, known, n=1)
    inside = [
        f"{part}.{name}"
        for part in known
        if _is_section(getattr(settings, part)) and hasattr(getattr(settings, part), name)
    ]
    meant = [*near, *inside]
    return f"unknown key {shown(key)}" + (f"; did you mean {prefix + meant[0]!r}?" if meant else "")


def run_settings(target: str | os.PathLike[str]) -> dict[str, Any]:
    """The settings written in the run folder of RUN|FILE; empty where the file stands alone."""
    path = Path(target)
    config = (path if path.is_dir() else path.parent) / CONFIG
    return read_yaml(config) if config.is_file() else {}
