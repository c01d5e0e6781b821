"""The scene's region, in numbers only: an inner cube and, for photographs, background shells of doubling cells.

The inner cube is the smallest around ``aabb``. Each background shell reaches twice as far as the one inside it with cells
twice as large, so that cells look about equally large from the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.errors import InputError


@dataclass(frozen=True, eq=False)
class SceneBounds:
    """Where the scene is, in scene units.

    ``aabb`` (2, 3) float64, lowest and highest corner: the region of detail.
    ``background_cube`` (2, 3) or None: the larger cube, concentric with ``aabb``, that the background shells of
    photographs fill; None where the background is not part of the scene.
    ``has_alpha``: the images have transparent pixels, seen over whatever background is asked for.
    ``is_guess``: the cameras alone do not tell where the scene is.
    """

    aabb: NDArray[np.float64]
    background_cube: NDArray[np.float64] | None
    has_alpha: bool
    is_guess: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "aabb", check_box(self.aabb, "the scene's aabb"))
        if self.background_cube is not None:
            object.__setattr__(self, "background_cube", check_box(self.background_cube, "the background cube"))

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) the middle of the region of detail."""
        return self.aabb.mean(axis=0)

    @property
    def side(self) -> float:
        """Edge of the inner cube: the longest of the region of detail."""
        return float((self.aabb[1] - self.aabb[0]).max())

    @property
    def is_unbounded(self) -> bool:
        """Whether the background belongs to the scene, as in photographs: the scene has background shells."""
        return self.background_cube is not None

    @property
    def n_shells(self) -> int:
        """The number of background shells: how often the inner cube doubles to reach ``background_cube``; else 0."""
        if self.background_cube is None:
            return 0
        around = (self.background_cube[1] - self.background_cube[0]).max()
        return max(0, int(np.ceil(np.log2(around / self.side) - 1e-6)))

    def finest_levels(self, points: NDArray[np.float64], level: int) -> NDArray[np.int64]:
        """The finest level (n,) of an octree over inner cube and background shells at points (n, 3), scene units.

        ``level`` splits the inner cube into 2**level cells along an edge; each shell outwards has one level less.
        """
        distance = np.abs(points - self.center).max(1) / (self.side / 2)
        return level + self.n_shells - np.ceil(np.log2(np.maximum(distance, 1))).astype(np.int64)


def cube(center: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    """The corners (2, 3) of the cube around ``center`` (3,) with half its edge ``half``, scene units."""
    return np.stack([center - half, center + half])


def check_box(box: ArrayLike, what: str) -> NDArray[np.float64]:
    """The box (2, 3) float64 from (2, 3) or six numbers; InputError unless finite and not empty on any axis."""
    try:
        corners = np.asarray(box, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # ragged lists, text, whole numbers of hundreds of digits
        raise InputError(f"{what} must be two corners of three numbers, got {box!r:.60}") from None
    if corners.size != 6:
        raise InputError(f"{what} must be two corners of three numbers, got shape {corners.shape}")
    corners = corners.reshape(2, 3).copy()
    if not (np.abs(corners) < 1e15).all() or not (corners[0] < corners[1]).all():
        raise InputError(f"{what} must be finite with its first corner below the second, got {corners.tolist()}")
    return corners
