"""The scenes of data_synth, by name. A scene is made by calling its function: ``scenes.cloud(coverage=0.8)``."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from data_synth import lights
from data_synth.errors import InputError
from data_synth.scene import Scene
from data_synth.scenes.showcase import Showcase
from data_synth.scenes.simple import cloth, fog, leaf, mist, slab, solids, sphere
from data_synth.scenes.volumes import cloud, cumulonimbus, explosion, phantom, smoke, stratus

SCENES: Mapping[str, Callable[..., Showcase | Scene]] = {"showcase": Showcase} | {
    scene.__name__: scene
    for scene in (
        cloud, cumulonimbus, stratus, smoke, explosion, fog, mist, solids, phantom, cloth, leaf, slab, sphere,
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
    factory = SCENES[name]
    known = list(inspect.signature(factory).parameters)
    for key in parameters:
        if key not in known:
            raise InputError(
                f"scene {name} has no parameter '{key}', expected one of {', '.join(known)}{_hint(key, known)}"
            )
    try:
        scene = factory(**parameters)
    except TypeError as error:
        raise InputError(f"scene {name}: a parameter has the wrong type: {error}") from error
    scene.name, scene.parameters = name, dict(parameters)
    if light is not None:
        names = light.split(",")
        for each in names:
            if each not in LIGHTS or isinstance(scene, Showcase):
                what = "the showcase keeps its own" if name == "showcase" else f"one of {', '.join(LIGHTS)}"
                raise InputError(f"--light: expected {what}, got '{each}'{_hint(each, LIGHTS)}")
        if isinstance(scene, Scene):
            scene.lights = [LIGHTS[each] for each in names]
        scene.parameters["light"] = light
    return scene


def _hint(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""
