"""What pictures of splats say of an octree's vertices before anything is fitted: where surfaces are, where nothing is, colours.

A picture has, for each pixel, the distance at which half of its light is gathered. A vertex about so far away lies on a surface
and has the pixel's colour; one well before it, or on a pixel that shows nothing, lies in the free. Splats that overlap are no
sum of densities, so that their sum is haze around every surface: vertices that views call free are emptied, those on surfaces
are dense enough to be seen. It is closed form, a few looks at each vertex, and worth hundreds of steps of a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.octree.rows import DENSITY_SLOT, EMPTY_DENSITY, explin, explin_inverse, sh_slots
from nerfvol.octree.tree import Octree
from nerfvol.sh import eval_basis
from nerfvol.starts.values import finest_sides

REACH = 1.0
"""Sides of a leaf: a vertex no farther from the median distance lies on the surface, ..."""
BEFORE = 1.5
"""... one so far before it in the free; ..."""
NOTHING = 0.1
"""... so does every vertex on a pixel of this opacity or less."""
VOTES = 2
"""Views that must say so, and more of them than say the other."""
DENSE, THIN = 1.0, 0.003
"""Optical thickness along a side of the finest leaf: at least, of a vertex on a surface; at most, of one in the free."""

Floats = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Seen:
    """A picture of a model: rgb (H, W, 3) without any background, opacity (H, W) and median distance (H, W), scene units, 0
    where there is none."""

    camera: Camera
    rgb: Floats
    opacity: Floats
    distance: Floats


def write_surfaces(octree: Octree, views: Sequence[Seen]) -> None:
    """Sets densities and constant colours of the vertices that ``views`` know something of; the others stay."""
    positions, side = octree.vertex_positions(), finest_sides(octree)
    free, on = (np.zeros(octree.n_vertices, np.int16) for _ in range(2))
    weights, colours = np.zeros(octree.n_vertices, np.float32), np.zeros((octree.n_vertices, 3), np.float32)
    slots = sh_slots(octree.sh_degree)
    for view in views:
        vertex, distance, row, column = _on_picture(view.camera, positions)
        there, opacity = view.distance[row, column], view.opacity[row, column]
        beyond = (distance - there) / side[vertex]
        free[vertex] += (opacity <= NOTHING) | ((there > 0) & (beyond < -BEFORE))
        hit = np.flatnonzero((there > 0) & (np.abs(beyond) < REACH))
        chosen = vertex[hit]
        on[chosen] += 1
        directions = (positions[chosen] - view.camera.position) / distance[hit, None]
        basis = np.asarray(eval_basis(octree.sh_degree, directions.astype(np.float32)), np.float32)
        rest = np.einsum("nk,nck->nc", basis[:, 1:], octree.values[chosen[:, None, None], slots[:, 1:]])
        weight = np.exp(-(beyond[hit] ** 2)).astype(np.float32)
        weights[chosen] += weight
        wanted = view.rgb[row[hit], column[hit]] - np.float32(0.5) - rest
        colours[chosen] += (weight / basis[:, 0])[:, None] * wanted
    mean = colours / np.maximum(weights, np.float32(1e-9))[:, None]
    _write(octree, side, (on >= VOTES) & (on >= free), free >= VOTES, mean)


def _on_picture(camera: Camera, positions: NDArray[np.float64]) -> tuple[NDArray[np.int64], ...]:
    """The vertices that a camera has in its picture, their distances, rows and columns, (m,) each."""
    lens, pixels = camera.intrinsics, camera.project(positions)  # NaN, which is in no picture, behind the camera
    vertex = np.flatnonzero(((pixels >= 0) & (pixels < (lens.width, lens.height))).all(1))
    column, row = pixels[vertex].astype(np.int64).T
    return vertex, np.linalg.norm(positions[vertex] - camera.position, axis=1), row, column


def _write(octree: Octree, side: NDArray, on: NDArray, free: NDArray, colours: Floats) -> None:
    """Densities of vertices on surfaces (n,) bool and of the other ones that are free, colours of the former (n, 3)."""
    thickness = explin(octree.density) * octree.density_scale * side
    thickness = np.where(on, np.maximum(thickness, DENSE), np.where(free, np.minimum(thickness, THIN), thickness))
    raw = explin_inverse(np.maximum(thickness / side / octree.density_scale, 1e-30))
    values = octree.values
    values[:, DENSITY_SLOT] = np.maximum(raw, EMPTY_DENSITY)
    chosen = np.flatnonzero(on)
    values[chosen[:, None], sh_slots(octree.sh_degree)[:, 0]] = colours[chosen]
    octree.prefiltered = None
