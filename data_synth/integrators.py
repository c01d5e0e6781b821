"""The integrators, small objects with ``render(scene, camera, seed) -> Picture``.

``sums(scene, camera, seed, part)`` renders a part of a picture, and ``picture`` makes a Picture of the sums of all parts.

| name     | solves                                            | class      |
|----------|---------------------------------------------------|------------|
| emission | emission and absorption, no scattering            | Emission   |
| march    | single scattering, shadow rays                    | March      |
| deep     | single scattering, deep shadow maps               | DeepShadow |
| path     | all orders of scattering, Monte Carlo             | Path       |
| preview  | the look of a cloud [Horizon]: an approximation   | Preview    |
| raycast  | a scan through its transfer function              | RayCast    |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from data_synth import channels, compiled, gather, march, parts, path, raycast, shadowmap
from data_synth.cameras import Camera
from data_synth.errors import InputError
from data_synth.image import Picture
from data_synth.media import Medium, glows
from data_synth.parts import Part
from data_synth.prepared import Prepared, banded, prepared, tell_faults
from data_synth.rng import new_rng
from data_synth.world import has_surfaces

if TYPE_CHECKING:
    from data_synth.scene import Scene

UNLIMITED = 2**62
MAP_RESOLUTION = 96  # samples along the longest side of a deep shadow map, unless told otherwise


class Integrator(Protocol):
    """What the table's classes have in common."""

    def render(self, scene: Scene, camera: Camera, seed: int = 0) -> Picture: ...

    def parts(self, height: int, width: int) -> list[Part]:
        """Into what a picture may be cut; a single one where it should stay whole."""
        ...

    def sums(self, scene: Scene, camera: Camera, seed: int, part: Part) -> np.ndarray:
        """(rows, width, channels) float64."""
        ...

    def picture(self, sums: np.ndarray) -> Picture:
        """What (height, width, channels) of ``sums`` make."""
        ...


@dataclass(frozen=True)
class March:
    """Ray-marched single scattering. beams: rays that stand for a sky or area light; side: side^2 rays per pixel."""

    beams: int = 12
    side: int = 1
    mode: int = field(default=march.BY_RAYS, repr=False)

    def __post_init__(self) -> None:
        for name, value, high in (("--beams", self.beams, 100_000), ("--side", self.side, 64)):
            if not 1 <= value <= high:
                raise InputError(f"{name}: expected a whole number from 1 to {high}, got {value}")

    def _prepare(self, scene: Scene) -> Prepared:
        return Prepared(scene.world(self.beams), shadowmap.none(), None)

    def render(self, scene: Scene, camera: Camera, seed: int = 0) -> Picture:
        return self.picture(self.sums(scene, camera, seed, parts.whole(camera.height)))

    def parts(self, height: int, width: int) -> list[Part]:
        """See Integrator; bands of rows."""
        return parts.cut(height, width, self.side**2)

    def sums(self, scene: Scene, camera: Camera, seed: int, part: Part) -> np.ndarray:
        """See Integrator; rgb, alpha, distance."""
        if (scenes := scene.in_channels()) is not None:
            return channels.rendered(scenes, seed, lambda one, own: self.sums(one, camera, own, part))
        world, maps, gathered = prepared(self, scene, lambda: self._prepare(scene))
        eye, mode, rho_J = camera.c2w[:3, 3], self.mode, np.empty(0, np.float32)
        if gathered is not None:
            if not gather.outside(world.medium, eye):
                return replace(self, resolution=MAP_RESOLUTION).sums(scene, camera, seed, part)
            mode, rho_J = march.GATHERED, gather.towards(world, gathered, eye)
        own = (float(self.rain), self.soft) if isinstance(self, Preview) else (1.0, False)
        lighting = march.Lighting(mode, maps, rho_J, *own)
        out, data = np.empty((camera.height, camera.width, 5)), camera.data()

        def rows(first: int, last: int) -> None:
            if mode == march.GATHERED and not has_surfaces(world) and not scene.opaque_sky:
                gather.render_rows(world.medium, rho_J, data, self.side, out, first, last)
            else:
                march.render_rows(world, lighting, data, self.side, scene.opaque_sky, new_rng(0, 0), out, first, last)

        out = banded(rows, out, part, 4)
        tell_faults(world)
        return out

    def picture(self, sums: np.ndarray) -> Picture:
        """See Integrator."""
        return Picture(sums[..., :3], sums[..., 3], sums[..., 4], samples=self.side**2)


