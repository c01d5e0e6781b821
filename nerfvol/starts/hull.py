"""Points on the visual hull: what all silhouettes of a cut-out object leave of its box, coloured by the views that see it.

A. Laurentini, "The visual hull concept for silhouette-based image understanding", 1994; carved from a grid as in
R. Szeliski, "Rapid octree construction from image sequences", 1993. Hollows stay filled: it is where splats begin, not what
they end as.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.averages import area_average
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.images import UInt8, map_threads
from nerfvol.splats.points import PointCloud

Places = NDArray[np.float64]

POINTS = 2_000
"""At most: the surface of a thing that fills its box has 10 cells for each of them, and steps cost by the splat."""
FEWEST = 300
"""Points where the surface has fewer cells, some in each: a small thing in a large box, for splats grow by being split."""
CELLS = 40
"""Along each side of the box: 64 take six times as long and train no better."""
VIEWS = 16
"""Whose silhouettes carve, evenly chosen: more take little more away."""
PICTURE = 100
"""Pixels along their shorter side, about: a cell is one or two of them."""
OPAQUE = 16
"""Alpha of 255, averaged over a pixel of these, from which on it may show the object."""
AGREE = 0.9
"""Of the views that have a cell in their picture: as many must show something there. One bad mask must not carve all away."""
SEEN = 0.5
"""Of all views: as many must have a cell in their picture, else it is left out."""
CUT_OUT = 0.5
"""Of the views: as many must have something transparent, else too few carve."""
BEHIND = 1.5
"""Cells by which a point may lie behind the first on its ray and still have its colour."""


def has_silhouettes(dataset: Dataset, all_of_them: bool = False) -> bool:
    """Whether it is an object whose pictures are cut out, or ``all_of_them`` are: what a hull is carved with. An opaque alpha
    cuts nothing out, and what it would leave is the box."""
    if dataset.scene.is_unbounded or dataset.masks is not None or any(i.shape[2] != 4 for i in dataset.images):
        return False
    looked = dataset.images if all_of_them else dataset.evenly(VIEWS).images
    cut_out = sum(bool((image[::4, ::4, 3] < OPAQUE).any()) for image in looked)
    return cut_out >= (1.0 if all_of_them else CUT_OUT) * len(looked)


def hull_points(dataset: Dataset, n: int = POINTS, seed: int = 0) -> PointCloud:
    """At most n points on the surface of the visual hull of a dataset that :func:`has_silhouettes`, each somewhere in its
    cell; the same ones for the same seed. None where the silhouettes have nothing in common."""
    views = dataset.evenly(VIEWS)
    factors = [max(1, min(image.shape[:2]) // PICTURE) for image in views.images]
    pictures = map_threads(lambda pair: area_average(*pair), zip(views.images, factors, strict=True), dataset.threads)
    cameras = [camera.scaled(k) for camera, k in zip(views.cameras, factors, strict=True)]
    seen = list(zip(cameras, pictures, strict=True))
    low, high = dataset.scene.aabb
    side = (high - low) / CELLS
    surface = _surface(_carved(seen, low, side))
    if not len(surface):
        return PointCloud.empty()
    random = np.random.default_rng(seed)
    cells = np.repeat(surface, -(-FEWEST // len(surface)), axis=0)
    chosen = cells[np.sort(random.permutation(len(cells))[:n])]
    colours = _colours(low + (chosen + 0.5) * side, low + (surface + 0.5) * side, seen, BEHIND * float(side.max()))
    return PointCloud(low + (chosen + random.random(chosen.shape)) * side, colours)


def _carved(seen: list[tuple[Camera, UInt8]], low: Places, side: Places) -> NDArray[np.bool_]:
    """(CELLS, CELLS, CELLS): the cells that the silhouettes leave."""
    steps = np.arange(CELLS) + 0.5
    middles = low + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) * side
    left = np.arange(len(middles))
    shown, missed = np.zeros(len(middles), np.int16), np.zeros(len(middles), np.int16)
    for camera, picture in seen:
        x, y, depth = _pixels(middles[left], camera)
        held = depth > 0
        there = np.zeros(len(left), bool)
        there[held] = picture[y[held], x[held], 3] >= OPAQUE
        shown[left] += there
        missed[left] += held & ~there
        left = left[missed[left] <= len(seen) - AGREE * len(seen)]  # what more views miss, the others cannot save
    out = np.zeros(len(middles), bool)
    counted = shown[left] + missed[left]
    out[left] = (counted >= SEEN * len(seen)) & (shown[left] >= AGREE * counted)
    return out.reshape(CELLS, CELLS, CELLS)


def _surface(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(m, 3) cells that are inside and have a side that is not."""
    around = np.pad(inside, 1)
    core = inside.copy()
    for axis in range(3):
        for step in (-1, 1):
            core &= np.roll(around, step, axis)[1:-1, 1:-1, 1:-1]
    return np.argwhere(inside & ~core)


def _colours(points: Places, surface: Places, seen: list[tuple[Camera, UInt8]], behind: float) -> NDArray[np.float32]:
    """(n, 3) the mean colour, in [0, 1], of points (n, 3) in the views in which nothing of the ``surface`` (m, 3) lies before
    them by more than ``behind``; grey where there is none."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for camera, whole in seen:
        picture = area_average(whole, 2)  # cells are to leave no holes in the surface
        half = camera.scaled(2)
        x, y, depth = _pixels(surface, half)
        nearest = np.full(picture.shape[:2], np.inf)
        held = depth > 0
        np.minimum.at(nearest, (y[held], x[held]), depth[held])
        x, y, depth = _pixels(points, half)
        seen_by = np.flatnonzero(depth > 0)
        at = (y[seen_by], x[seen_by])
        first = (depth[seen_by] <= nearest[at] + behind) & (picture[at][:, 3] >= OPAQUE)
        total[seen_by[first]] += picture[at][first, :3]
        count[seen_by[first]] += 1
    mean = total / (255 * np.maximum(count, 1)[:, None])
    return np.where(count[:, None] > 0, mean, 0.5).astype(np.float32)


def _pixels(points: Places, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], Places]:
    """Column, row and depth (n,) of points (n, 3); a depth of 0 where they are in no pixel of the camera."""
    inside = (points - camera.position) @ camera.c2w[:3, :3]
    lens = camera.intrinsics
    depth = -inside[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        place = lens.project(inside)
        held = (depth > 0) & (place >= 0).all(axis=1) & (place < (lens.width, lens.height)).all(axis=1)
    place = np.where(held[:, None], place, 0).astype(np.int64)
    return place[:, 0], place[:, 1], np.where(held, depth, 0.0)
