"""A landscape of clouds over a weather map."""

from __future__ import annotations

import numpy as np

from data_synth import clouds, lights, media, weather
from data_synth import detail as details
from data_synth.cameras import Viewpoints
from data_synth.noise import cloud_textures
from data_synth.scene import Scene
from data_synth.scenes.volumes import CLOUD_PHASE

TILE = 1.6  # u of ground that a tile of the base noise covers
DRY, WET = 0.995, 0.93  # albedo; drops of rain are larger, and absorb more


def cloudscape(
    coverage: float = 0.45, density: float = 50.0, resolution: int = 160, erosion: float = 0.75, detail: int = 3,
    rain: float = 1.0, seed: int = 0, map: str | None = None,
) -> Scene:  # fmt: skip
    """heaps of cloud over a landscape, dark where it rains, after a weather map: --set map=weather.png

    detail: octaves of noise that erode the cloud where a ray asks for it, finer than any voxel; 0: at the voxels, once.
    map: a picture, red coverage, green type, blue precipitation, instead of one made of noise. rain: scales precipitation.
    """
    lo, hi = np.array([-2.0, -2.0, -0.35]), np.array([2.0, 2.0, 0.45])
    t = cloud_textures(seed)
    over = weather.generated(coverage, 1.0, seed, t) if map is None else weather.read(map)
    shape = np.maximum(np.rint((hi - lo) / (hi - lo).max() * resolution).astype(int), 8)
    tiles = (hi - lo) / TILE
    fine = details.detail(t, clouds.DETAIL_TILES * tiles, erosion, max(detail, 1))
    rho, wet = weather.landscape(over, tuple(shape), tuple(tiles), seed, details.NONE if detail else fine, t)
    medium = media.grid(
        rho, lo, hi, density, [(DRY,) * 3, (WET,) * 3], phase=CLOUD_PHASE, attribute=rain * wet,
        detail=fine if detail else None,
    )  # fmt: skip
    return Scene(
        medium=medium,
        lights=[
            lights.directional((0.9, -0.45, 0.55), (30.0, 26.5, 21.0)),
            lights.sky((0.7, 1.05, 1.9), (1.3, 1.35, 1.5), 0.4),
        ],
        viewpoints=Viewpoints(radius=5.0, elevation=(10, 60), fov=40),
        integrators=("deep", "march", "path", "preview"),
        aabb=np.array([lo, hi]),
        exposure=0.62,
    )
