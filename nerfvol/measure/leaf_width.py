"""How wide, in pixels, the leaves are that a picture of an octree consists of: whether finer ones could show more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.octree.tree import Octree
from nerfvol.views import render_image

VIEWS = 8
"""Views that are looked at, ..."""
LONGEST = 100
"""... by so many pixels along their longer side, about."""


def visible_widths(octree: Octree, cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Sides of the leaves at which half of a ray's light has been gathered, in pixels of the cameras' own pictures.

    One number for each ray that is half opaque, (n,), of thinned-out rays of VIEWS evenly chosen cameras.
    """
    widths = [np.empty(0)]
    for i in np.unique(np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int)):
        lens = cameras[i].intrinsics
        factor = min(max(1, -(-max(lens.width, lens.height) // LONGEST)), lens.width, lens.height)
        camera = cameras[i].scaled(factor)
        distance = render_image(octree, camera, outputs=("median_depth",), lod=0.0)["median_depth"].reshape(-1, 1)
        origin, directions = camera.rays()
        opaque = distance[:, 0] > 0
        leaf = octree.query(origin + directions[opaque].astype(np.float64) * distance[opaque])
        found = leaf >= 0  # a point on a face may round to where nothing is
        side = octree.size / 2.0 ** octree.leaf_level[leaf[found]]
        widths.append(side * max(lens.fx, lens.fy) / distance[opaque, 0][found])
    return np.concatenate(widths)
