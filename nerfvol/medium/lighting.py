"""What is known of the light: suns by name, the phase function, the exposure of the pictures; a JSON document.

    {"exposure": 1.0, "phase": [{"g": 0.6, "weight": 1.0}],
     "lights": {"noon": [{"towards": [0, 0, 1], "irradiance": [9, 9, 8]}], ...}}

Irradiance (RGB, linear) is across the beam, towards is the direction in which the sun is seen. ``exposure`` scales linear
radiance before the sRGB curve. The phase function is a weighted sum of Henyey-Greenstein's [1941], whose g is the mean cosine
between the directions of propagation before and after; none stated: isotropic. A picture names its light; where no name is
given the first one shines.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nerfvol.errors import InputError, shown
from nerfvol.files.atomic import read_json

Triple = tuple[float, float, float]
MOST = 4096
"""Lights of a file, and suns of a light."""


@dataclass(frozen=True)
class Beam:
    """A directional light: unit vector towards it, RGB irradiance across its beam."""

    towards: Triple
    irradiance: Triple


@dataclass(frozen=True)
class Lobe:
    """weight times Henyey and Greenstein's phase function of mean cosine g."""

    g: float
    weight: float


@dataclass(frozen=True)
class Lighting:
    """Lights by name (in the file's order), the phase function's lobes, and the exposure of the pictures."""

    lights: Mapping[str, tuple[Beam, ...]]
    phase: tuple[Lobe, ...] = (Lobe(0.0, 1.0),)
    exposure: float = 1.0

    def of(self, name: str | None) -> tuple[Beam, ...]:
        """The suns of a light; the first light's where no name is given.

        Raises:
            InputError: there is no such light.
        """
        if name is None:
            return next(iter(self.lights.values()))
        if name not in self.lights:
            known = ", ".join(list(self.lights)[:8]) + (", ..." if len(self.lights) > 8 else "")
            raise InputError(f"there is no light {name!r}, expected one of {known}")
        return self.lights[name]

    def document(self) -> dict[str, Any]:
        """As JSON holds it."""
        lights = {
            name: [{"towards": list(beam.towards), "irradiance": list(beam.irradiance)} for beam in beams]
            for name, beams in self.lights.items()
        }
        phase = [{"g": lobe.g, "weight": lobe.weight} for lobe in self.phase]
        return {"exposure": self.exposure, "phase": phase, "lights": lights}


def load_lighting(path: str | os.PathLike[str]) -> Lighting:
    """The lighting in a JSON file; InputError, one sentence that names the file, where it is none."""
    return parse_lighting(read_json(path), str(path))


def parse_lighting(document: Any, where: str) -> Lighting:
    """The lighting of a document; InputError, a sentence that begins with ``where``, where it is none."""
    if not isinstance(document, dict):
        raise InputError(f"{where}: expected an object with lights, got {shown(document):.60}")
    if unknown := [key for key in document if key not in ("exposure", "phase", "lights")]:
        raise InputError(f"{where}: expected lights, phase and exposure, got {shown(unknown[0])}")
    given = document.get("lights")
    if not isinstance(given, dict) or not 1 <= len(given) <= MOST:
        raise InputError(f"{where}: expected lights to hold at least one light by its name, got {shown(given):.60}")
    lights = {name: _beams(beams, f"{where}: light {name!r}") for name, beams in given.items()}
    exposure = document.get("exposure", 1.0)
    if not _is_number(exposure, 1e-12, 1e12):
        raise InputError(f"{where}: expected a positive exposure, got {shown(exposure):.60}")
    return Lighting(lights, _lobes(document.get("phase", [{"g": 0.0, "weight": 1.0}]), where), float(exposure))


def _beams(given: Any, where: str) -> tuple[Beam, ...]:
    if not isinstance(given, list) or not 1 <= len(given) <= MOST:
        raise InputError(f"{where}: expected a list of suns, got {shown(given):.60}")
    beams = []
    for sun in given:
        if not isinstance(sun, dict) or sun.keys() != {"towards", "irradiance"}:
            raise InputError(f"{where}: expected a sun's towards and irradiance, got {shown(sun):.60}")
        x, y, z = _triple(sun["towards"], -1e12, f"{where}: towards")
        length = math.sqrt(x * x + y * y + z * z)
        if length < 1e-12:
            raise InputError(f"{where}: expected a direction towards the sun, got {shown(sun['towards'])}")
        irradiance = _triple(sun["irradiance"], 0.0, f"{where}: irradiance")
        beams.append(Beam((x / length, y / length, z / length), irradiance))
    return tuple(beams)


def _lobes(given: Any, where: str) -> tuple[Lobe, ...]:
    fits = isinstance(given, list) and 1 <= len(given) <= 8
    for lobe in given if fits else ():
        fits = fits and isinstance(lobe, dict) and lobe.keys() == {"g", "weight"}
        fits = fits and _is_number(lobe["g"], -0.999, 0.999) and _is_number(lobe["weight"], 0.0, 1.0)
    if not fits:
        raise InputError(
            f"{where}: expected phase to list lobes with g within -0.999 and 0.999 and a weight, got {shown(given):.80}"
        )
    total = sum(lobe["weight"] for lobe in given)
    if abs(total - 1) > 1e-6:
        raise InputError(f"{where}: expected the weights of the phase function's lobes to sum to 1, got {total:g}")
    return tuple(Lobe(float(lobe["g"]), float(lobe["weight"])) for lobe in given)


def _triple(value: Any, low: float, where: str) -> Triple:
    if not isinstance(value, list) or len(value) != 3 or not all(_is_number(x, low, 1e12) for x in value):
        raise InputError(f"{where}: expected three numbers{' from 0 on' if low == 0 else ''}, got {shown(value):.60}")
    return float(value[0]), float(value[1]), float(value[2])


def _is_number(value: Any, low: float, high: float) -> bool:
    return type(value) in (int, float) and low <= value <= high
