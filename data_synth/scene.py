"""A scene: media, surfaces, materials and lights."""

from __future__ import annotations

import hashlib
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from data_synth import lights as lamps
from data_synth import materials as stuff
from data_synth import media, spongecake, surfaces, truth, volumes
from data_synth.cameras import Camera, Viewpoints
from data_synth.channels import Channels, split
from data_synth.errors import InputError, RenderWarning
from data_synth.image import Picture
from data_synth.integrators import Integrator, make
from data_synth.pool import pool
from data_synth.prepared import Prepared
from data_synth.raycast import Classified
from data_synth.world import COUNTERS, World

NOTHING = media.homogeneous((0.0,) * 3, (1.0,) * 3, sigma_t=0.0)._replace(brick_max=np.zeros(1), max_density=0.0)


@dataclass
class Scene:
    """What can be rendered.

    medium: a ``media`` medium or None, number 0; media: further ones, numbers 1, 2, ... shapes, triangles: rows of
    ``surfaces`` whose material numbers index ``materials``; level_sets: solids made by ``level_sets``; layers: rows of
    ``spongecake.layer``. lights: rows of ``lights``. bounded: whether the medium fills the closed shapes with a ``null`` or
    ``dielectric`` material and nothing else; if not it fills its whole box, except for what is inside glass. A boundary
    material that names a medium itself holds that one in both cases. opaque_sky: the picture shows the sky instead of being
    transparent there. integrators: by name, the first is the scene's own choice. exposure scales the colours of 8-bit pictures.
    classified: the scan that the medium was made of, for ``raycast``.

    All of it may be changed between two renders; what integrators keep is made again then.
    """

    name: str = "scene"
    medium: media.Medium | Channels | None = None
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
    media: list = field(default_factory=list)
    level_sets: list = field(default_factory=list)
    classified: Classified | None = None
    prepared: dict[object, Prepared] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What integrators keep for the next view: arrays and shadow maps, which do not depend on the camera."""
    split: tuple[bytes, list[Scene] | None] | None = field(default=None, init=False, repr=False, compare=False)

    def in_channels(self) -> list[Scene] | None:
        """The scenes of red, green and blue where a medium has coefficients of its own for each (``channels.py``), or None."""
        key = self.fingerprint()
        if self.split is None or self.split[0] != key:
            self.split = key, split(self)
        return self.split[1]

    def world(self, beams: int = 0) -> World:
        """The arrays for kernels; not of a scene :meth:`in_channels`. beams > 0 replaces sky and quad lights by that many beams
        each."""
        if isinstance(self.medium, Channels) or any(isinstance(m, Channels) for m in self.media):
            raise TypeError("a scene in channels has three worlds")
        rows = lamps.discretise(self.lights, beams) if beams else list(self.lights)
        glows = any(media.glows(m) for m in (self.medium, *self.media) if isinstance(m, media.Medium))
        if not rows and not glows:
            warnings.warn(f"scene {self.name} has no lights: the picture is black", RenderWarning, stacklevel=3)
        shapes = surfaces.geometry(self.shapes, self.triangles, self.level_sets)
        own = _table(self.lights, lamps.WIDTH)
        return World(
            self.medium if self.medium is not None else NOTHING,
            pool(self.media),
            shapes,
            stuff.Materials(self.boundaries(), spongecake.stack(self.layers)),
            _table(rows, lamps.WIDTH),
            own[own[:, 0] == lamps.QUAD],
            own[own[:, 0] == lamps.SKY],
            stuff.CLEAR if self.bounded or self.medium is None else 0,
        )

    def boundaries(self) -> np.ndarray:
        """The material table, with the media and counters of those boundaries that are used."""
        numbers = [int(row[1]) for row in self.shapes] + [s.material for s in self.level_sets]
        numbers += [] if self.triangles is None else [int(k) for k in np.unique(self.triangles[:, 0])]
        used, rows = set(numbers), _table(self.materials, 16)
        if used and max(used) >= len(rows):
            raise InputError(f"scene {self.name}: material {max(used)} is used, {len(rows)} are defined")
        counters = 0
        for k in sorted(used):
            kind, medium = rows[k, 0], rows[k, 13]
            if kind not in (stuff.DIELECTRIC, stuff.NULL):
                continue
            if medium == stuff.UNSAID:
                if not self.bounded and kind == stuff.NULL:
                    continue  # it tells nothing
                rows[k, 13] = 0 if self.bounded and self.medium is not None else stuff.CLEAR
            elif medium > len(self.media) or (medium == 0 and self.medium is None):
                raise InputError(f"scene {self.name}: material {k} holds medium {medium:.0f}, which is not defined")
            if counters == COUNTERS:
                raise InputError(f"scene {self.name}: expected at most {COUNTERS} boundary materials, got more")
            rows[k, 15], counters = counters, counters + 1
        return rows

    def fingerprint(self) -> bytes:
        """A digest of all that a picture depends on but the camera: it tells whether the scene was changed."""
        digest = hashlib.blake2b(repr((self.bounded, self.opaque_sky)).encode())
        parts: list = [self.shapes, self.materials, self.layers, self.lights, self.triangles, self.medium, *self.media]
        parts += self.level_sets
        while parts:
            part = parts.pop()
            if isinstance(part, media.Medium):
                part = part._replace(faults=())  # what rendering counts does not change the scene
            if isinstance(part, np.ndarray) and part.dtype != object:
                digest.update(repr((part.shape, part.dtype.str)).encode())
                digest.update(zlib.crc32(np.ascontiguousarray(part).data).to_bytes(4, "little"))
            elif isinstance(part, (tuple, list)):
                digest.update(f"{len(part)} parts".encode())
                parts += part
            else:
                digest.update(repr(part).encode())
        return digest.digest()

    def render(self, camera: Camera, integrator: Integrator | None = None, seed: int = 0) -> Picture:
        """One view, by default with the scene's own choice of integrator."""
        return (integrator or make(self.integrators[0])).render(self, camera, seed=seed)

    def write_truth(self, out_dir: Path) -> None:
        """truth.npz, all that the scene is made of; of a grid medium also density.npz and density.vdb, its extinction."""
        truth.write(self, out_dir / "truth.npz")
        green = self.medium.green if isinstance(self.medium, Channels) else self.medium
        if green is not None and green.kind == media.GRID:
            volumes.write_density(green, out_dir)


def _table(rows: Sequence[ArrayLike], width: int) -> np.ndarray:
    return np.array(rows, dtype=float).reshape(-1, width)
