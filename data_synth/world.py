"""What kernels see of a scene, and how they walk through its surfaces and its medium."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.jit import jit
from data_synth.lights import hit_quad
from data_synth.materials import DIELECTRIC, NULL, Materials
from data_synth.media import Medium
from data_synth.surfaces import Geometry, intersect
from data_synth.transmittance import shadow_transmittance
from data_synth.vec import along, dot, mul


class World(NamedTuple):
    """The scene as kernels see it. bounded: the medium fills closed boundary surfaces, not its whole box."""

    medium: Medium
    geometry: Geometry
    materials: Materials
    lights: np.ndarray
    bounded: bool


def has_surfaces(w: World) -> bool:
    """Whether anything but the medium and the sky can be seen."""
    return len(w.geometry.shapes) + len(w.geometry.triangles) > 0


@jit
def inside_medium(w, ray):
    """Whether a ray starts inside a closed boundary: the first boundary it meets is one it leaves."""
    if not w.bounded:
        return True
    t = 0.0
    for _ in range(64):
        start = (along(ray, t), ray[1])
        step, n, material = intersect(w.geometry, start, math.inf)
        if material < 0:
            return False
        if w.materials.rows[material, 0] >= DIELECTRIC:
            return dot(ray[1], n) > 0.0
        t += step
    return False


@jit
def visible(w, ray, t_max, inside, random, rng):
    """RGB transmittance from the ray's origin over t_max: 0 behind surfaces, attenuated by the medium.

    random: by ratio tracking, unbiased; else by marching. Media with a closed form use it in both cases.
    """
    total = (1.0, 1.0, 1.0)
    for _ in range(64):
        t, n, material = intersect(w.geometry, ray, t_max)
        if material >= 0 and w.materials.rows[material, 0] != NULL:
            return (0.0, 0.0, 0.0)
        if inside:
            total = mul(total, shadow_transmittance(w.medium, ray, t, random, rng))
        if material < 0:
            return total
        ray = (along(ray, t), ray[1])
        t_max -= t
        inside = dot(ray[1], n) < 0.0 if w.bounded else inside
    return total


@jit
def blocked(w, ray, t_max):
    """Whether a surface other than null boundaries stands within t_max."""
    for _ in range(64):
        t, n, material = intersect(w.geometry, ray, t_max)
        if material < 0:
            return False
        if w.materials.rows[material, 0] != NULL:
            return True
        ray = (along(ray, t), ray[1])
        t_max -= t
    return False


@jit
def next_surface(w, ray):
    """(t, n, material, quad): the nearest surface; or quad >= 0, a quad light that stands before it."""
    t, n, material = intersect(w.geometry, ray, math.inf)
    t, quad = hit_quad(w.lights, ray, t)
    if quad >= 0:
        material = -1
    return t, n, material, quad
