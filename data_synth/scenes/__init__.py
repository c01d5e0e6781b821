"""The scenes of data_synth, by name. A scene is made by calling it: ``scenes.make("showcase", haze=3.0)``."""

from __future__ import annotations

import difflib
import inspect

from data_synth.errors import InputError
from data_synth.scenes.showcase import Showcase

SCENES = {Showcase.name: Showcase}


def make(name: str, **parameters):
    """The scene called ``name``, its defaults overridden by ``parameters``.

    An unknown name is an error that tells the nearest.
    """
    if name not in SCENES:
        near = difflib.get_close_matches(name, SCENES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown scene '{name}', expected one of {', '.join(SCENES)}{hint}")
    factory = SCENES[name]
    known = list(inspect.signature(factory).parameters)
    for key in parameters:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise InputError(f"scene {name} has no parameter '{key}', expected one of {', '.join(known)}{hint}")
    return factory(**parameters)
