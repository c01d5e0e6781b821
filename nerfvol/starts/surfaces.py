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
DENSE, THIN = 2.0, 0.003
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


def write_surfaces(octree: Octree, views: Sequence[Seen]) -> None:
    """Sets densities and colours of the vertices that ``views``, of cameras without distortion, know something of; the others
    stay. Colours are those of degree 0 and 1; degree 1 leaves what it has as far as looks from few sides ask for no other."""
    if octree.sh_degree > 1:
        raise ValueError(f"surfaces are written into octrees of degree 0 or 1, got {octree.sh_degree}")
    positions, side = octree.vertex_positions(), finest_sides(octree)
    free, on = (np.zeros(octree.n_vertices, np.int16) for _ in range(2))
    slots = sh_slots(octree.sh_degree)
    sh = np.ascontiguousarray(octree.values[:, slots])
    compiled = native()
    look = _looked if compiled is None else compiled.look_at_vertices
    look(
        rgb=[np.ascontiguousarray(view.rgb, np.float32) for view in views],
        opacity=[np.ascontiguousarray(view.opacity, np.float32) for view in views],
        distance=[np.ascontiguousarray(view.distance, np.float32) for view in views],
        poses=np.stack([_pose(view.camera) for view in views]),
        lenses=np.array([(v.fx, v.fy, v.cx, v.cy) for v in (view.camera.intrinsics for view in views)], np.float64),
        verdict=[REACH, BEFORE, NOTHING, KEEP], positions=positions, side=side, free=free, on=on, sh=sh,
    )  # fmt: skip
    surface, empty = (on >= VOTES) & (on >= free), free >= VOTES
    thickness = explin(octree.density) * octree.density_scale * side
    thickness = np.where(surface, np.maximum(thickness, DENSE), np.where(empty, np.minimum(thickness, THIN), thickness))
    raw = explin_inverse(np.maximum(thickness / side / octree.density_scale, 1e-30))
    values, chosen = octree.values, np.flatnonzero(surface)
    values[:, DENSITY_SLOT] = np.maximum(raw, EMPTY_DENSITY)
    values[chosen[:, None, None], slots] = sh[chosen]
    octree.prefiltered = None


def _pose(camera: Camera) -> NDArray[np.float64]:
    """(12,): from the world's to a camera's axes, x to the right, y down and z forward, row by row, and where it stands."""
    axes = camera.c2w[:3, :3].T * np.array([[1.0], [-1.0], [-1.0]])
    return np.concatenate([axes.reshape(-1), camera.c2w[:3, 3]])


def _looked(
    *,
    rgb: Sequence[NDArray],
    opacity: Sequence[NDArray],
    distance: Sequence[NDArray],
    poses: NDArray,
    lenses: NDArray,
    verdict: Sequence[float],
    positions: NDArray,
    side: NDArray,
    free: NDArray,
    on: NDArray,
    sh: NDArray,
) -> None:
    """look_at_vertices of csrc/around.cpp in numpy, where nothing is compiled."""
    reach, before, nothing, keep = verdict
    k = sh.shape[2]
    squares, missed = np.zeros((len(side), k, k)), np.zeros((len(side), 3, k))
    for picture, opaque, depth, pose, (fx, fy, cx, cy) in zip(rgb, opacity, distance, poses, lenses, strict=True):
        apart = positions - pose[9:]
        x, y, z = (apart @ pose[:9].reshape(3, 3).T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = fx * x / z + cx, fy * y / z + cy
        height, width = opaque.shape
        vertex = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
        pixel = v[vertex].astype(np.int64), u[vertex].astype(np.int64)
        far, there = np.linalg.norm(apart[vertex], axis=1), depth[pixel]
        beyond = (far - there) / side[vertex]
        free[vertex] += (opaque[pixel] <= nothing) | ((there > 0) & (beyond < -before))
        hit = (there > 0) & (np.abs(beyond) < reach)
        chosen, weight = vertex[hit], np.exp(-(beyond[hit] ** 2))
        on[chosen] += 1
        basis = np.asarray(eval_basis(int(k > 1), apart[chosen] / far[hit, None]), np.float64)
        rest = picture[pixel][hit] - 0.5 - np.einsum("nk,nck->nc", basis, sh[chosen])
        squares[chosen] += weight[:, None, None] * basis[:, :, None] * basis[:, None]
        missed[chosen] += weight[:, None, None] * rest[:, :, None] * basis[:, None]
    seen = np.flatnonzero(on)
    squares[:, range(k), range(k)] += np.array([1e-9, *[keep] * (k - 1)])
    sh[seen] += np.linalg.solve(squares[seen, None], missed[seen][..., None])[..., 0]
