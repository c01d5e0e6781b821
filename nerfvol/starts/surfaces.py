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
from nerfvol.native import native
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
KEEP = 0.05
"""How much the colours' degree 1 stays as it was: so many looks of weight 1 that ask for no other."""
DENSE, THIN = 2.0, 0.015
"""Optical thickness along a side of the finest leaf: at least, of a vertex on a surface; at most, of one in the free."""

Floats = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Seen:
    """A picture of a model through a pinhole: rgb (H, W, 3) without any background, opacity (H, W) and median distance (H, W),
    scene units, 0 where there is none."""

    camera: Camera
    rgb: Floats
    opacity: Floats
    distance: Floats


@dataclass(frozen=True, eq=False)
class _Vertices:
    """n vertices: positions (n, 3) and the side of their finest leaf (n,), float64; and what looks at them write: how many call
    them free, how many lie on them, (n,) int16, and colours (n, 3, k) float32, corrected."""

    positions: NDArray[np.float64]
    side: NDArray[np.float64]
    free: NDArray[np.int16]
    on: NDArray[np.int16]
    sh: NDArray[np.float32]


def write_surfaces(octree: Octree, views: Sequence[Seen]) -> None:
    """Sets densities and colours of the vertices that ``views``, of cameras without distortion, know something of; the others
    stay. Colours are those of degree 0 and 1; degree 1 leaves what it has as far as looks from few sides ask for no other."""
    if octree.sh_degree > 1:
        raise ValueError(f"surfaces are written into octrees of degree 0 or 1, got {octree.sh_degree}")
    side, slots, n = finest_sides(octree), sh_slots(octree.sh_degree), octree.n_vertices
    vertices = _Vertices(
        octree.vertex_positions(), side, np.zeros(n, np.int16), np.zeros(n, np.int16),
        np.ascontiguousarray(octree.values[:, slots]),
    )  # fmt: skip
    if native() is None:
        _look(views, vertices)
    else:
        _look_compiled(views, vertices)
    free, on, sh = vertices.free, vertices.on, vertices.sh
    surface, empty = (on >= VOTES) & (on >= free), free >= VOTES
    thickness = explin(octree.density) * octree.density_scale * side
    thickness = np.where(surface, np.maximum(thickness, DENSE), np.where(empty, np.minimum(thickness, THIN), thickness))
    raw = explin_inverse(np.maximum(thickness / side / octree.density_scale, 1e-30))
    values, chosen = octree.values, np.flatnonzero(surface)
    values[:, DENSITY_SLOT] = np.maximum(raw, EMPTY_DENSITY)
    values[chosen[:, None], slots.reshape(-1)] = sh[chosen].reshape(-1, slots.size)
    octree.prefiltered = None


def _pose(camera: Camera) -> NDArray[np.float64]:
    """(12,): from the world's to a camera's axes, x to the right, y down and z forward, row by row, and where it stands."""
    axes = camera.c2w[:3, :3].T * np.array([[1.0], [-1.0], [-1.0]])
    return np.concatenate([axes.reshape(-1), camera.c2w[:3, 3]])


def _look_compiled(views: Sequence[Seen], vertices: _Vertices) -> None:
    """csrc/looks.cpp, in float64, for any number of threads the same."""
    compiled = native()
    assert compiled is not None
    compiled.look_at_vertices(
        rgb=[np.ascontiguousarray(view.rgb, np.float32) for view in views],
        distance=[np.where(v.opacity <= NOTHING, np.inf, v.distance).astype(np.float32) for v in views],
        poses=np.stack([_pose(view.camera) for view in views]),
        lenses=np.array([(v.fx, v.fy, v.cx, v.cy) for v in (view.camera.intrinsics for view in views)], np.float64),
        verdict=[REACH, BEFORE, KEEP], **vars(vertices),
    )  # fmt: skip


def _look(views: Sequence[Seen], vertices: _Vertices) -> None:
    """The same in numpy, where nothing is compiled."""
    positions, side, free, on, sh = vars(vertices).values()
    k = sh.shape[2]
    squares, missed = np.zeros((len(side), k, k)), np.zeros((len(side), 3, k))
    for view in views:
        pose, lens = _pose(view.camera), view.camera.intrinsics
        apart = positions - pose[9:]
        x, y, z = (apart @ pose[:9].reshape(3, 3).T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        height, width = view.opacity.shape
        vertex = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
        pixel = v[vertex].astype(np.int64), u[vertex].astype(np.int64)
        far, there = np.linalg.norm(apart[vertex], axis=1), view.distance[pixel]
        beyond = (far - there) / side[vertex]
        free[vertex] += (view.opacity[pixel] <= NOTHING) | ((there > 0) & (beyond < -BEFORE))
        hit = (there > 0) & (np.abs(beyond) < REACH)
        chosen, weight = vertex[hit], np.exp(-(beyond[hit] ** 2))
        on[chosen] += 1
        basis = np.asarray(eval_basis(int(k > 1), apart[chosen] / far[hit, None]), np.float64)
        rest = view.rgb[pixel][hit] - 0.5 - np.einsum("nk,nck->nc", basis, sh[chosen])
        squares[chosen] += weight[:, None, None] * basis[:, :, None] * basis[:, None]
        missed[chosen] += weight[:, None, None] * rest[:, :, None] * basis[:, None]
    seen = np.flatnonzero(on)
    squares[:, range(k), range(k)] += np.array([1e-9, *[KEEP] * (k - 1)])
    sh[seen] += np.linalg.solve(squares[seen, None], missed[seen][..., None])[..., 0]
