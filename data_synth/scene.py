"""A scene: one medium, surfaces, materials and lights."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from data_synth import lights as lamps
from data_synth import materials as stuff
from data_synth import media, surfaces, volumes
from data_synth.cameras import Camera, Viewpoints
from data_synth.errors import InputError, RenderWarning
from data_synth.image import Picture
from data_synth.integrators import Integrator, Prepared, make
from data_synth.world import World

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
    prepared: dict[object, Prepared] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What integrators keep for the next view: arrays and shadow maps, which do not depend on the camera."""

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

    def render(self, camera: Camera, integrator: Integrator | None = None, seed: int = 0) -> Picture:
        """One view, by default with the scene's own choice of integrator."""
        return (integrator or make(self.integrators[0])).render(self, camera, seed=seed)

    def write_truth(self, out_dir: Path) -> None:
        """density.npz and density.vdb: the true extinction of a grid medium."""
        if self.medium is not None and self.medium.kind == media.GRID:
            volumes.write_density(self.medium, out_dir)


def _table(rows: Sequence[ArrayLike], width: int) -> np.ndarray:
    return np.array(rows, dtype=float).reshape(-1, width)
