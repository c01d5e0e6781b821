"""The integrators, small objects with ``render(scene, camera, seed) -> Picture``.

| name     | solves                                            | class      |
|----------|---------------------------------------------------|------------|
| emission | emission and absorption, no scattering            | Emission   |
| march    | single scattering, shadow rays                    | March      |
| deep     | single scattering, deep shadow maps               | DeepShadow |
| path     | all orders of scattering, Monte Carlo             | Path       |
| preview  | the look of a cloud [Horizon]: an approximation   | Preview    |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast

import numpy as np

from data_synth import compiled, gather, march, path, shadowmap
from data_synth.cameras import Camera
from data_synth.errors import InputError
from data_synth.gather import Gathered
from data_synth.image import Picture
from data_synth.jit import in_bands
from data_synth.rng import new_rng
from data_synth.shadowmap import ShadowMaps
from data_synth.world import World, has_surfaces

if TYPE_CHECKING:
    from data_synth.scene import Scene

UNLIMITED = 2**62
MAP_RESOLUTION = 96  # samples along the longest side of a deep shadow map, unless told otherwise


class Integrator(Protocol):
    """What the table's classes have in common."""

    def render(self, scene: Scene, camera: Camera, seed: int = 0) -> Picture: ...


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

    def _light(self, scene: Scene, world: World) -> tuple[ShadowMaps, Gathered | None]:
        return shadowmap.none(), None

    def render(self, scene: Scene, camera: Camera, seed: int = 0) -> Picture:
        world, maps, gathered = _prepared(self, scene)
        eye, mode, rho_J = camera.c2w[:3, 3], self.mode, np.empty(0, np.float32)
        if gathered is not None:
            if not gather.outside(world.medium, eye):
                return replace(self, resolution=MAP_RESOLUTION).render(scene, camera, seed)
            mode, rho_J = march.GATHERED, gather.towards(world, gathered, eye)
        lighting = march.Lighting(mode, maps, rho_J)
        out, data = np.empty((camera.height, camera.width, 5)), camera.data()

        def rows(first: int, last: int) -> None:
            if mode == march.GATHERED and not has_surfaces(world) and not scene.opaque_sky:
                gather.render_rows(world.medium, rho_J, data, self.side, out, first, last)
            else:
                march.render_rows(world, lighting, data, self.side, scene.opaque_sky, new_rng(0, 0), out, first, last)

        in_bands(rows, camera.height, 4)
        return Picture(out[..., :3], out[..., 3], out[..., 4], samples=self.side**2)


@dataclass(frozen=True)
class Emission(March):
    """Emission and absorption alone."""

    mode: int = field(default=march.UNLIT, repr=False)


@dataclass(frozen=True)
class Preview(March):
    """The Horizon-style cloud preview: an approximation that stands next to the answers of the others."""

    mode: int = field(default=march.PREVIEW, repr=False)


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

    def _light(self, scene: Scene, world: World) -> tuple[ShadowMaps, Gathered | None]:
        together = self.resolution is None and self.fill == "sweep" and gather.possible(world)
        if together and not has_surfaces(world):
            return shadowmap.none(), gather.gather(world)
        maps = shadowmap.build(world, MAP_RESOLUTION if self.resolution is None else self.resolution, self.fill)
        return maps, gather.gather(world) if together else None


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
        world = _prepared(self, scene).world
        out, data = np.empty((camera.height, camera.width, 8)), camera.data()
        depth = UNLIMITED if self.max_depth is None else self.max_depth
        settings = path.Settings(self.spp, depth, self.jitter, scene.opaque_sky, seed)
        if not self.textbook and compiled.core() is not None and not compiled.unknown(world):
            compiled.trace(world, data, settings, out)
            return Picture(out[..., :3], out[..., 3], out[..., 4], out[..., 5:8], self.spp)

        def rows(first: int, last: int) -> None:
            path.render_rows(world, data, settings, new_rng(0, 0), out, first, last)

        in_bands(rows, camera.height, 2)
        return Picture(out[..., :3], out[..., 3], out[..., 4], out[..., 5:8], self.spp)


INTEGRATORS: dict[str, Callable[..., Integrator]] = {
    "emission": Emission, "march": March, "deep": DeepShadow, "path": Path, "preview": Preview,
}  # fmt: skip


def options(name: str) -> set[str]:
    """What can be chosen of an integrator."""
    return {f.name for f in fields(cast(Any, INTEGRATORS[name])) if f.repr}


def make(name: str, **options: object) -> Integrator:
    """The integrator called ``name``; options None are left at their defaults."""
    if name not in INTEGRATORS:
        raise InputError(f"--integrator: expected one of {', '.join(INTEGRATORS)}, got '{name}'")
    return INTEGRATORS[name](**{key: value for key, value in options.items() if value is not None})


class Prepared(NamedTuple):
    """What an integrator makes of a scene, whatever the camera."""

    world: World
    maps: ShadowMaps
    gathered: Gathered | None


def _prepared(integrator: March | Path, scene: Scene) -> Prepared:
    """Arrays and shadow maps of a scene for an integrator, kept on the scene for as long as nothing in it changes."""
    store, key = scene.prepared, (integrator, scene.fingerprint())
    if key not in store:
        while len(store) > 1:
            store.pop(next(iter(store)))
        if isinstance(integrator, Path):
            store[key] = Prepared(scene.world(), shadowmap.none(), None)
        else:
            world = scene.world(integrator.beams)
            store[key] = Prepared(world, *integrator._light(scene, world))
    return store[key]
