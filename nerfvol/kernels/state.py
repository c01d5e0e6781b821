"""What goes into a training step and what lives between two: plain data that ops.py checks and the kernels work on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfvol.native import aligned, aligned_empty
from nerfvol.octree import Octree
from nerfvol.settings import DEFAULT_EARLY_STOP, WHITE


@dataclass(frozen=True)
class View:
    """A camera's picture of height x width pixels.

    directions: (tile rows, tile columns, 3, 64) float32 unit directions in camera axes, a row of 64 for each 8x8 tile;
    tiles at the right and lower edge may reach beyond the picture. camera_to_world: (4, 4), or (3, 4).
    """

    directions: np.ndarray
    camera_to_world: np.ndarray
    height: int
    width: int


@dataclass(frozen=True)
class Batch:
    """Tiles of training rays. rays_o (n_tiles, 3); rays_d, target (64 n_tiles, 3); weight (64 n_tiles,), 0 = padding."""

    rays_o: np.ndarray
    rays_d: np.ndarray
    target: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class LossOptions:
    """See reference.loss for the formula."""

    background: Sequence[float] = WHITE
    colour: float = 0.0
    distortion: float = 0.0
    early_stop_eps: float = DEFAULT_EARLY_STOP


@dataclass(frozen=True)
class Rates:
    """RMSprop: value -= rate * g / (sqrt(m) + eps), m the running mean of g^2 (started with the first g^2)."""

    density: float
    dc: float
    sh: float
    beta: float = 0.98
    eps: float = 1e-8


@dataclass(frozen=True)
class StepReport:
    """squared_error: weighted mean over rays and channels; samples: segments per ray."""

    squared_error: float
    samples: float


class TrainState:
    """What training keeps beside the octree: second moments (n_vertices, row) and statistics of the leaves (n_leaves,).

    max_weight: largest rendering weight; error: sum of weight x squared error; footprint: largest size in pixels; all
    since :meth:`reset_statistics`.
    """

    def __init__(self, octree: Octree, moments: np.ndarray | None = None):
        if moments is None:
            moments = aligned_empty(octree.values.shape, np.float32)
            moments[:] = 0
        self.moments = aligned(moments, np.float32)
        self.slots = np.full(octree.n_vertices, -1, np.int32)
        self.reset_statistics(octree.n_leaves)
        self.check(octree)

    def check(self, octree: Octree) -> None:
        """ValueError unless every array fits the octree: the kernels write to them without looking."""
        leaves = (octree.n_leaves,)
        for name, shape in (
            ("moments", octree.values.shape),
            ("slots", (octree.n_vertices,)),
            ("max_weight", leaves),
            ("error", leaves),
            ("footprint", leaves),
        ):
            a, dtype = getattr(self, name), np.int32 if name == "slots" else np.float32
            if a.shape != shape or a.dtype != dtype or not a.flags.c_contiguous:
                raise ValueError(f"training state: {name} must be {np.dtype(dtype)} {shape}, got {a.dtype} {a.shape}")

    def reset_statistics(self, n_leaves: int) -> None:
        self.max_weight, self.error, self.footprint = (np.zeros(n_leaves, np.float32) for _ in range(3))
