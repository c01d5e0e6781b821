"""A surface from views: a truncated signed distance, averaged over them, and its level set (Curless & Levoy 1996).

Distances are along rays, to the median depth; a view counts less the more it grazes. Voxels that no ray of any view reaches
in front of, or shortly behind, a surface stay unknown, and no triangle is made from them. Marching cubes: scikit-image
(Lewiner et al. 2003), the extra ``nerfvol[mesh]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.export.surface import SEEN, Shot

TRUNCATION = 4
"""Voxels; also the side of the blocks that are looked at."""
_GRAZING = 0.05  # the least weight
_RUN = 1 << 18  # voxels at a time
SMALLEST = 1e-3
"""Components with a smaller share of the faces are dropped."""


@dataclass(frozen=True)
class Mesh:
    """vertices (n, 3) float64, scene units; faces (m, 3) int32, counter-clockwise seen from outside; colours (n, 3) float32 in
    [0, 1], as in the training images."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    colours: NDArray[np.float32]


def require_library() -> Any:
    """scikit-image's measure; InputError where it is missing."""
    try:
        from skimage import measure
    except ImportError as error:
        raise InputError("a mesh needs scikit-image: pip install 'nerfvol[mesh]'") from error
    return measure


def mesh_of_shots(shots: Sequence[Shot], low: NDArray, high: NDArray, resolution: int) -> Mesh:
    """The surface that ``shots`` see in the box from ``low`` to ``high`` (3,); resolution: voxels along its longest side.

    Raises:
        InputError: scikit-image is missing, or there is no surface in the box.
    """
    measure = require_library()
    voxel = float((high - low).max() / resolution)
    first = low - TRUNCATION * voxel
    counts = (np.ceil((high - first) / voxel).astype(int) + TRUNCATION + 1) // TRUNCATION * TRUNCATION
    index = _near_surface(shots, first, voxel, counts)
    if not len(index):
        raise InputError("there is no surface in the box")
    value, weight = _average(shots, first, voxel, index)
    known = weight > 0
    field, valid = np.ones(counts, np.float32), np.zeros(counts, bool)
    field[tuple(index[known].T)], valid[tuple(index[known].T)] = value[known], True
    whole = np.zeros(counts, bool)  # skimage asks for a cell at its last corner
    whole[1:, 1:, 1:] = True
    for offset in np.ndindex(2, 2, 2):
        whole[1:, 1:, 1:] &= valid[tuple(slice(o, n - 1 + o) for o, n in zip(offset, counts, strict=True))]
    if not whole.any() or not field[valid].min() < 0 < field[valid].max():
        raise InputError("the views see no closed part of a surface: give more --views")
    places, faces, _, _ = measure.marching_cubes(field, 0.0, mask=whole)
    vertices = first + (places.astype(np.float64) + 0.5) * voxel
    vertices, faces = without_islands(vertices, faces.astype(np.int32))
    return Mesh(vertices, faces, _colours(shots, vertices, 2 * voxel))


def _near_surface(shots: Sequence[Shot], first: NDArray, voxel: float, counts: NDArray) -> NDArray[np.int64]:
    """Indices (n, 3) of the voxels in the blocks that a point of the surface lies in, and in those that touch them."""
    blocks = counts // TRUNCATION
    near = np.zeros(blocks + 2, bool)
    for shot in shots:
        cells = np.floor((shot.points(SEEN)[0] - first) / (TRUNCATION * voxel)).astype(np.int64)
        cells = cells[((cells >= 0) & (cells < blocks)).all(axis=1)] + 1
        near[tuple(cells.T)] = True
    for axis in range(3):
        near = near | np.roll(near, 1, axis) | np.roll(near, -1, axis)
    chosen = np.argwhere(near[1:-1, 1:-1, 1:-1]) * TRUNCATION
    inside = np.stack(np.meshgrid(*[np.arange(TRUNCATION)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return (chosen[:, None] + inside).reshape(-1, 3)


def _average(
    shots: Sequence[Shot], first: NDArray, voxel: float, index: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The truncated distance (n,) in [-1, 1], positive outside, and its weight (n,), at the middles of voxels."""
    total, weight = np.zeros(len(index), np.float32), np.zeros(len(index), np.float32)
    reach = np.float32(TRUNCATION * voxel)
    slopes = [_facing(shot).reshape(-1) for shot in shots]
    for at in range(0, len(index), _RUN):
        part = slice(at, at + _RUN)
        places = first + (index[part] + 0.5) * voxel
        for shot, slope in zip(shots, slopes, strict=True):
            pixel, distance, shown = shot.look(places)
            depth = shot.depth.reshape(-1)[pixel]
            apart = np.where(depth > 0, depth - distance, reach)  # nothing there: the ray went through
            counts = np.where(shown & (apart > -reach), slope[pixel], 0).astype(np.float32)
            total[part] += counts * np.minimum(apart / reach, 1)
            weight[part] += counts
    return (total / np.maximum(weight, 1e-12)).astype(np.float32), weight


def _facing(shot: Shot) -> NDArray[np.float32]:
    """(H, W) how squarely a pixel looks at its surface, 1 straight on; where it meets none 1."""
    directions = shot.camera.rays()[1].reshape(shot.normal.shape)
    cosine = np.abs((shot.normal * directions).sum(axis=-1))
    return np.where(shot.depth > 0, np.maximum(cosine, _GRAZING), 1).astype(np.float32)


def _colours(shots: Sequence[Shot], vertices: NDArray[np.float64], tolerance: float) -> NDArray[np.float32]:
    """(n, 3) what the views see at vertices, the squarest most; of those that none sees, what the nearest seen one has."""
    total, weight = np.zeros((len(vertices), 3), np.float32), np.zeros(len(vertices), np.float32)
    for shot in shots:
        pixel, distance, shown = shot.look(vertices)
        seen = shown & (np.abs(shot.depth.reshape(-1)[pixel] - distance) < tolerance)
        counts = np.where(seen, _facing(shot).reshape(-1)[pixel] ** 2, 0).astype(np.float32)
        total += counts[:, None] * shot.rgb.reshape(-1, 3)[pixel]
        weight += counts
    known = weight > 0
    colours = total / np.maximum(weight, 1e-12)[:, None]
    if known.any() and not known.all():
        from scipy.spatial import KDTree  # scikit-image brings it

        colours[~known] = colours[known][KDTree(vertices[known]).query(vertices[~known])[1]]
    return colours.astype(np.float32)


def without_islands(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], share: float = SMALLEST
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The mesh without connected parts of less than ``share`` of its faces, and without vertices that no face names."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(ends), bool), tuple(ends.T)), shape=(len(vertices),) * 2)
    part = connected_components(graph, directed=False)[1][faces[:, 0]]
    kept = faces[(np.bincount(part) >= share * len(faces))[part]]
    named, renumbered = np.unique(kept, return_inverse=True)
    return vertices[named], renumbered.reshape(-1, 3).astype(np.int32)
