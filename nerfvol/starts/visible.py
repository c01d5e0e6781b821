"""Which leaves of an octree the views of a dataset need, and which leaves enough of them look at to tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.tiles import TileBank
from nerfvol.kernels import ops
from nerfvol.octree.rows import explin
from nerfvol.octree.tree import Octree

JUDGED_PIXELS = 200
"""Along the longer side of an image: what visibility and comparison need is seen in so many; ..."""
JUDGED_DOWNSCALE = 4
"""... but larger images are averaged by no more than this, lest what is thin goes unseen."""
ENOUGH_VIEWS = 20
"""Views that have a place in their picture before they can tell that nothing there is needed: what fewer see is often seen by
another view alone."""
SOLID = 0.2
"""Opacity from which a leaf of a given octree stays, whatever fewer views need."""
JUDGING_VIEWS = 25
"""Views that are asked, evenly chosen: of 100 views of an object the others changed nothing."""
_BLOCK = 3  # levels above a leaf: the middle of so large a cell stands for its leaves, for pictures change slowly


def judged_downscale(dataset: Dataset) -> int:
    """The factor by which images are averaged before leaves are judged by them: about JUDGED_PIXELS are left."""
    longest = max(max(c.intrinsics.width, c.intrinsics.height) for c in dataset.cameras)
    return min(JUDGED_DOWNSCALE, max(1, longest // JUDGED_PIXELS))


def needed(octree: Octree, dataset: Dataset, background: Sequence[float], weight: float) -> np.ndarray:
    """(n_leaves,) bool: all but leaves that :data:`ENOUGH_VIEWS` views or more have in their picture and of which no ray sees
    a share of ``weight``."""
    judged = views_of_leaves(octree, dataset.evenly(2 * JUDGING_VIEWS)) >= ENOUGH_VIEWS
    dataset = dataset.evenly(JUDGING_VIEWS)
    if weight <= 0 or not judged.any():
        return np.ones(octree.n_leaves, bool)
    return ~judged | (largest_weights(octree, dataset, background, judged_downscale(dataset)) >= weight)


def solid(octree: Octree) -> np.ndarray:
    """(n_leaves,) bool: leaves as opaque as SOLID along their side, at their densest corner."""
    return -np.expm1(-thickness(octree)) >= SOLID


def thickness(octree: Octree) -> np.ndarray:
    """(n_leaves,) optical thickness of each leaf along its side, at its densest corner."""
    densest = octree.density_scale * explin(octree.density[octree.corners].max(1))
    return densest * octree.leaf_sizes()


def views_of_leaves(octree: Octree, dataset: Dataset) -> np.ndarray:
    """(n_leaves,) in how many views' pictures a leaf lies, hidden or not; by the middle of the cell that it lies in."""
    if len(dataset) < ENOUGH_VIEWS:
        return np.full(octree.n_leaves, len(dataset))
    shift = np.minimum(octree.leaf_level.astype(np.int64), _BLOCK)
    levels, (x, y, z) = octree.leaf_level - shift, (octree.leaf_ijk >> shift[:, None]).T
    _, first, inverse = np.unique((levels << 48) + (x << 32) + (y << 16) + z, return_index=True, return_inverse=True)
    corners = np.stack([x, y, z], 1)[first]
    middles = octree.origin + (corners + 0.5) * (octree.size / 2.0 ** levels[first])[:, None]
    count = np.zeros(len(first), np.int64)
    for camera in dataset.cameras:
        pixels, lens = camera.project(middles), camera.intrinsics  # NaN, which is in no picture, behind the camera
        count += ((pixels >= 0) & (pixels < (lens.width, lens.height))).all(1)
    return count[inverse.reshape(-1)]


def largest_weights(octree: Octree, dataset: Dataset, background: Sequence[float], downscale: int) -> np.ndarray:
    """(n_leaves,) largest rendering weight of each leaf over the rays of the dataset at 1/downscale of its size.

    Tiles of 8 x 8 pixels that show the background alone are not asked: what only they see is haze.
    """
    bank = TileBank(dataset, background, downscale)
    statistics, options = ops.LeafStatistics(octree), ops.LossOptions(tuple(background), early_stop_eps=1e-3)
    for tiles in np.array_split(bank.foreground_tiles, max(1, len(bank.foreground_tiles) // 32)):
        # At this size of the images leaves are small, and what a tile leaves behind for the second phase is large: few
        # tiles at a time.
        batch = bank.batch(tiles, np.ones(len(tiles), dtype=np.float32))
        ops.leaf_statistics(octree, batch, options, bank.pixel_angle, statistics)
    return statistics.max_weight
