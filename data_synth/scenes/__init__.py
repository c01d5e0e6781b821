"""The scenes of data_synth, by name. A scene is made by calling its function: ``scenes.cloud(coverage=0.8)``."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from data_synth import checks, lights
from data_synth.errors import InputError
from data_synth.scene import Scene
from data_synth.scenes.flakes import cloth, leaf
from data_synth.scenes.landscape import cloudscape
from data_synth.scenes.showcase import Showcase
from data_synth.scenes.simple import fog, mist, slab, solids, sphere
from data_synth.scenes.volumes import cloud, cumulonimbus, explosion, phantom, smoke, stratus

SCENES: Mapping[str, Callable[..., Showcase | Scene]] = {"showcase": Showcase} | {
    scene.__name__: scene
    for scene in (
        cloud, cumulonimbus, stratus, cloudscape, smoke, explosion, fog, mist, solids, phantom, cloth, leaf, slab, sphere,
    )
}  # fmt: skip

LIGHTS = {
    "sun": lights.directional((0.6, -0.5, 1.0), (8.0, 7.5, 6.6)),
    "sunset": lights.directional((1.0, -0.45, 0.25), (13.0, 7.0, 3.4)),
    "moon": lights.directional((-0.4, 0.5, 0.8), (0.7, 0.85, 1.2)),
    "sky": lights.sky((0.35, 0.55, 1.0), 0.75, 0.25),
    "white": lights.environment(1.0),
    "lamp": lights.point((1.6, -1.6, 2.0), (18.0, 15.0, 11.0)),
    "panel": lights.quad((-0.6, -0.6, 2.4), (0.0, 1.2, 0.0), (1.2, 0.0, 0.0), 14.0, back="clear"),
}


def summary(name: str) -> str:
    """One line about a scene."""
    factory = SCENES[name]
    return getattr(factory, "summary", None) or (inspect.getdoc(factory) or name).splitlines()[0]


def make(name: str, light: str | None = None, **parameters: Any) -> Showcase | Scene:
    """The scene called ``name``, its defaults overridden by ``parameters``.

    light: names of LIGHTS, separated by commas, that replace the scene's own. An unknown name is an error that tells
    the nearest.
    """
    if name not in SCENES:
        raise InputError(f"unknown scene '{name}', expected one of {', '.join(SCENES)}{_hint(name, SCENES)}")
    defaults = parameters_of(name)
    for key in parameters:
        if key not in defaults:
            raise InputError(
                f"scene {name} has no parameter '{key}', expected one of {', '.join(defaults) or 'none'}{_hint(key, defaults)}"
            )
    given = {key: checks.parameter(name, key, value, defaults[key]) for key, value in parameters.items()}
    scene = SCENES[name](**given)
    scene.name, scene.parameters = name, dict(given)
    if light is not None:
        if not isinstance(scene, Scene):
            raise InputError("--light: the showcase keeps its own lights, expected no other")
        scene.lights = [named_light(each) for each in light.split(",")]
        scene.parameters["light"] = light
    return scene


def named_light(name: str) -> np.ndarray:
    """A row of LIGHTS."""
    if name not in LIGHTS:
        raise InputError(f"--light: expected one of {', '.join(LIGHTS)}, got '{name}'{_hint(name, LIGHTS)}")
    return LIGHTS[name]


def parameters_of(name: str) -> dict[str, Any]:
    """The parameters of a scene and their defaults."""
    return {key: p.default for key, p in inspect.signature(SCENES[name]).parameters.items()}


def _hint(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""
