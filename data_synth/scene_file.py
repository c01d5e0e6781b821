"""Scenes from YAML files: every object of data_synth under the name of the function that makes it.

    medium: {volume: {file: smoke.vdb, sigma_t: 9, albedo: 0.9, phase: {henyey_greenstein: 0.4}}}
    media: {ink: {homogeneous: {lo: [-1, -1, -1], hi: [1, 1, 1], sigma_t: [2, 5, 9]}}}
    materials:
      floor: {lambert: {albedo: 0.6, second: 0.2, square: 0.25}}
      glass: {dielectric: {ior: 1.5, medium: ink}}
    shapes:
      - plane: {material: floor, point: [0, 0, -1], normal: [0, 0, 1]}
      - sphere: {material: glass, centre: [0, 0, 0], radius: 0.5}
    lights: [sun, {point: {position: [1, 1, 1], intensity: 5}}]
    viewpoints: {radius: 4, elevation: [5, 60], fov: 40}
    integrators: [path, march]

An object is {kind: {argument: value}}; the arguments are those of the functions in KINDS, checked by name. A file is data:
nothing in it is executed. Duplicate keys, anchors and tags are refused.
"""

from __future__ import annotations

import difflib
import inspect
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from data_synth import materials, scenes
from data_synth.cameras import Viewpoints
from data_synth.crossings import LevelSet
from data_synth.errors import InputError
from data_synth.integrators import INTEGRATORS
from data_synth.kinds import KINDS
from data_synth.scene import Scene

LARGEST = 64 << 20  # bytes of a file


