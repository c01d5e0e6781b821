"""A landscape of clouds over a weather map."""

from __future__ import annotations

import numpy as np

from data_synth import detail as details
from data_synth import lights, media, weather
from data_synth.cameras import Viewpoints
from data_synth.noise import cloud_textures
from data_synth.scene import Scene
from data_synth.scenes.volumes import CLOUD_PHASE

TILE = 1.6  # u of ground that a tile of the base noise covers
RIM = 1.2  # a slope so gentle that detail can carve it, and a contrast that makes a crisp body of what is left
BILLOWS = 3.0  # tiles of detail for one of the base noise
BAKED = 2  # octaves where the voxels hold them
EDGE = 0.1  # of the side, over which clouds of noise thin out, so that the box cuts none
DRY, WET = 0.995, 0.93  # albedo; drops of rain are larger, and absorb more


def cloudscape(
    coverage: float = 0.75, density: float = 60.0, resolution: int = 160, erosion: float = 0.92, contrast: float = 8.0,
    detail: int = 3, rain: float = 1.0, seed: int = 0, map: str | None = None,
) -> Scene:  # fmt: skip
    """heaps of cloud over a landscape, dark where it rains, after a weather map: --set map=weather.png

    erosion: how deeply noise carves the clouds' slow slopes; contrast: how crisp the rim of what it leaves is.
    detail: octaves of noise that erode the cloud where a ray asks for it, finer than any voxel; 0: at the voxels, once.
    map: a picture, red coverage, green type, blue precipitation, instead of one made of noise. rain: scales precipitation.
    """
    lo, hi = np.array([-2.0, -2.0, -0.35]), np.array([2.0, 2.0, 0.45])
    t = cloud_textures(seed)
    over = _thinned(weather.generated(coverage, 1.0, seed, t)) if map is None else weather.read(map)
    shape = np.maximum(np.rint((hi - lo) / (hi - lo).max() * resolution).astype(int), 8)
    tiles = (hi - lo) / TILE
    fine = details.detail(t, BILLOWS * tiles, erosion, detail or BAKED, contrast)
    rho, wet = weather.landscape(over, tuple(shape), tuple(tiles), seed, details.NONE if detail else fine, t, RIM)
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


def _thinned(over: np.ndarray) -> np.ndarray:
    """A weather map without coverage along its edges."""
    x, y = (np.linspace(0, 1, n) for n in over.shape[:2])
    x, y = (np.clip(np.minimum(side, 1 - side) / EDGE, 0, 1) for side in (x, y))
    return over * np.minimum(x[:, None], y)[..., None].astype(np.float32) ** np.array([1, 0, 0], np.float32)
