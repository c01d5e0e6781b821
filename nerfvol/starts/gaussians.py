"""An octree as Gaussians to be drawn as they are: each visible leaf an isotropic one that stops as much light along its side.

Standard deviation 0.4 h of a leaf's side h: 2 pi sigma^2 = h^2, so the optical depth that a leaf's face carries is kept.
Opacity 1 - exp(-sigma_t h); spherical harmonics as in the middle of the leaf. Soft where leaves are smaller than pixels:
write the level whose leaves are 2 to 6 pixels wide. Surfaces and fog alike: a disc for a leaf (starts/surfels.py) is for a
training of splats to begin with, and shows fog 19 dB worse (docs/export.md has the figures).
"""

from __future__ import annotations

import numpy as np

from nerfvol.errors import InputError
from nerfvol.octree.lod import simplified
from nerfvol.octree.points import at_leaves, leaf_density
from nerfvol.octree.tree import Octree
from nerfvol.splats.splats import Splats

DEVIATION = 0.4
"""Of a Gaussian, in sides of its leaf; 1/sqrt(2 pi)."""
FAINTEST = 1 / 255
"""Opacity below which no rasteriser draws a Gaussian."""
_LARGEST = 0.999  # opacity, so that its logit is finite


def splats_of_leaves(octree: Octree, most: int | None = None) -> Splats:
    """See the module's head; of the finest level that has at most ``most`` visible leaves.

    Raises:
        InputError: no leaf can be seen, or more than ``most`` even at level 1.
    """
    splats = _of_leaves(octree)
    level = octree.max_level
    while most is not None and splats.n > most:
        level -= 1
        if level < 1:
            raise InputError(f"at most {most} splats were asked for: this octree has {splats.n} even at level 1")
        splats = _of_leaves(simplified(octree, level))
    return splats


def _of_leaves(octree: Octree) -> Splats:
    side = octree.leaf_sizes()
    opacity = -np.expm1(-leaf_density(octree) * side)
    seen = np.flatnonzero(opacity > FAINTEST)
    if not len(seen):
        raise InputError("no leaf of this octree is dense enough to be seen as a Gaussian")
    alpha, side = np.minimum(opacity[seen], _LARGEST), side[seen]
    middle = octree.origin + octree.size / 2
    return Splats(
        means=(octree.leaf_centers()[seen] - middle).astype(np.float32),
        log_scales=np.repeat(np.log(DEVIATION * side)[:, None], 3, axis=1).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(seen), 1)),
        logits=np.log(alpha / (1 - alpha)).astype(np.float32),
        sh=at_leaves(octree, octree.sh)[seen].astype(np.float32),
        origin=middle,
        mode="plain",
    )
