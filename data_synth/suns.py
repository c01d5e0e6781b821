"""Sets for relighting: every view under one sun of several, some of which only test views have.

``lights.json`` says what a renderer knows and colours alone do not tell, for all views of the set:

    {"exposure": e, "phase": [{"g": 0.6, "weight": 0.6}, ...],
     "lights": {"sun_0": [{"towards": [x, y, z], "irradiance": [r, g, b]}], ...}}

Colours are linear, exposure scales them on their way to 8 bits, towards points at the light (unit length), the phase function
is the weighted sum of Henyey-Greenstein's. A view names its light: the key "light" of its frame in transforms_*.json.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from data_synth import lights, phase
from data_synth.cameras import Camera
from data_synth.errors import InputError
from data_synth.media import Medium
from data_synth.scene import Scene

HELD = 5
"""Every so many suns one is kept for test views."""
LIGHTS = "lights.json"


class Sun(NamedTuple):
    """A directional light and its name."""

    name: str
    row: np.ndarray


def suns_of(scene: object, n: int) -> list[Sun]:
    """n suns for training and validation and after them n / 4 (at least one) for test views, as bright as all the scene's own
    suns and white, spread over the sphere along Fibonacci's spiral; the held-out ones lie between the others."""
    if not isinstance(scene, Scene) or scene.medium is None:
        raise InputError("--suns: expected a scene with a medium, whose light can be chosen")
    if isinstance(scene.medium, Medium) and scene.medium.columns.g >= 0:
        raise InputError("--suns: expected one phase function for the whole medium, its g is a grid")
    phase_lobes(scene.medium.phase)
    own = [row for row in scene.lights if row[0] == lights.DIRECTIONAL]
    if not own:
        raise InputError(f"--suns: scene {scene.name} has no sun to take the brightness of, expected one")
    irradiance = float(np.mean(np.sum([row[4:7] for row in own], axis=0)))
    held = max(1, n // (HELD - 1))
    total = n + held
    kept = {round((k + 0.5) * total / held) % total for k in range(held)}
    directions = [_on_sphere(k, total) for k in range(total)]
    order = [k for k in range(total) if k not in kept] + sorted(kept)
    names = [f"sun_{k}" for k in range(n)] + [f"held_out_{k}" for k in range(held)]
    return [Sun(name, lights.directional(directions[k], irradiance)) for name, k in zip(names, order, strict=True)]


def _on_sphere(k: int, n: int) -> tuple[float, float, float]:
    z, turn = 1.0 - (2.0 * k + 1.0) / n, 2.399963229728653 * k
    return math.sqrt(1 - z * z) * math.cos(turn), math.sqrt(1 - z * z) * math.sin(turn), z


def shared_out(suns: Sequence[Sun], splits: dict[str, list[Camera]]) -> dict[str, list[Sun | None]]:
    """The sun of each view: training and validation views take turns through the training suns, test views through the rest."""
    if not suns:
        return {split: [None] * len(cameras) for split, cameras in splits.items()}
    groups = {held: [sun for sun in suns if sun.name.startswith("held_out") == held] for held in (False, True)}
    return {
        split: [groups[split == "test"][k % len(groups[split == "test"])] for k in range(len(cameras))]
        for split, cameras in splits.items()
    }


def under(scene: Scene, sun: Sun) -> Scene:
    """The scene lit by that sun alone."""
    return replace(scene, lights=[sun.row])


def document(scene: Scene, suns: Sequence[Sun]) -> dict:
    """What lights.json holds."""
    assert scene.medium is not None
    return {
        "exposure": scene.exposure,
        "phase": phase_lobes(scene.medium.phase),
        "lights": {
            sun.name: [{"towards": sun.row[7:10].tolist(), "irradiance": sun.row[4:7].tolist()}] for sun in suns
        },
    }


def phase_lobes(p: phase.Phase) -> list[dict]:
    """The phase function as Henyey-Greenstein lobes; InputError where it is none."""
    if p.kind == phase.ISOTROPIC:
        return [{"g": 0.0, "weight": 1.0}]
    if p.kind != phase.HG:
        raise InputError("--suns: expected a phase function of Henyey-Greenstein lobes, this medium has another")
    rows = [{"g": p.g1, "weight": p.mix}, {"g": p.g2, "weight": 1.0 - p.mix}]
    return [row for row in rows if row["weight"] > 0]
