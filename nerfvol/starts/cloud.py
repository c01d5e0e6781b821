"""A point cloud becomes Gaussians to train: how large they begin, and which points would spoil the training.

A Gaussian that is large before a lens reaches opacity 0.99 in some view, where no gradient passes, and hides everything
for good: twelve such of 22,600 kept a run at 13.9 dB. So points right before cameras are left out, and no Gaussian begins
larger than a share of its distance to the nearest camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras import Camera
from nerfvol.errors import InputError
from nerfvol.splats.neighbours import nearest
from nerfvol.splats.points import PointCloud, dc_of_colour, logit, spacing
from nerfvol.splats.splats import Splats

OPACITY = 0.5
NEIGHBOURS = 3
LARGEST_SHARE = 0.06
"""Of the distance to the nearest camera: the largest scale at the start."""
NEAREST_SHARE = 0.08
"""Of the subject's distance: nothing begins nearer to a camera."""
_SMALLEST_SHARE = 1e-4  # of the distance to the nearest camera: points at one place still get a size, about 0.1 pixels


def splats_of_cloud(
    cloud: PointCloud,
    cameras: Sequence[Camera],
    subject_distance: float,
    degree: int = 1,
    mode: Literal["mip", "plain"] = "mip",
    opacity: float = OPACITY,
) -> Splats:
    """Gaussians that training begins with, one a point that is not right before a camera, in the cloud's order.

    Their scales are the root mean square distance to the 3 nearest points that are kept, within the limits above; they are
    balls of opacity 0.5 and of the points' colours from all sides.

    Args:
        subject_distance: the median camera's distance to the subject, scene units (starts/subject.py).
        degree: of the spherical harmonics, 0 to 3; higher bands begin at 0.

    Raises:
        InputError: no point is left.
    """
    to_camera = camera_distance(cloud.positions, cameras)
    kept = to_camera >= NEAREST_SHARE * subject_distance
    if not kept.any():
        raise InputError(
            f"none of {len(cloud)} starting points can be used: all are nearer to a camera than {NEAREST_SHARE:g} of the "
            f"subject's distance, {NEAREST_SHARE * subject_distance:.3g}"
        )
    positions, to_camera = cloud.positions[kept], to_camera[kept]
    size = spacing(positions, NEIGHBOURS)
    size = np.where(np.isfinite(size), size, np.inf)  # a single point is as large as it may be
    size = np.clip(size, _SMALLEST_SHARE * to_camera, LARGEST_SHARE * to_camera)
    n = len(positions)
    sh = np.zeros((n, 3, (degree + 1) ** 2), np.float32)
    sh[:, :, :1] = dc_of_colour(cloud.colours[kept])
    quats = np.zeros((n, 4), np.float32)
    quats[:, 0] = 1
    origin = np.median(positions, axis=0)
    return Splats(
        means=(positions - origin).astype(np.float32), log_scales=np.repeat(np.log(size)[:, None], 3, 1).astype(np.float32),
        quats=quats, logits=np.full(n, logit(opacity), np.float32), sh=sh, origin=origin, mode=mode,
    )  # fmt: skip


def camera_distance(positions: NDArray[np.float64], cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """(n,) distances of points (n, 3) to the nearest camera."""
    centres = np.stack([camera.position for camera in cameras])
    return np.sqrt(nearest(centres, 1, positions)[0][:, 0])
