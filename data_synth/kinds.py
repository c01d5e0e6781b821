"""What a scene file can hold: every object of data_synth under the name of the function that makes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from data_synth import (
    channels,
    clouds,
    level_sets,
    lights,
    materials,
    media,
    microflakes,
    phase,
    sggx,
    spongecake,
    surfaces,
    volumes,
)
from data_synth.errors import InputError


def volume(
    file: str, size: float = 2.0, centre: media.Point = (0.0, 0.0, 0.0), sigma_t: Any = 1.0, albedo: Any = 0.0,
    Le: Any = 0.0, phase: Any = None, kelvin: float | None = None, heat: float = 1.0,
    up: str = "z",
) -> media.Medium:  # fmt: skip
    """A density volume, its largest sample scaled to 1, its longest side ``size``; sigma_t in 1/u. albedo is multiplied by the
    colours (Cd) that the file holds; kelvin: its temperature or flame glows as in ``volumes.Volume.glow``, instead of Le.
    up: the file's axis that is upright, y (as film programs have it) or z; size and centre are of what is turned."""
    found = volumes.open_volume(file, uses=("colour",) if kelvin is None else ("colour", "heat"))
    found = found.upright() if volumes.is_turned(up) else found
    values, hot = found.density, found.heat
    if values.max() <= 0:
        raise InputError(f"{file}: expected a density that is somewhere positive, got at most {values.max():g}")
    if kelvin is not None and hot is None:
        raise InputError(f"{file}: expected a grid of temperature or flame for kelvin")
    half = 0.5 * size * (np.array(values.shape) - 1) * found.spacing
    half /= ((np.array(values.shape) - 1) * found.spacing).max()
    middle = surfaces.vector(centre, "centre")
    largest = np.float32(values.max())

    def scaled(v: np.ndarray) -> np.ndarray:
        return np.maximum(v, 0) / largest

    density = scaled(values) if isinstance(values, np.ndarray) else values.map(scaled)
    if found.colour is not None:
        tint = np.array(media.rgb(albedo, "albedo", 1.0), np.float32)
        albedo = found.colour.map(lambda v: v * tint)
    Le = Le if kelvin is None else found.glow(kelvin, heat)
    return media.grid(density, middle - half, middle + half, sigma_t, albedo, Le, phase, attribute=hot)


def cloud(
    kind: str = "cumulus", lo: media.Point = (-1.3, -1.3, -0.85), hi: media.Point = (1.3, 1.3, 0.85), resolution: int = 128,
    coverage: float = 0.95, scale: float = 1.0, erosion: float = 0.3, seed: int = 0, sigma_t: Any = 22.0, albedo: Any = 0.995,
    phase: Any = None, detail: int = 0,
) -> media.Medium:  # fmt: skip
    """Clouds out of noise: stratus, cumulus or cumulonimbus. detail: octaves of erosion below the voxel, 0 for none."""
    extent = surfaces.vector(hi, "hi") - surfaces.vector(lo, "lo")
    shape = tuple(max(int(n), 2) for n in resolution * extent / extent.max())
    rho = clouds.cloud(kind, shape, coverage, scale, 0.0 if detail else erosion, seed)
    fine = clouds.detail_of(clouds.cloud_textures(seed), scale, erosion, detail) if detail else None
    return media.grid(rho, lo, hi, sigma_t, albedo, phase=phase, detail=fine)


def flakes_of(
    S: Any, diffuse: bool = False, micro: str | None = None, roughness: float = 0.3, ior: float = 1.5
) -> phase.Phase:
    """Microflakes of one distribution: {fibre: ...} or another kind of flakes."""
    return phase.microflakes(S, diffuse=diffuse, micro=micro, roughness=roughness, ior=ior)


def layered(layers: Any) -> Any:
    """A flat sheet of SpongeCake layers, top first."""
    return layers


KINDS: dict[str, dict[str, Callable]] = {
    "medium": {f.__name__: f for f in (
        media.homogeneous, media.exponential, media.grid, channels.rgb_grid, channels.rgb_coefficients, volume, cloud,
    )},
    "phase": {f.__name__: f for f in (
        phase.isotropic, phase.rayleigh, phase.henyey_greenstein, phase.two_lobes,
    )} | {"microflakes": flakes_of},
    "flakes": {f.__name__: f for f in (
        sggx.fibre, sggx.surface, microflakes.beckmann, microflakes.ggx, microflakes.trigonometric,
    )} | {"matrix": lambda S: sggx.check_sggx(S)},
    "material": {f.__name__: f for f in (
        materials.lambert, materials.blinn_phong, materials.dielectric, materials.null, layered,
    )},
    "shape": {f.__name__: f for f in (
        surfaces.plane, surfaces.sphere, surfaces.box, surfaces.mesh, level_sets.level_set,
    )},
    "light": {f.__name__: f for f in (lights.point, lights.directional, lights.quad, lights.environment, lights.sky)},
    "layer": {"layer": spongecake.layer},
}  # fmt: skip
