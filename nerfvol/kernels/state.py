"""What goes into a training step and what lives between two: plain data that ops.py checks and the kernels work on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nerfvol.defaults import DEFAULT_EARLY_STOP, WHITE
from nerfvol.native import aligned, aligned_empty
from nerfvol.octree.tree import Octree

OUTPUTS = ("rgb", "opacity", "depth", "median_depth", "normal")
"""What can be rendered, in the order of the kernels' arguments."""
TILE_RAYS = 64
"""Rays of a packet that share their origin."""
SQUARE = 16
"""Pixels along a square of a view: what the kernels render as one packet."""


@dataclass(frozen=True)
class View:
    """A camera's picture of height x width pixels.

    directions: (square rows, square columns, 4, 3, 64) float32 unit directions in camera axes, see :func:`in_squares`;
    camera_to_world: (4, 4), or (3, 4).
    """

    directions: np.ndarray
    camera_to_world: np.ndarray
    height: int
    width: int


def in_squares(picture: np.ndarray) -> np.ndarray:
    """A picture (H, W, k) by squares of 16x16 pixels: (square rows, square columns, 4, k, 64), contiguous.

    A square is four strips of 4 rows; in a strip 2x2 pixels that touch are stored next to each other (csrc/packet.h).
    Squares that reach beyond the picture are filled by repeating its last row and column.
    """
    padding = ((0, -picture.shape[0] % SQUARE), (0, -picture.shape[1] % SQUARE), (0, 0))
    padded = np.pad(picture, padding, mode="edge") if padding != ((0, 0),) * 3 else picture
    rows, columns = (n // SQUARE for n in padded.shape[:2])
    parts = padded.reshape(rows, 4, 2, 2, columns, 8, 2, -1).transpose(0, 4, 1, 7, 2, 5, 3, 6)
    return np.ascontiguousarray(parts).reshape(rows, columns, 4, -1, 64)


def from_squares(squares: np.ndarray, height: int, width: int) -> np.ndarray:
    """The picture (height, width, k) in ``squares``: the inverse of :func:`in_squares`."""
    rows, columns = squares.shape[:2]
    parts = squares.reshape(rows, columns, 4, -1, 2, 8, 2, 2).transpose(0, 2, 4, 6, 1, 5, 7, 3)
    return parts.reshape(SQUARE * rows, SQUARE * columns, -1)[:height, :width]


@dataclass(frozen=True)
class Batch:
    """Tiles of training rays. rays_o (n_tiles, 3); rays_d, target (64 n_tiles, 3); weight (64 n_tiles,), 0 = padding."""

    rays_o: np.ndarray
    rays_d: np.ndarray
    target: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class LossOptions:
    """Weights of the loss's terms, see reference.loss for the formula; fields reach the kernels by their names.

    background: three floats behind the octree; colour: of what each segment misses the target by; distortion: of
    Mip-NeRF 360's loss; sparsity: of the logarithms of the segments' weights; tv_density, tv_sh: of the differences
    between a leaf's corners, in raw density and in SH coefficients; early_stop_eps: a ray ends when its transmittance
    falls below.
    """

    background: Sequence[float] = WHITE
    colour: float = 0.0
    distortion: float = 0.0
    sparsity: float = 0.0
    tv_density: float = 0.0
    tv_sh: float = 0.0
    early_stop_eps: float = DEFAULT_EARLY_STOP


@dataclass(frozen=True)
class Rates:
    """RMSprop: value -= rate * g / (sqrt(m) + eps), m the running mean of g^2 (started with the first g^2).

    density, dc, sh: rates of raw densities, of the constant SH coefficients and of the others; beta: share of the old
    mean in the new. Fields reach the kernels by their names.
    """

    density: float
    dc: float
    sh: float
    beta: float = 0.98
    eps: float = 1e-8


@dataclass(frozen=True)
class StepReport:
    """squared_error: weighted mean over rays and channels; samples: segments per ray; tested: leaves per 64 rays whose boxes
    the kernels tested against rays, which a walk that culls well keeps near those met (0: the reference has no packets)."""

    squared_error: float
    samples: float
    tested: float = field(default=0.0, kw_only=True)


class LeafStatistics:
    """What the rays of one batch or several say of each leaf: float32 arrays (n_leaves,), updated in place.

    max_weight: largest rendering weight; error: sum of weight x squared error; footprint: largest size in pixels, 0
    where no ray met the leaf; all since :meth:`reset_statistics`.
    """

    def __init__(self, octree: Octree):
        self.reset_statistics(octree.n_leaves)

    def check(self, octree: Octree) -> None:
        """ValueError unless every array fits the octree: the kernels write to them without looking."""
        for name in ("max_weight", "error", "footprint"):
            self._check_array(name, (octree.n_leaves,), np.float32)

    def reset_statistics(self, n_leaves: int) -> None:
        """Begins again, for an octree of ``n_leaves``."""
        self.max_weight, self.error, self.footprint = (np.zeros(n_leaves, np.float32) for _ in range(3))

    def _check_array(self, name: str, shape: tuple[int, ...], dtype: type) -> None:
        a = getattr(self, name)
        if a.shape != shape or a.dtype != dtype or not a.flags.c_contiguous:
            raise ValueError(f"training state: {name} must be {np.dtype(dtype)} {shape}, got {a.dtype} {a.shape}")


class TrainState(LeafStatistics):
    """What training keeps next to the octree: the leaves' statistics, and second moments (n_vertices, row) float32."""

    def __init__(self, octree: Octree, moments: np.ndarray | None = None):
        """Moments are zero where none are given; ValueError where those given do not fit the octree."""
        super().__init__(octree)
        if moments is None:
            moments = aligned_empty(octree.values.shape, np.float32)
            moments[:] = 0
        self.moments = aligned(moments, np.float32)
        self.slots = np.full(octree.n_vertices, -1, np.int32)  # the kernels' scratch, all -1 between steps
        self.check(octree)

    def check(self, octree: Octree) -> None:
        """As for :class:`LeafStatistics`."""
        self._check_array("moments", octree.values.shape, np.float32)
        self._check_array("slots", (octree.n_vertices,), np.int32)
        super().check(octree)

    def level_moments(self, share: float) -> None:
        """After a first step: sets every second moment to ``share`` of its column's mean over the vertices that were touched.

        A vertex's own first gradient would make its first step as long as any, however small it is; where a run has few
        steps, those of vertices that hardly matter are noise.
        """
        touched = self.moments > 0
        mean = self.moments.sum(0, dtype=np.float64) / np.maximum(touched.sum(0), 1)
        self.moments[:] = share * mean
