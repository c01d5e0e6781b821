"""What learning recovered of a medium that stands among solids, away from their surfaces.

    python tools/recovered.py SCENE RUN        (SCENE: showcase, fog, mist: media whose formula is known)

``nerfvol eval --truth`` compares inside the whole box of a density; a floor or a ball in it would count as error. Here points
and chords are drawn at random in the medium's box, and those count that are nowhere within ``MARGIN`` of a solid.

A few opaque cells can hold most of the sum of a density and yet hardly be in a picture. So the density is also compared
weighted by how well it is seen: by the mean transmittance, through the octree, between a point and the scene's cameras.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable

os.environ["NUMBA_DISABLE_JIT"] = "1"  # a few thousand look-ups

import numpy as np

import data_synth as ds
from data_synth import lookups, media, surfaces
from data_synth.scenes.showcase import Showcase, haze_density
from data_synth.scenes.showcase_sdf import distance
from nerfvol.kernels import ops
from nerfvol.measure.truth import random_chords, within_box
from nerfvol.models import load_model
from nerfvol.octree.points import octree_density
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel

MARGIN = 0.06  # u: some of the finest cells that a short training has
SPACING = MARGIN / 2  # u: of the points that are asked along a chord, so that no solid is stepped over
POINTS, CHORDS, CAMERAS = 3000, 400, 24
Field = Callable[[float, float, float], float]


def known(name: str) -> tuple[np.ndarray, np.ndarray, Field, Callable[[float, float, float], bool]]:
    """(lo, hi, green extinction in 1/u, whether a point is clear of solids) of a scene."""
    scene = ds.scenes.make(name)
    if isinstance(scene, Showcase):
        haze = scene.haze
        reach, half = haze.radius + 3 * haze.width, 3 * haze.width + 0.10
        lo, hi = np.array([-reach, -reach, haze.height - half]), np.array([reach, reach, haze.height + half])
        return lo, hi, lambda x, y, z: haze_density(haze, x, y, z), lambda x, y, z: distance(x, y, z) > MARGIN
    m = scene.medium
    if not isinstance(m, media.Medium):
        raise SystemExit(f"expected a scene with one medium, {name} has none")
    solid = surfaces.geometry(scene.shapes, scene.triangles).shapes
    about = [np.zeros(3), *(MARGIN * sign * axis for axis in np.eye(3) for sign in (1, -1))]

    def clear(x: float, y: float, z: float) -> bool:
        return not any(surfaces.contains(row, tuple(np.array((x, y, z)) + d)) for row in solid for d in about)

    return np.array(m.lo), np.array(m.hi), lambda x, y, z: m.sigma_t[1] * lookups.density(m, (x, y, z)), clear


def compare(found: np.ndarray, truth: np.ndarray, weight: np.ndarray | float = 1.0) -> str:
    """Relative L1, Pearson's correlation, sums, and the middle one of the ratios."""
    constant = np.ptp(truth) <= 1e-9
    correlation = "none: the true one is constant" if constant else f"{np.corrcoef(found, truth)[0, 1]:.3f}"
    total, there = (weight * truth).sum(), truth > 0
    return (
        f"relative L1 {(weight * np.abs(found - truth)).sum() / total:.3f}, correlation {correlation}, "
        f"found/true {(weight * found).sum() / total:.3f}, median {np.median(found[there] / truth[there]):.3f} ({len(truth)})"
    )


def seen(octree: Octree, points: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """(n,) mean transmittance of ``octree`` between points (n, 3) and eyes (m, 3) outside of it."""
    o = np.repeat(points, len(eyes), axis=0)
    d = np.tile(eyes, (len(points), 1)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    opacity = ops.render_rays(octree, o, d, early_stop_eps=0.0, outputs=("opacity",))["opacity"]
    return 1 - opacity.reshape(len(points), len(eyes)).mean(axis=1, dtype=np.float64)


def clear_chords(
    lo: np.ndarray, hi: np.ndarray, sigma: Field, clear: Callable[[float, float, float], bool]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(start (n, 3), direction (n, 3), true opacity (n,)) of chords through the box that meet no solid."""
    starts, directions, opacities = [], [], []
    for o, d, length in zip(*random_chords(lo, hi), strict=True):
        if length > 0.3:
            n = math.ceil(length / SPACING)
            along = o + (np.arange(n)[:, None] + 0.5) / n * length * d
            if all(clear(*p) for p in along):
                starts.append(o)
                directions.append(d)
                opacities.append(-math.expm1(-np.mean([sigma(*p) for p in along]) * length))
        if len(starts) == CHORDS:
            break
    return np.array(starts), np.array(directions), np.array(opacities)


def main(argv: list[str]) -> int:
    """Print density and opacity along chords."""
    name, run = argv
    lo, hi, sigma, clear = known(name)
    model = load_model(run)
    if not isinstance(model, OctreeModel):
        raise SystemExit(f"{run}: expected an octree")
    octree = model.octree
    points = lo + np.random.default_rng(0).random((POINTS, 3)) * (hi - lo)
    points = points[[clear(*p) for p in points]]
    density, truth = octree_density(octree, points), np.array([sigma(*p) for p in points])
    eyes = np.array([camera.c2w[:3, 3] for camera in ds.scenes.make(name).viewpoints.spread(CAMERAS, 8, 8, 0)])
    print("density:  ", compare(density, truth))
    print("  as seen:", compare(density, truth, seen(octree, points, eyes)))
    start, direction, truth = clear_chords(lo, hi, sigma, clear)
    medium, opacity = within_box(octree, lo, hi, SPACING), np.zeros(len(start))
    if medium is not None:
        opacity = ops.render_rays(medium, start, direction, early_stop_eps=0.0, outputs=("opacity",))["opacity"]
    print("opacity:  ", compare(opacity.astype(np.float64), truth))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
