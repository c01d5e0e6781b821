"""Scenes whose answer is known in closed form, and scenes of one idea each."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from data_synth import lights, materials, media, phase, surfaces
from data_synth.cameras import Viewpoints
from data_synth.scene import Scene


def slab(sigma: float = 1.2, height: float = 0.6, bars: int = 1) -> Scene:
    """homogeneous glowing slab: T = exp(-sigma length), L = (1 - T) Le

    bars: cut into so many upright bars along x, each higher than the one before, the last one ``height``.
    """
    medium = media.homogeneous((-1, -1, -height / 2), (1, 1, height / 2), (sigma, 0.8 * sigma, 0.5 * sigma))
    edges = np.linspace(-1, 1, bars + 1)
    tops = height * (np.arange(1, bars + 1) / bars - 0.5)
    wide, deep = 0.76 * 2 / bars, min(1.0, 3 / bars)
    cut = [
        surfaces.box(0, (x, -deep, -height / 2), (x + wide, deep, top)) for x, top in zip(edges[:-1], tops, strict=True)
    ]
    return Scene(
        medium=medium._replace(Le=np.array([[0.9, 0.55, 0.25]])),
        shapes=cut if bars > 1 else [],
        materials=[materials.null()] if bars > 1 else [],
        bounded=bars > 1,
        viewpoints=Viewpoints(radius=4.2, elevation=(5, 60)),
        integrators=("emission", "path"),
        aabb=np.array([[-1.05, -1.05, -height], [1.05, 1.05, height]]),
    )


def sphere(sigma: float = 1.6, radius: float = 1.0) -> Scene:
    """homogeneous glowing sphere: T = exp(-sigma chord)"""
    r = radius
    medium = media.homogeneous((-r,) * 3, (r,) * 3, (0.5 * sigma, 0.8 * sigma, sigma), Le=(0.25, 0.55, 0.95))
    return Scene(
        medium=medium,
        shapes=[surfaces.sphere(0, (0, 0, 0), r)],
        materials=[materials.null()],
        bounded=True,
        viewpoints=Viewpoints(radius=4.2, elevation=(-30, 60)),
        integrators=("emission", "path"),
        aabb=np.array([[-1.05 * r] * 3, [1.05 * r] * 3]),
    )


def solids() -> Scene:
    """glossy sphere, box and a faceted gem under a sun and a sky, no medium"""
    return Scene(
        shapes=_stage(),
        triangles=_gem(4, (0.75, -0.55, -0.28), 0.42),
        materials=_stage_materials(),
        lights=[lights.directional((0.5, -0.7, 1.0), (2.6, 2.4, 2.1)), lights.sky((0.25, 0.45, 0.9), 0.7, 0.15)],
        viewpoints=Viewpoints(target=(0, 0, -0.3), radius=4.2, elevation=(12, 70)),
        integrators=("path", "march"),
        aabb=np.array([[-1.5, -1.5, -0.85], [1.5, 1.5, 0.6]]),
    )


def mist(density: float = 0.5, height: float = 0.5) -> Scene:
    """the solids in fog that thins with height, in a box of air"""
    medium = media.exponential(
        (-1.5, -1.5, -0.7), (1.5, 1.5, 0.9), height, 2.0 * density, 0.95, phase=phase.henyey_greenstein(0.4)
    )
    scene = solids()
    scene.medium = medium
    scene.integrators = ("path", "march", "deep")
    scene.aabb = np.array([[-1.5, -1.5, -0.85], [1.5, 1.5, 0.9]])
    return scene


def _stage() -> list:
    return [
        surfaces.box(0, (-1.5, -1.5, -0.8), (1.5, 1.5, -0.7)),
        surfaces.sphere(1, (-0.6, -0.25, -0.2), 0.5),
        surfaces.box(2, (0.2, 0.3, -0.7), (0.9, 1.0, 0.1)),
        surfaces.sphere(3, (-0.2, 0.85, -0.42), 0.28),
        surfaces.sphere(5, (0.0, -1.0, -0.5), 0.2),
    ]


def _stage_materials() -> list:
    return [
        materials.lambert((0.72, 0.68, 0.60), (0.16, 0.18, 0.22), 0.3),
        materials.blinn_phong((0.62, 0.04, 0.05), 0.25, 80),
        materials.blinn_phong((0.05, 0.22, 0.55), 0.12, 30),
        materials.blinn_phong((0.75, 0.48, 0.08), 0.22, 60),
        materials.blinn_phong((0.08, 0.50, 0.22), 0.25, 50),
        materials.dielectric(1.5),
    ]


def _gem(material: int, centre: ArrayLike, radius: float) -> np.ndarray:
    """An octahedron stretched along z."""
    v = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float) * radius
    f = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
    return surfaces.mesh(material, v + np.asarray(centre), f)


def fog(density: float = 0.38, g: float = 0.35, thinning: float = 0.0) -> Scene:
    """fog with shafts of light that fall through a slotted wall onto a checker floor

    thinning: e-fold per u of height; 0 is fog that is the same everywhere, up to a height of 1.5 u.
    """
    scatter, lo, top = phase.henyey_greenstein(g), (-2, -2, -1), 0.5 if thinning <= 0 else 1.65
    if thinning > 0:
        medium = media.exponential(lo, (2, 2, top), 1.0 / thinning, density, 0.97, phase=scatter)
    else:
        medium = media.homogeneous(lo, (2, 2, top), density, 0.97, phase=scatter)
    wall = [surfaces.box(1, (-1.95, y, -1.0), (-1.85, y + 0.62, 1.65)) for y in (-2.0, -1.127, -0.253, 0.62, 1.38)]
    return Scene(
        medium=medium._replace(step=0.015),
        shapes=[
            surfaces.box(0, (-2, -2, -1.1), (2, 2, -1.0)),
            surfaces.sphere(2, (-0.5, -0.3, -0.55), 0.45),
            surfaces.box(3, (0.5, 0.1, -1.0), (1.1, 0.7, -0.2)),
            *wall,
        ],
        materials=[
            materials.lambert((0.7, 0.68, 0.62), (0.12, 0.13, 0.16), 0.4),
            materials.lambert((0.16, 0.13, 0.10)),
            materials.blinn_phong((0.6, 0.06, 0.05), 0.2, 60),
            materials.lambert((0.1, 0.3, 0.5)),
        ],
        lights=[
            lights.directional((-1.0, 0.16, 0.32), (30.0, 24.0, 16.5)),
            lights.directional((0.5, -0.8, 1.0), (0.5, 0.65, 1.0)),
        ],
        viewpoints=Viewpoints(target=(0, 0, -0.2), radius=5.8, elevation=(8, 40), fov=42),
        integrators=("march", "path", "deep"),
        aabb=np.array([[-2.05, -2.05, -1.15], [2.05, 2.05, 1.65]]),
    )
