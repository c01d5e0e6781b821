"""What integrators keep of a scene from view to view, and how they share the rows of a picture between the cores."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from data_synth.functions import say_faults
from data_synth.gather import Gathered
from data_synth.jit import in_bands
from data_synth.parts import Part
from data_synth.shadowmap import ShadowMaps
from data_synth.world import World

if TYPE_CHECKING:
    from data_synth.scene import Scene


class Prepared(NamedTuple):
    """What an integrator makes of a scene, whatever the camera."""

    world: World
    maps: ShadowMaps
    gathered: Gathered | None


def prepared(integrator: object, scene: Scene, make: Callable[[], Prepared]) -> Prepared:
    """What ``make`` returns, kept on the scene for the integrator for as long as nothing in the scene changes."""
    store, key = scene.prepared, (integrator, scene.fingerprint())
    if key not in store:
        while len(store) > 1:
            store.pop(next(iter(store)))
        store[key] = make()
    return store[key]


def banded(rows: Callable[[int, int], None], out: np.ndarray, part: Part, band: int) -> np.ndarray:
    """The part's rows of ``out`` once ``rows`` has filled them, on all cores; of others not even memory is used."""
    in_bands(lambda first, last: rows(part.top + first, part.top + last), part.bottom - part.top, band)
    return out if part.bottom - part.top == len(out) else out[part.top : part.bottom].copy()


def tell_faults(world: World) -> None:
    """Say what was wrong with the density functions that were asked."""
    say_faults(world.medium.faults)
    say_faults(world.others.faults)