@dataclass(frozen=True)
class Emission(March):
    """Emission and absorption alone; of a scan where nothing glows, the colours of its transfer function, as ``RayCast``."""

    mode: int = field(default=march.UNLIT, repr=False)

    def sums(self, scene: Scene, camera: Camera, seed: int, part: Part) -> np.ndarray:
        """See Integrator; rgb, alpha, distance."""
        if scene.classified is not None and not (isinstance(scene.medium, Medium) and glows(scene.medium)):
            return RayCast(side=self.side).sums(scene, camera, seed, part)
        return super().sums(scene, camera, seed, part)


@dataclass(frozen=True)
class RayCast(March):
    """A scan as viewers show it (``raycast.py``): emission and absorption, classified after interpolation, and nothing else.

    integrated: by the pre-integrated table, else at the midpoints of steps. gradient: change of the value from voxel to voxel,
    of its range, at which opacity is full; 0: opacity alone counts. shading: none, lambert or phong, with a lamp at the eye.
    """

    integrated: bool = True
    gradient: float = 0.0
    shading: str = "none"
    mode: int = field(default=march.UNLIT, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        raycast.check(self.gradient, self.shading)

    def sums(self, scene: Scene, camera: Camera, seed: int, part: Part) -> np.ndarray:
        """See Integrator; rgb, alpha, distance."""
        if scene.classified is None:
            raise InputError(f"--integrator raycast: scene {scene.name} has no transfer function")
        key, scan = (self, id(scene.classified)), scene.classified
        if key not in _tables:
            _tables.clear()
            _tables[key] = scan, raycast.table_of(scan, self.integrated, self.gradient, self.shading)
        table, out, data = _tables[key][1], np.empty((camera.height, camera.width, 5)), camera.data()

        def rows(first: int, last: int) -> None:
            raycast.render_rows(scan.values, table, data, self.side, out, first, last)

        return banded(rows, out, part, 4)


_tables: dict[
    tuple[RayCast, int], tuple[raycast.Classified, raycast.Table]
] = {}  # of the last scan, which it keeps alive


@dataclass(frozen=True)
class Preview(March):
    """The Horizon-style cloud preview, 2 e^-(d r) HG powder: an approximation that stands next to the answers of the others.

    rain: r where it pours (the medium's attribute is 1); it is 1 where it is dry. soft: with floors under e^-d and powder.
    """

    rain: float = 2.0
    soft: bool = False
    mode: int = field(default=march.PREVIEW, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.rain < np.inf:
            raise InputError(f"--rain: expected a number from 0 on, got {self.rain}")


@dataclass(frozen=True)
class DeepShadow(March):
    """Single scattering through deep shadow maps.

    resolution: samples along the longest side of a map; None: the samples of the density itself, gathered for each
    view (``gather.py``) where that is possible, else 96. fill: sweep, eager or lazy.
    """

    beams: int = 24
    resolution: int | None = None
    fill: str = "sweep"
    mode: int = field(default=march.MAPPED, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fill not in ("sweep", "eager", "lazy"):
            raise InputError(f"--fill: expected sweep, eager or lazy, got '{self.fill}'")
        if self.resolution is not None and not 2 <= self.resolution <= 1024:
            raise InputError(f"--resolution: expected a whole number from 2 to 1024, got {self.resolution}")

    def parts(self, height: int, width: int) -> list[Part]:
        """See Integrator; whole pictures, for each of which light is gathered."""
        return [parts.whole(height)]

    def _prepare(self, scene: Scene) -> Prepared:
        world = scene.world(self.beams)
        together = self.resolution is None and self.fill == "sweep" and gather.possible(world)
        if together and not has_surfaces(world):
            return Prepared(world, shadowmap.none(), gather.gather(world))
        maps = shadowmap.build(world, MAP_RESOLUTION if self.resolution is None else self.resolution, self.fill)
        return Prepared(world, maps, gather.gather(world) if together else None)


@dataclass(frozen=True)
class Path:
    """Volumetric path tracing: ``spp`` paths per pixel. max_depth: the most scattering events of a path (1 = single).

    Without max_depth there is no limit: Russian roulette ends paths, and all orders of scattering are there.
    jitter: paths start anywhere in the pixel (a box filter) instead of at its centre. textbook: by ``path.py`` in any case,
    also where the core in C++ (``compiled.py``) knows all that is in the scene.
    """

    spp: int = 32
    max_depth: int | None = None
    jitter: bool = True
    textbook: bool = False

    def __post_init__(self) -> None:
        if self.spp < 1:
            raise InputError(f"--spp: expected at least 1 sample, got {self.spp}")
        if self.max_depth is not None and self.max_depth < 0:
            raise InputError(f"--max-depth: expected 0 or more, got {self.max_depth}")

    def render(self, scene: Scene, camera: Camera, seed: int = 0) -> Picture:
        return self.picture(self.sums(scene, camera, seed, parts.whole(camera.height, self.spp)))

    def parts(self, height: int, width: int) -> list[Part]:
        """See Integrator; bands of rows, and blocks of samples."""
        return parts.cut(height, width, self.spp, splits=True)

    def sums(self, scene: Scene, camera: Camera, seed: int, part: Part) -> np.ndarray:
        """See Integrator; over the samples, of rgb, alpha, distance and the squares of rgb."""
        if (scenes := scene.in_channels()) is not None:
            return channels.rendered(scenes, seed, lambda one, own: self.sums(one, camera, own, part))
        world = prepared(self, scene, lambda: Prepared(scene.world(), shadowmap.none(), None)).world
        depth = UNLIMITED if self.max_depth is None else self.max_depth
        settings = path.Settings(self.spp, depth, self.jitter, scene.opaque_sky, seed, part.first, part.last)
        if not self.textbook and compiled.core() is not None and not compiled.unknown(world):
            return compiled.trace(world, camera.data(), settings, (part.bottom - part.top, camera.width), part.top)
        out, data = np.empty((camera.height, camera.width, 8)), camera.data()

        def rows(first: int, last: int) -> None:
            path.render_rows(world, data, settings, new_rng(0, 0), np.empty((64, 8)), out, first, last)

        out = banded(rows, out, part, 2)
        tell_faults(world)
        return out

    def picture(self, sums: np.ndarray) -> Picture:
        """See Integrator; with the variance of the mean."""
        n = self.spp
        mean = sums / n
        variance = np.maximum(sums[..., 5:] - n * mean[..., :3] ** 2, 0.0) / (float(n) * max(n - 1, 1))
        return Picture(mean[..., :3], mean[..., 3], mean[..., 4], variance, n)


INTEGRATORS: dict[str, Callable[..., Integrator]] = {
    "emission": Emission, "march": March, "deep": DeepShadow, "path": Path, "preview": Preview,
    "raycast": RayCast,
}  # fmt: skip


def options(name: str) -> set[str]:
    """What can be chosen of an integrator."""
    return {f.name for f in fields(cast(Any, INTEGRATORS[name])) if f.repr}


def make(name: str, **options: object) -> Integrator:
    """The integrator called ``name``; options None are left at their defaults."""
    if name not in INTEGRATORS:
        raise InputError(f"--integrator: expected one of {', '.join(INTEGRATORS)}, got '{name}'")
    return INTEGRATORS[name](**{key: value for key, value in options.items() if value is not None})