class _Loader(yaml.SafeLoader):
    """Plain data, once each."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem="an alias: every object is written out", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [key.value for key, _ in node.value]
        for k, (key, _) in enumerate(node.value):
            if key.value in keys[:k]:
                raise yaml.MarkedYAMLError(problem=f"the key {key.value} a second time", problem_mark=key.start_mark)
        return super().construct_mapping(node, deep)


TOP = (
    "name", "medium", "media", "materials", "shapes", "lights", "bounded", "opaque_sky", "viewpoints", "aabb",
    "integrators", "exposure",
)  # fmt: skip


def load(path: str | os.PathLike) -> Scene:
    """The scene of a file. InputError, one sentence that names file and place, for whatever is wrong with it."""
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path}: expected a scene file of at most {LARGEST >> 20} MiB")
        data = yaml.load(path.read_text("utf-8"), _Loader)  # noqa: S506, a SafeLoader
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected a scene in UTF-8 text") from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}: expected YAML, found {getattr(error, 'problem', None) or 'none'}{where}") from error
    return _File(path).scene(data)


class _File:
    """What is read so far: the names that later objects may use."""

    def __init__(self, path: Path) -> None:
        self.path, self.media, self.materials, self.layers = path, {}, {}, []

    def fail(self, where: str, what: str) -> InputError:
        return InputError(f"{self.path}: {where}: {what}")

    def scene(self, data: Any) -> Scene:
        top = self.mapping("the file", data, TOP)
        scene = Scene(name=str(top.get("name", self.path.stem)))
        if "medium" in top:
            scene.medium = self.make("medium", top["medium"], "medium")
        for k, (name, given) in enumerate(self.mapping("media", top.get("media", {})).items(), 1):
            scene.media.append(self.make("medium", given, f"media.{name}"))
            self.media[name] = k
        for k, (name, given) in enumerate(self.mapping("materials", top.get("materials", {})).items()):
            scene.materials.append(self.make("material", given, f"materials.{name}"))
            self.materials[name] = k
        made = [self.make("shape", s, f"shapes[{k}]") for k, s in enumerate(self.sequence("shapes", top))]
        scene.level_sets = [s for s in made if isinstance(s, LevelSet)]
        arrays = [s for s in made if not isinstance(s, LevelSet)]
        scene.shapes = [s for s in arrays if s.ndim == 1]
        meshes = [s for s in arrays if s.ndim == 2]
        scene.triangles = np.concatenate(meshes) if meshes else None
        scene.layers = self.layers
        scene.lights = [self.make("light", s, f"lights[{k}]") for k, s in enumerate(self.sequence("lights", top))]
        for key in ("bounded", "opaque_sky"):
            if not isinstance(top.get(key, False), bool):
                raise self.fail(key, f"expected true or false, got {top[key]}")
            setattr(scene, key, top.get(key, False))
        if "viewpoints" in top:
            scene.viewpoints = self.call(Viewpoints, top["viewpoints"], "viewpoints")
        scene.aabb = self.aabb(top, scene)
        scene.exposure = self.exposure(top)
        names = top.get("integrators", ["path", "march", "deep", "emission"])
        if not isinstance(names, list) or not names or not all(n in INTEGRATORS for n in names):
            raise self.fail("integrators", f"expected a list of {', '.join(INTEGRATORS)}, got {names}")
        scene.integrators = tuple(names)
        scene.parameters = {"file": str(self.path)}
        (scene.in_channels() or [scene])[0].world(1)  # checks what belongs together
        return scene

    def exposure(self, top: Mapping) -> float:
        value = top.get("exposure", 1.0)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
            raise self.fail("exposure", f"expected a positive number, got {value}")
        return float(value)

    def aabb(self, top: Mapping, scene: Scene) -> np.ndarray:
        """The given region, or the box around the media."""
        boxes = [(m.lo, m.hi) for m in (scene.medium, *scene.media) if m is not None]
        default = (
            [np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)] if boxes else scene.aabb
        )
        try:
            box = np.asarray(top.get("aabb", default), float)
        except (TypeError, ValueError):
            box = np.zeros(0)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise self.fail("aabb", f"expected two corners with lo < hi, got {top.get('aabb')}")
        return box

    def sequence(self, name: str, top: Mapping) -> list:
        given = top.get(name, [])
        if not isinstance(given, list):
            raise self.fail(name, f"expected a list, got {given}")
        return given

    def mapping(self, where: str, given: Any, known: Collection[str] | None = None) -> dict:
        if not isinstance(given, dict) or not all(isinstance(key, str) for key in given):
            raise self.fail(where, f"expected names and values, got {given}")
        for key in given:
            if known is not None and key not in known:
                raise self.fail(where, f"expected one of {', '.join(known) or 'none'}, got '{key}'{_hint(key, known)}")
        return given

    def make(self, what: str, given: Any, where: str) -> Any:
        """One object from {kind: arguments}, or from a kind alone."""
        if what == "light" and isinstance(given, str):
            try:
                return scenes.named_light(given)
            except InputError as error:
                raise self.fail(where, str(error).removeprefix("--light: ")) from error
        if what == "layer":
            given = {"layer": given}
        given = {given: {}} if isinstance(given, str) else given
        kinds = KINDS[what]
        if not isinstance(given, dict) or len(given) != 1:
            raise self.fail(where, f"expected one of {', '.join(kinds)} and its arguments, got {given}")
        ((kind, arguments),) = self.mapping(where, given, kinds).items()
        if kind == "layered":
            rows = [
                self.make("layer", row, f"{where}.layers[{k}]")
                for k, row in enumerate(self.sequence("layers", arguments))
            ]
            self.layers += rows
            return materials.layered(len(self.layers) - len(rows), len(self.layers))
        return self.call(kinds[kind], arguments, f"{where}.{kind}")

    def call(self, function: Callable, arguments: Any, where: str) -> Any:
        known = inspect.signature(function).parameters
        if not isinstance(arguments, dict):
            arguments = {next(iter(known), ""): arguments}  # the first argument may stand alone
        given = dict(self.mapping(where, arguments, list(known)))
        for key, value in given.items():
            given[key] = self.argument(key, value, f"{where}.{key}")
        missing = [key for key, p in known.items() if p.default is p.empty and key not in given]
        if missing:
            raise self.fail(where, f"expected {', '.join(missing)} as well")
        try:
            return function(**given)
        except InputError as error:
            raise self.fail(where, str(error)) from error
        except (TypeError, ValueError, IndexError, OverflowError, MemoryError, np.linalg.LinAlgError) as error:
            raise self.fail(where, f"cannot be made of {arguments}: {error}") from error

    def argument(self, key: str, value: Any, where: str) -> Any:
        """A value of an argument: an object inside, the number of a name, or plain numbers."""
        if key == "phase":
            return self.make("phase", value, where)
        if key == "S" and isinstance(value, dict):
            return self.make("flakes", value, where)
        if key in ("material", "medium"):
            names = self.materials if key == "material" else self.media | {"medium": 0, "none": materials.CLEAR}
            if value not in names:
                raise self.fail(
                    where, f"expected one of {', '.join(names) or 'none'}, got '{value}'{_hint(str(value), names)}"
                )
            return names[value]
        if key == "file":
            if not isinstance(value, str):
                raise self.fail(where, f"expected a file name, got {value}")
            return str(self.path.parent / value)
        if key in ("back", "kind", "micro", "up") or (key == "grid" and isinstance(value, str)):
            return value
        if key in ("diffuse", "fibre", "schlick"):
            if not isinstance(value, bool):
                raise self.fail(where, f"expected true or false, got {value}")
            return value
        if not _numbers(value):
            raise self.fail(where, f"expected numbers, got {value}")
        return value


def _numbers(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_numbers, value))
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _hint(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {near[0]}?" if near else ""
