"""Scenes of volumes: clouds, smoke, fire and a CT-like phantom. Most take any imported volume instead."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from data_synth import blackbody, clouds, lights, materials, media, phase, raycast, surfaces
from data_synth import transfer as transfers
from data_synth.bricks import Sparse
from data_synth.cameras import Viewpoints
from data_synth.errors import InputError, RenderWarning
from data_synth.jit import in_bands
from data_synth.noise import cloud_textures
from data_synth.scene import Scene
from data_synth.scenes.procedural import fill_fireball, fill_plume
from data_synth.volumes import Volume, open_volume, read_volume

CLOUD_PHASE = phase.two_lobes(0.6, -0.25, 0.6)
EVENING_SUN = lights.directional((1.0, 0.35, 0.42), (34.0, 19.0, 9.5))
EVENING_SKY = lights.sky((0.75, 1.1, 1.9), (1.3, 1.2, 1.2), (0.5, 0.45, 0.5))


def cloud(
    coverage: float = 0.95, density: float = 22.0, resolution: int = 128, erosion: float = 0.3, seed: int = 0,
    volume: str | None = None, detail: int = 0,
) -> Scene:  # fmt: skip
    """a cumulus at sunset: warm sun from the side, blue sky above

    detail: octaves of noise that erode the cloud (or volume) where a ray asks for it, finer than any voxel; 0: at the voxels.
    """
    lo, hi = (-1.3, -1.3, -0.85), (1.3, 1.3, 0.85)
    shape = (resolution, resolution, int(resolution * 1.7 / 2.6))
    if volume is None:
        rho = clouds.cloud("cumulus", shape, coverage, 1.0, 0.0 if detail else erosion, seed)
    else:
        rho, lo, hi = _scaled(volume, open_volume(volume, uses=()), lo, hi)
    fine = clouds.detail_of(cloud_textures(seed), 1.0, erosion, detail) if detail else None
    medium = media.grid(rho, lo, hi, density, 0.995, phase=CLOUD_PHASE, detail=fine)
    return Scene(
        medium=medium,
        lights=[EVENING_SUN, EVENING_SKY],
        viewpoints=Viewpoints(radius=4.6, elevation=(-5, 60), fov=40),
        integrators=("deep", "march", "path", "preview"),
        aabb=np.array([lo, hi]),
        exposure=0.62,
    )


def cumulus(*lit: np.ndarray, resolution: int = 128) -> Scene:
    """The cloud of the benchmarks: a cube of samples, 22/u, albedo 0.99, Henyey-Greenstein g = 0.7."""
    lo, hi = (-1.3, -1.3, -0.85), (1.3, 1.3, 0.85)
    rho = clouds.cloud("cumulus", (resolution,) * 3, 0.95, 1.0, 0.3, 0)
    medium = media.grid(rho, lo, hi, 22.0, 0.99, phase=phase.henyey_greenstein(0.7))
    return Scene("cumulus", medium, lights=list(lit), viewpoints=Viewpoints(radius=4.6), exposure=0.62)


def cumulonimbus(coverage: float = 0.92, density: float = 30.0, resolution: int = 128, seed: int = 3) -> Scene:
    """a thunderhead with its anvil under a high sun"""
    rho = clouds.cloud("cumulonimbus", (resolution,) * 3, coverage, 1.2, 0.25, seed)
    medium = media.grid(rho, (-1.2,) * 3, (1.2,) * 3, density, 0.995, phase=CLOUD_PHASE)
    return Scene(
        medium=medium,
        lights=[
            lights.directional((0.8, -0.6, 0.9), (26.0, 24.0, 21.0)),
            lights.sky((0.8, 1.15, 1.9), (1.3, 1.35, 1.5), 0.5),
        ],
        viewpoints=Viewpoints(radius=4.8, elevation=(-10, 50), fov=40),
        integrators=("deep", "march", "path", "preview"),
        aabb=np.array([[-1.2] * 3, [1.2] * 3]),
        exposure=0.62,
    )


def stratus(
    coverage: float = 0.60, density: float = 18.0, resolution: int = 160, seed: int = 1, scale: float = 1.6,
    erosion: float = 0.35,
) -> Scene:  # fmt: skip
    """a broken layer of stratus, seen from above and below

    scale: how many tiles of the noise along the layer: the more, the smaller its clouds. erosion: by detail, in [0, 1).
    """
    lo, hi = (-1.6, -1.6, -0.3), (1.6, 1.6, 0.3)
    rho = clouds.cloud("stratus", (resolution, resolution, resolution // 4), coverage, scale, erosion, seed)
    medium = media.grid(rho, lo, hi, density, 0.99, phase=CLOUD_PHASE)
    return Scene(
        medium=medium,
        lights=[
            lights.directional((0.9, 0.3, 0.6), (22.0, 19.0, 15.0)),
            lights.sky((0.8, 1.1, 1.8), (1.3, 1.3, 1.4), 0.5),
        ],
        viewpoints=Viewpoints(radius=4.6, elevation=(10, 65), fov=40),
        integrators=("deep", "march", "path", "preview"),
        aabb=np.array([lo, hi]),
        exposure=0.62,
    )


def smoke(density: float = 9.0, resolution: int = 128, seed: int = 2, volume: str | None = None) -> Scene:
    """a smoke plume over a floor that shows its shadow; takes any volume: --volume smoke.vdb"""
    lo, hi = (-0.8, -0.8, -1.1), (0.8, 0.8, 1.3)
    albedo: Any = (0.92, 0.90, 0.88)
    if volume is None:
        n = resolution
        rho = np.empty((int(n * 2 / 3), int(n * 2 / 3), n), np.float32)
        detail = cloud_textures(seed, 64).base
        in_bands(lambda a, b: fill_plume(detail, rho, a, b), rho.shape[0], 4)
    else:
        found = open_volume(volume, uses=("colour",)).upright()
        rho, lo, hi = _scaled(volume, found, lo, hi)
        albedo = albedo if found.colour is None else found.colour.map(lambda v: v * np.float32(albedo))
    medium = media.grid(rho, lo, hi, density, albedo, phase=phase.henyey_greenstein(0.3))
    return Scene(
        medium=medium,
        shapes=[surfaces.box(0, (-1.5, -1.5, -1.25), (1.5, 1.5, -1.15))],
        materials=[materials.lambert((0.36, 0.34, 0.31), (0.15, 0.16, 0.18), 0.3)],
        lights=[lights.directional((0.9, -0.5, 0.9), (17.0, 15.5, 13.2)), lights.sky((0.5, 0.65, 1.0), 0.8, 0.3)],
        viewpoints=Viewpoints(radius=5.0, elevation=(5, 55), fov=40),
        integrators=("deep", "march", "path"),
        aabb=np.array([[-1.5, -1.5, -1.25], [1.5, 1.5, 1.35]]),
        exposure=0.62,
    )


def explosion(
    density: float = 16.0, heat: float = 8.0, kelvin: float = 2600.0, resolution: int = 128, seed: int = 4,
    volume: str | None = None,
) -> Scene:  # fmt: skip
    """a fireball: soot that glows as a black body, hottest in its cracks; a --volume may bring temperature, flame and Cd"""
    n, lo, hi, albedo = resolution, (-1.2,) * 3, (1.2,) * 3, cast(Any, 0.35)
    if volume is None:
        rho, hot = np.empty((n, n, n), np.float32), np.empty((n, n, n), np.float32)
        t = cloud_textures(seed, 64).base
        in_bands(lambda a, b: fill_fireball(t, rho, hot, a, b), n, 4)
        glow = heat * blackbody.glow(kelvin * np.linspace(0.6, 1.0, 64), kelvin)
    else:
        found = open_volume(volume).upright()
        rho, lo, hi = _scaled(volume, found, lo, hi)
        albedo, hot = 0.35 if found.colour is None else found.colour.map(lambda v: np.float32(0.35) * v), found.heat
        if hot is None:
            raise InputError(f"{volume}: expected a grid of temperature or flame beside the density")
        glow = found.glow(kelvin, heat)
    medium = media.grid(rho, lo, hi, density, albedo, glow, attribute=hot)
    return Scene(
        medium=medium,
        lights=[lights.directional((0.7, -0.4, 1.0), (2.2, 2.2, 2.4)), lights.sky((0.3, 0.4, 0.6), 0.35, 0.15)],
        viewpoints=Viewpoints(radius=4.6, elevation=(-10, 50), fov=40),
        integrators=("deep", "march", "path", "emission"),
        aabb=np.array([[-1.2] * 3, [1.2] * 3]),
    )


TISSUE = np.array(
    [
        [0.00, 0.00, 0.80, 0.60, 0.50],
        [0.10, 0.00, 0.80, 0.60, 0.50],
        [0.18, 0.03, 0.85, 0.55, 0.42],
        [0.30, 0.02, 0.75, 0.25, 0.22],
        [0.45, 0.10, 0.80, 0.30, 0.25],
        [0.60, 0.30, 0.90, 0.80, 0.60],
        [0.80, 0.80, 0.96, 0.93, 0.85],
        [1.00, 1.00, 1.00, 0.98, 0.92],
    ]
)
"""A transfer function: value, opacity relative to the largest, and colour."""


def phantom(
    density: float = 40.0,
    resolution: int = 128,
    volume: str | None = None,
    transfer: str | None = None,
    mode: str = "lit",
) -> Scene:
    """a CT-like head phantom through a transfer function: skin, bone and inner organs; takes --volume stent.npz

    transfer: a file of control points in the volume's own values (``transfer.py``), instead of TISSUE over the window that the
    volume's histogram suggests. mode: lit, or emission, which shows the colours themselves as a CT viewer does.
    """
    if mode not in ("lit", "emission"):
        raise InputError(f"scene phantom: mode expects lit or emission, got {mode}")
    points, lo, hi = TISSUE, (-0.8, -1.0, -0.8), (0.8, 1.0, 0.8)
    if volume is None:
        if transfer is not None:
            raise InputError("scene phantom: transfer belongs to a --volume, expected one")
        value = _head(resolution)
    else:
        window = None
        if transfer is not None:
            points, window = _over(transfers.read(transfer))
        value, lo, hi = _imported(volume, (-1.1,) * 3, (1.1,) * 3, values=window or transfers.window)
    opacity = np.interp(value, points[:, 0], points[:, 1]).astype(np.float32)
    colours = np.stack([np.interp(np.linspace(0, 1, 256), points[:, 0], points[:, c]) for c in (2, 3, 4)], axis=1)
    albedo, glow = (colours, 0.0) if mode == "lit" else (0.0, colours)
    medium = media.grid(opacity, lo, hi, density, albedo, glow, attribute=value)
    return Scene(
        medium=medium,
        lights=[lights.directional((0.6, -0.8, 0.9), 7.0), lights.environment(0.55)] if mode == "lit" else [],
        viewpoints=Viewpoints(radius=4.0, elevation=(-20, 60), fov=38),
        integrators=("deep", "march", "path", "emission", "raycast")
        if mode == "lit"
        else ("emission", "path", "raycast"),
        aabb=np.array([lo, hi]),
        classified=raycast.classified(value, lo, hi, points, density),
    )


def _over(points: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """(points with values scaled to [0, 1], the smallest and largest value)."""
    low, high = float(points[0, 0]), float(points[-1, 0])
    return np.concatenate([(points[:, :1] - low) / (high - low), points[:, 1:]], axis=1), (low, high)


def _head(n: int) -> np.ndarray:
    """Ellipsoids after Shepp & Logan, as tissue values in [0, 1] with soft edges."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij", sparse=True)

    def ball(cx: float, cy: float, cz: float, rx: float, ry: float, rz: float) -> np.ndarray:
        r = np.sqrt(((x - cx) / rx) ** 2 + ((y - cy) / ry) ** 2 + ((z - cz) / rz) ** 2)
        return np.clip((1.0 - r) * min(rx, ry, rz) * n / 5.0 + 0.5, 0.0, 1.0)

    skin, outer, inner = ball(0, 0, 0, 0.86, 0.92, 0.9), ball(0, 0, 0, 0.76, 0.83, 0.8), ball(0, 0, 0, 0.70, 0.77, 0.74)
    value = 0.17 * skin + 0.68 * outer - 0.60 * inner
    for c, tissue in (
        ((-0.26, 0.05, 0.1, 0.16, 0.40, 0.3), 0.22),
        ((0.26, 0.05, 0.1, 0.16, 0.40, 0.3), 0.22),
        ((0.0, 0.35, 0.0, 0.18, 0.2, 0.25), 0.35),
        ((0.0, -0.45, -0.1, 0.10, 0.12, 0.12), 0.5),
    ):
        value += tissue * ball(*c)
    cut = np.clip((0.05 - np.minimum(-y, x)) * n / 5.0 + 0.5, 0, 1)  # a quarter is taken out to look inside
    return np.clip(value * cut, 0, 1)


