"""Pictures of an octree: one view at a time, to PNG, EXR or MP4."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD, WHITE
from nerfvol.kernels import ops
from nerfvol.kernels.state import OUTPUTS, in_squares
from nerfvol.octree.tree import Octree

Float = NDArray[np.float32]


def render_image(
    octree: Octree,
    camera: Camera,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = OUTPUTS,
    lod: float = DEFAULT_LOD,
) -> dict[str, Float]:
    """One view: float32 arrays (H, W, 3) or (H, W) for the names in ``outputs`` (see ops.render_rays).

    ``rgb`` is not clipped. A node of the octree that is smaller than ``lod`` pixels in the middle of the picture stands in
    for its leaves; 0: none does. ValueError where ``lod`` is negative or not finite.
    """
    if not 0 <= lod < np.inf:
        raise ValueError(f"lod must be a number of pixels, 0 or more and finite, got {lod}")
    lens = camera.intrinsics
    view = ops.View(_directions(lens), camera.c2w, lens.height, lens.width)
    return ops.render_view(octree, view, background, early_stop_eps, outputs, lod / max(lens.fx, lens.fy))


@functools.lru_cache(maxsize=1)
def _directions(lens: Intrinsics) -> Float:
    """Unit directions in camera axes, as :class:`ops.View` has them. Kept for a path."""
    return in_squares(lens.directions())


def surface_depth(image: Mapping[str, Float]) -> Float:
    """Mean distance (H, W) of what a pixel sees, sum_i w_i t_i / opacity; 0 where the opacity is below 1e-3."""
    opacity = image["opacity"]
    return np.where(opacity > 1e-3, image["depth"] / np.maximum(opacity, 1e-3), 0.0).astype(np.float32)


def unit_normal(image: Mapping[str, Float]) -> Float:
    """The mean normal (H, W, 3) at unit length; zero where there is none."""
    normal = image["normal"]
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)


def depth_range(octree: Octree, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Nearest and farthest distance that a few of ``cameras`` see, to scale pictures of depth by.

    The 1st and 99th percentile of small renders, a tenth of their distance farther apart: single floaters do not count.
    Where nothing is seen, the distances at which leaves could be.
    """
    seen = []
    for camera in cameras[:: max(1, len(cameras) // 4)]:
        width = min(camera.intrinsics.width, 96)
        small = camera.resized(width, max(1, round(camera.intrinsics.height * width / camera.intrinsics.width)))
        image = render_image(octree, small, outputs=("depth", "opacity"))
        seen.append(surface_depth(image)[image["opacity"] >= 0.5])
    depths = np.concatenate(seen)
    if not len(depths):
        reach = octree.size * 3**0.5
        distances = [float(np.linalg.norm(camera.position - octree.origin - octree.size / 2)) for camera in cameras]
        return max(min(distances) - reach / 2, 0.0), max(distances) + reach / 2
    near, far = (float(value) for value in np.percentile(depths, (1, 99)))
    return max(near - 0.1 * (far - near), 0.0), far + 0.1 * (far - near)


# ------------------------------------------------------------------ the command
