"""What learning recovered of a medium that stands among solids, away from their surfaces.

    python tools/recovered.py SCENE RUN        (SCENE: showcase, fog, mist: media whose formula is known)

``nerfvol eval --truth`` compares inside the whole box of a density; a floor or a ball in it would count as error. Here points
and chords are drawn at random in the medium's box, and those count that are nowhere within ``MARGIN`` of a solid.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

os.environ["NUMBA_DISABLE_JIT"] = "1"  # a few thousand look-ups

import numpy as np

import data_synth as ds
from data_synth import lookups, media, surfaces
from data_synth.scenes.showcase import Showcase, haze_density
from data_synth.scenes.showcase_sdf import distance
from nerfvol.measure.truth import random_chords
from nerfvol.models import load_model
from nerfvol.octree.points import octree_density
from nerfvol.views import OctreeModel

MARGIN = 0.06  # u: some of the finest cells that a short training has
POINTS, SAMPLES = 3000, 96  # of the density; along a chord
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


def compare(found: np.ndarray, truth: np.ndarray) -> str:
    """Relative L1, Pearson's correlation, and sums."""
    constant = np.ptp(truth) <= 1e-9
    correlation = "none: the true one is constant" if constant else f"{np.corrcoef(found, truth)[0, 1]:.3f}"
    return (
        f"relative L1 {np.abs(found - truth).sum() / truth.sum():.3f}, correlation {correlation}, "
        f"found/true {found.sum() / truth.sum():.3f} ({len(truth)})"
    )


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
    print("density: ", compare(octree_density(octree, points), np.array([sigma(*p) for p in points])))
    taken = []
    for o, d, length in zip(*random_chords(lo, hi), strict=True):
        along = o + (np.arange(SAMPLES)[:, None] + 0.5) / SAMPLES * length * d
        if length > 0.3 and all(clear(*p) for p in along[::4]):
            truth = np.array([sigma(*p) for p in along]).mean() * length
            taken.append((1 - np.exp(-octree_density(octree, along).mean() * length), 1 - np.exp(-truth)))
        if len(taken) == 400:
            break
    print("opacity: ", compare(*np.array(taken).T))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