def _scaled(
    path: str, volume: Volume, lo: media.Point, hi: media.Point
) -> tuple[np.ndarray | Sparse, media.Point, media.Point]:
    """The density in [0, 1], 1 where it is largest, in a box as large as lo..hi allows."""
    samples = volume.density
    largest, smallest = float(samples.max()), float(samples.min())
    if largest <= 0:
        raise InputError(f"{path}: expected a density that is somewhere positive, got at most {largest:g}")
    if smallest < 0:
        warnings.warn(
            f"{path}: some samples are negative, down to {smallest:g}, and count as 0", RenderWarning, stacklevel=3
        )

    def clipped(v: np.ndarray) -> np.ndarray:
        return np.clip(v / np.float32(largest), 0.0, 1.0)

    box = _placed(samples.shape, volume.spacing, lo, hi)
    return samples.map(clipped) if isinstance(samples, Sparse) else clipped(samples), *box


def _placed(
    shape: Sequence[int], spacing: np.ndarray, lo: media.Point, hi: media.Point
) -> tuple[media.Point, media.Point]:
    """The box of a volume in the middle of lo..hi, as large as fits."""
    extent = (np.array(shape) - 1) * spacing
    room = np.array(hi) - np.array(lo)
    extent *= (room / extent).min()
    middle = 0.5 * (np.array(hi) + np.array(lo))
    return tuple(middle - extent / 2), tuple(middle + extent / 2)


def _imported(
    volume: str,
    lo: media.Point,
    hi: media.Point,
    values: tuple[float, float] | Callable[[np.ndarray], tuple[float, float]],
) -> tuple[np.ndarray, media.Point, media.Point]:
    """A scan's samples scaled to [0, 1], in a box as large as lo..hi allows. values: what becomes 0 and 1, or how to tell from
    the samples."""
    samples, spacing = read_volume(volume)
    low, high = values(samples) if callable(values) else values
    if high <= low:
        raise InputError(f"{volume}: expected samples of more than one value, got {high:g} alone")
    samples = np.clip((samples - low) / (high - low), 0.0, 1.0)
    return np.ascontiguousarray(samples, np.float32), *_placed(samples.shape, spacing, lo, hi)
