"""What a field's arrays mean: its region, the levels of its hash grid, its layers, its steps. Numbers only, no torch.

The compiled field (``nerfvol.kernels.field_state``) and the one in torch (``nerfvol.field.fields``) share all of it, so that
the arrays of one are those of the other.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

    from nerfvol.config.field import FieldShape

BRICK = (2, 2, 4)
"""Vertices of a brick along x, y, z: what a finer level hashes, and stores in a row."""
BRICK_ENTRIES = 16
GROUP = 8
"""Steps come in whole groups of so many: what is tested at once against the coarse occupancy grid."""


@dataclass(frozen=True)
class Domain:
    """The region a field covers: an inner cube and, around it, as much contracted background as ``outer`` asks for.

    center (3,), half: the inner cube is center +- half, in scene units.
    outer: half edge of the whole region in units of ``half``; 1 = there is nothing outside the inner cube.
    """

    center: tuple[float, float, float]
    half: float
    outer: float = 1.0

    @property
    def aabb(self) -> Tensor:
        """(2, 3) float32: the whole region."""
        import torch

        center = torch.tensor(self.center)
        return torch.stack([center - self.half * self.outer, center + self.half * self.outer])

    @property
    def cubes(self) -> int:
        """Cubes of an occupancy grid, each twice as large as the one before, until they hold the region."""
        return 1 + max(0, math.ceil(math.log2(self.outer) - 1e-6))

    def scaled(self, positions: Tensor) -> Tensor:
        """Scene positions (..., 3) in units of the inner cube, which becomes [-1, 1]**3."""
        return (positions - positions.new_tensor(self.center)) / self.half

    def contract(self, positions: Tensor) -> Tensor:
        """Scene positions (..., 3) to [-1, 1]**3, each axis alone: linear in the inner cube, x -> 2 - 1/x outside.

        The contraction of Reiser (2023); with ``outer`` = 1 it is a plain scaling. Positions outside the whole region land
        on its faces.
        """
        import torch

        x = self.scaled(positions)
        if self.outer <= 1:
            return x.clamp(-1, 1)
        size = x.abs()
        bent = torch.where(size <= 1, x, x.sign() * (2 - 1 / size.clamp(min=1)))
        return (bent / (2 - 1 / self.outer)).clamp(-1, 1)


class PointField(Protocol):
    """A field at points, in numpy: what an octree is distilled from. ``has_sh``: it gives spherical harmonics."""

    has_sh: bool

    def __call__(self, positions: np.ndarray, viewdirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) scene positions and (n, 3) unit directions -> sigma (n,) >= 0 in 1/u, rgb (n, 3)."""
        ...

    def density(self, positions: np.ndarray) -> np.ndarray:
        """(n, 3) -> sigma (n,)."""
        ...

    def sh(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) -> sigma (n,), sh (n, 3, (degree + 1)**2), where ``has_sh``."""
        ...


@dataclass(frozen=True)
class GridLevels:
    """Levels of a hash grid: cells along an edge, and where each level's entries begin (the last start: how many there are).

    The first ``n_dense`` levels store every vertex, z fastest. The others hash bricks of 2 x 2 x 4 vertices, whose 16 entries
    follow each other: a cell's corners then lie on few cache lines. Levels begin at whole bricks.
    """

    resolutions: tuple[int, ...]
    starts: tuple[int, ...]
    n_dense: int
    bricks: int

    @classmethod
    def of(cls, n_levels: int, log2_table: int, n_min: int, n_max: int) -> GridLevels:
        """``n_levels`` of n_min to n_max cells, growing geometrically, at most 2**log2_table entries each.

        Raises:
            ValueError: there is no such grid.
        """
        if n_levels < 1 or n_max < n_min or n_min < 1:
            raise ValueError(f"need n_levels >= 1 and 1 <= n_min <= n_max, got {n_levels}, {n_min}, {n_max}")
        growth = math.log(n_max / n_min) / max(n_levels - 1, 1)
        # The tiny relative excess keeps an exact n_max from being rounded down to n_max - 1.
        resolutions = [int(n_min * math.exp(growth * level) * (1 + 1e-9)) for level in range(n_levels)]
        starts = [0]
        for n in resolutions:
            entries = min((n + 1) ** 3, 1 << log2_table)
            starts.append(starts[-1] + -(-entries // BRICK_ENTRIES) * BRICK_ENTRIES)
        n_dense = sum((n + 1) ** 3 <= 1 << log2_table for n in resolutions)
        return cls(tuple(resolutions), tuple(starts), n_dense, max(1, (1 << log2_table) // BRICK_ENTRIES))


class Layer(NamedTuple):
    """A fully connected layer: inputs, outputs, whether a ReLU follows, and what its input ends with besides what the layer
    before made: 0 nothing, 1 the encoded position again, 2 the encoded direction."""

    inputs: int
    outputs: int
    relu: bool
    extra: int

    @property
    def numbers(self) -> int:
        """Weights (outputs, inputs) and biases."""
        return self.outputs * (self.inputs + 1)


def frequency_dim(n_frequencies: int) -> int:
    """Numbers of the frequency encoding of a position or direction."""
    return 3 * (1 + 2 * n_frequencies)


def layers_of(shape: FieldShape) -> list[Layer]:
    """Trunk, head and, with an rgb head, the two layers of colours; in the order of a field's parameters in torch."""
    hashed = shape.encoding == "hash"
    encoded = shape.hash_levels * shape.hash_features if hashed else frequency_dim(shape.n_frequencies)
    layers = [Layer(encoded, shape.width, True, 0)]
    for i in range(1, shape.depth):
        again = bool(shape.skip) and i == shape.skip
        layers.append(Layer(shape.width + (encoded if again else 0), shape.width, True, int(again)))
    if shape.head == "sh":
        return [*layers, Layer(shape.width, 1 + 3 * (shape.sh_degree + 1) ** 2, False, 0)]
    hidden = max(shape.width // 2, 16)
    colours = Layer(shape.width + frequency_dim(shape.n_frequencies_dir), hidden, True, 2)
    return [*layers, Layer(shape.width, 1 + shape.width, False, 0), colours, Layer(hidden, 3, False, 0)]


@functools.lru_cache(maxsize=32)
def step_edges(domain: Domain, n_steps: int) -> tuple[tuple[float, ...], float]:
    """Edges of the marching steps, as distances from where a ray enters the domain, and the length of the first.

    Steps are equal in a bounded scene (``n_steps`` along its diagonal); with a background they grow with the distance.
    """
    step = 2 * math.sqrt(3) * domain.half / n_steps
    reach = 2 * math.sqrt(3) * domain.half * max(domain.outer, 1.0)
    edges, t = [0.0], 0.0
    growth = 0.0 if domain.outer <= 1 else 4.0 / n_steps
    while t < reach + step or (len(edges) - 1) % GROUP:  # whole groups, beyond the longest ray
        t += max(step, growth * t)
        edges.append(t)
    return tuple(edges), step
