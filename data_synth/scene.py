"""A scene: one medium, surfaces, materials and lights, and how kernels walk through it."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_synth import lights as lamps
from data_synth import materials as stuff
from data_synth import media, surfaces
from data_synth.cameras import Camera, Viewpoints
from data_synth.errors import InputError, RenderWarning
from data_synth.image import Picture
from data_synth.jit import jit
from data_synth.lights import hit_quad
from data_synth.materials import DIELECTRIC, NULL
from data_synth.surfaces import intersect
from data_synth.transmittance import shadow_transmittance
from data_synth.vec import along, dot, mul


class World(NamedTuple):
    """The scene as kernels see it. bounded: the medium fills closed boundary surfaces, not its whole box."""

    medium: media.Medium
    geometry: surfaces.Geometry
    materials: stuff.Materials
    lights: np.ndarray
    bounded: bool


def has_surfaces(w: World) -> bool:
    """Whether anything but the medium and the sky can be seen."""
    return len(w.geometry.shapes) + len(w.geometry.triangles) > 0


NOTHING = media.homogeneous((-1e-3,) * 3, (1e-3,) * 3, sigma_t=0.0)


@dataclass
class Scene:
    """What can be rendered.

    medium: a ``media`` medium or None. shapes, triangles: rows of ``surfaces`` whose material numbers index
    ``materials``; layers: rows of ``spongecake.layer``. lights: rows of ``lights``.
    If a shape's material is ``null`` or ``dielectric`` and ``bounded`` is True, the medium fills those closed shapes
    and nothing else. opaque_sky: the picture shows the sky instead of being transparent there. integrators: by name,
    the first is the scene's own choice. exposure scales the colours of 8-bit pictures.
    """

    name: str = "scene"
    medium: media.Medium | None = None
    shapes: list = field(default_factory=list)
    triangles: np.ndarray | None = None
    materials: list = field(default_factory=list)
    layers: list = field(default_factory=list)
    lights: list = field(default_factory=list)
    bounded: bool = False
    opaque_sky: bool = False
    viewpoints: Viewpoints = field(default_factory=Viewpoints)
    aabb: np.ndarray = field(default_factory=lambda: np.array([[-1.0] * 3, [1.0] * 3]))
    integrators: tuple[str, ...] = ("deep", "march", "path")
    exposure: float = 1.0
    parameters: dict = field(default_factory=dict)

    def world(self, beams: int = 0) -> World:
        """The arrays for kernels. beams > 0 replaces sky and quad lights by that many beams each."""
        rows = lamps.discretise(self.lights, beams) if beams else list(self.lights)
        if not rows and (self.medium is None or not np.any(self.medium.Le)):
            warnings.warn(f"scene {self.name} has no lights: the picture is black", RenderWarning, stacklevel=3)
        shapes = surfaces.geometry(self.shapes, self.triangles)
        used = [int(k) for k in [*shapes.shapes[:, 1], *shapes.triangles[:, 0]]]
        if used and max(used) >= len(self.materials):
            raise InputError(f"scene {self.name}: material {max(used)} is used, {len(self.materials)} are defined")
        return World(
            self.medium if self.medium is not None else NOTHING,
            shapes,
            stuff.Materials(_table(self.materials, 16), _table(self.layers, 10)),
            _table(rows, lamps.WIDTH),
            self.bounded,
        )

    def render(self, camera: Camera, integrator=None, seed: int = 0) -> Picture:
        """One view, by default with the scene's own choice of integrator."""
        from data_synth.integrators import make

        return (integrator or make(self.integrators[0])).render(self, camera, seed=seed)

    def write_truth(self, out_dir: Path) -> None:
        """density.npz and density.vdb: the true extinction of a grid medium."""
        from data_synth.volumes import write_density

        if self.medium is not None and self.medium.kind == media.GRID:
            write_density(self.medium, out_dir)


def _table(rows, width: int) -> np.ndarray:
    return np.array(rows, dtype=float).reshape(-1, width)


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
