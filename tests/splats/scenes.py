"""Small scenes of splats, views of them and pictures to fit."""

from __future__ import annotations

import numpy as np

from nerfvol.cameras import look_at
from nerfvol.kernels import splat_ops
from nerfvol.kernels.splat_state import SplatView
from nerfvol.splats import Splats

BACKGROUND = (1.0, 0.5, 0.2)
ORIGIN = np.array([3.0, 1.0, 2.0])


def random_splats(n: int, basis: int, seed: int, mode: str = "mip", size: float = 0.15) -> Splats:
    """n overlapping splats in a cube of side 2 about the origin, of all shapes."""
    rng = np.random.default_rng(seed)
    return Splats(
        rng.uniform(-1, 1, (n, 3)),
        np.log(size) + rng.normal(0, 0.6, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(0, 1.5, n),
        rng.normal(0, 0.4, (n, 3, basis)),
        ORIGIN,
        mode,
    )


def special_splats(n: int, basis: int, seed: int, mode: str) -> Splats:
    """Random ones, some beside the picture, nearly opaque, thin discs, black in places, far smaller than a pixel."""
    s = random_splats(n, basis, seed, mode)
    s.means[:3] = [[-1.6, -1.9, 0.1], [1.9, -1.8, 0.3], [0.2, -1.9, 1.5]]  # slopes beyond 1.3 half-fields
    s.log_scales[:3] = np.log(0.5)
    s.log_scales[3:7], s.logits[3:7] = np.log(0.6), 9.0  # alpha is clamped near their middle
    s.log_scales[7:10, 1] = -9.0  # discs; seen edge on rho reaches its bound
    s.log_scales[10:12] = -6.5
    s.logits[10:12] = 8.0
    s.sh[12:16, :, 0] = -1.5  # colours below 0
    return s


def view_of_cube(width: int = 72, height: int = 48) -> SplatView:
    """From in front of the cube; neither centred nor square."""
    pose = look_at((0.3, -2.6, 0.7), (0, 0, 0.1))
    rotation = (pose[:3, :3] * (1, -1, -1)).T
    centre = (width / 2 + 3, height / 2 - 2)
    return SplatView(rotation, -rotation @ pose[:3, 3], 60.0, 64.0, *centre, width, height, 0.05)


def straight_view(width: int, height: int, focal: float = 100.0, near: float = 0.05) -> SplatView:
    """From the splats' origin along z."""
    return SplatView(np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height, near)


def random_image(view: SplatView, seed: int, masked: float = 0.0) -> np.ndarray:
    """Padded noise; a share ``masked`` of the pixels has weight 0, as many a weight between."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (view.height, view.width, 4)).astype(np.uint8)
    dice = rng.random((view.height, view.width))
    image[..., 3] = np.where(dice < masked, 0, np.where(dice < 2 * masked, image[..., 3], 255))
    return splat_ops.pad_image(image)
