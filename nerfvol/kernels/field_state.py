"""What goes into drawing and training a compiled field, and what lives between two steps: plain data.

The kernels work on it; field_ops.py checks it. The arrays are those of ``nerfvol.field.fields`` in torch, flattened
(``field_reference.as_field``).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.defaults import WHITE
from nerfvol.field.layout import GROUP, Domain, GridLevels, layers_of, step_edges
from nerfvol.native import aligned, aligned_empty, native

if TYPE_CHECKING:
    from nerfvol.config.field import FieldShape

Float = NDArray[np.float32]
COARSE = 4
"""Cells along an edge of a coarse cell."""


@dataclass(frozen=True)
class FieldLoss:
    """Weights of the loss's terms, see field_reference.loss. A ray ends with the sample behind which T < early_stop_eps.

    negligible: share of the mean gradient of a chunk's samples below which one takes part with a probability in proportion and
    counts so much more, so that gradients are exact on average [Russian roulette, Arvo and Kirk 1990]. 0: all take part.
    """

    background: tuple[float, float, float] = WHITE
    colour: float = 0.0
    distortion: float = 0.0
    entropy: float = 0.0
    early_stop_eps: float = 1e-3
    negligible: float = 0.0


@dataclass(frozen=True)
class FieldRates:
    """Adam: value -= rate m / (1 - beta1^n) / (sqrt(v / (1 - beta2^n)) + eps), n the number of updates of the level or network.

    table_decay, network_decay: times the value, added to the gradient of what has one. Numbers without a gradient stay as
    they are, moments included.
    """

    rate: float = 0.01
    beta1: float = 0.9
    beta2: float = 0.99
    eps: float = 1e-15
    table_decay: float = 0.0
    network_decay: float = 0.0


@dataclass(frozen=True)
class FieldBatch:
    """Rays of a step: rays_o, rays_d (unit), target (n, 3) float32; jitter (n,) in [0, 1), shift of a ray's steps, in steps."""

    rays_o: Float
    rays_d: Float
    target: Float
    jitter: Float


@dataclass(frozen=True)
class FieldStepReport:
    """loss: all terms; squared_error: mean over rays and channels; samples: evaluated; used: before their rays ended."""

    loss: float
    squared_error: float
    samples: int
    used: int


class FieldState:
    """A field in training.

    table (entries, features), network (n,): values; each with ``_first``, ``_second`` (Adam's moments) and ``_gradient`` of
    the same shape, float32. updates (levels + 1,) int64: Adam's, of each level and of the network. All zero but the values,
    which are drawn from ``seed`` as torch draws a field's.

    domain: the field's region; shape: what the network looks like.
    """

    ARRAYS = tuple(f"{name}{part}" for name in ("table", "network") for part in ("", "_first", "_second", "_gradient"))

    table: Float
    table_first: Float
    table_second: Float
    table_gradient: Float
    network: Float
    network_first: Float
    network_second: Float
    network_gradient: Float

    def __init__(self, domain: Domain, shape: FieldShape, seed: int = 0) -> None:
        shape = shape.settled()  # what a file says of it is exact
        self.domain, self.shape = domain, shape
        self.layers = layers_of(shape)
        self.levels: GridLevels | None = None
        if shape.encoding == "hash":
            self.levels = GridLevels.of(shape.hash_levels, shape.log2_table, shape.hash_min, shape.finest)
        rng = np.random.Generator(np.random.Philox(seed))
        self.table = aligned_empty((self.levels.starts[-1] if self.levels else 0, shape.hash_features), np.float32)
        self.table[...] = rng.uniform(-1e-4, 1e-4, self.table.shape)
        numbers = []
        for layer in self.layers:  # biases begin at zero [He et al. 2015]
            numbers += [rng.uniform(-1, 1, layer.outputs * layer.inputs) * math.sqrt(6 / layer.inputs)]
            numbers += [np.zeros(layer.outputs)]
        self.network = aligned(np.concatenate(numbers), np.float32)
        for name in ("table", "network"):
            for part in ("_first", "_second", "_gradient"):
                zeros = aligned_empty(getattr(self, name).shape, np.float32)
                zeros[...] = 0
                setattr(self, name + part, zeros)
        self.updates = np.zeros(self.n_levels + 1, np.int64)

    def use_levels(self, n: int) -> None:
        """Only the ``n`` coarsest levels of the grid from now on: the others' features are zero, and nothing moves them."""
        self.kernel_shape.use_levels(n)

    @property
    def n_levels(self) -> int:
        """Of the hash grid; 0 where there is none."""
        return len(self.levels.resolutions) if self.levels else 0

    def array(self, name: str) -> Float:
        """One of ARRAYS, flat (n,); not copied."""
        return getattr(self, name).reshape(-1)

    def arrays(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps, not copied."""
        return {name: getattr(self, name) for name in self.ARRAYS} | {"updates": self.updates}

    def load_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Continue from what :meth:`arrays` gave, by copies; ValueError where one has another shape or dtype, KeyError where
        it is missing."""
        for name in (*self.ARRAYS, "updates"):
            mine, given = getattr(self, name), np.asarray(arrays[name])
            if given.shape != mine.shape or given.dtype != mine.dtype:
                raise ValueError(
                    f"field state: {name} must be {mine.dtype} {mine.shape}, got {given.dtype} {given.shape}"
                )
            mine[...] = given

    @property
    def nbytes(self) -> int:
        """Of the values alone."""
        return self.table.nbytes + self.network.nbytes

    @functools.cached_property
    def kernel_shape(self) -> Any:
        """The same as the kernels' class."""
        compiled, shape, domain = native(), self.shape, self.domain
        assert compiled is not None
        out = compiled.FieldShape()
        if self.levels is not None:
            grid = self.levels
            out.grid(list(grid.resolutions), list(grid.starts), shape.hash_features, grid.n_dense, grid.bricks)
        else:
            out.frequencies(shape.n_frequencies)
        head = len(self.layers) - (1 if shape.head == "sh" else 3)
        degree = shape.sh_degree if shape.head == "sh" else 0
        out.network([tuple(layer) for layer in self.layers], head, shape.head == "sh", degree, shape.n_frequencies_dir)
        scale = 1 / (2 * domain.half)
        out.domain(
            list(domain.center), domain.half, domain.outer, scale, shape.density_bias, shape.density == "softplus"
        )
        return out


class Occupancy:
    """Cells that may hold something, bit by bit: a stack of cubes around the inner cube, each twice as large as the one before.

    sigmas (cubes * resolution**3,) float32, 1/u: the largest coefficient remembered of each cell. occupied, coarse: bits of
    cells and of groups of 4**3 cells, dilated by one group, uint64. In the beginning everything is occupied.
    """

    def __init__(self, domain: Domain, resolution: int) -> None:
        self.domain, self.resolution, self.cubes = domain, resolution, domain.cubes
        self.cell_edges = 2 * domain.half / resolution * 2.0 ** np.arange(self.cubes)
        cells = self.cubes * resolution**3
        self.sigmas = np.zeros(cells, np.float32)
        self.occupied = np.full(-(-cells // 64), ~np.uint64(0))
        self.coarse = np.full(-(-(cells // COARSE**3) // 64), ~np.uint64(0))

    @classmethod
    def of_bits(cls, domain: Domain, resolution: int, occupied: NDArray[np.uint64]) -> Occupancy:
        """The grid whose bits are ``occupied``, to draw with: it remembers no coefficients.

        Raises ValueError where there are more or fewer bits than cells.
        """
        out = cls(domain, resolution)
        if occupied.shape != out.occupied.shape:
            raise ValueError(f"occupancy: expected {out.occupied.shape} words of bits, got {occupied.shape}")
        compiled = native()
        assert compiled is not None
        out.sigmas[...] = np.unpackbits(occupied.view(np.uint8), bitorder="little")[: len(out.sigmas)]
        limits = np.full(out.cubes, 0.5, np.float32)
        compiled.field_refresh(out.sigmas, limits, resolution, out.occupied, out.coarse)
        out.sigmas[...] = 0
        return out

    def refresh(self, most: float = 0.02) -> None:
        """Derive the bits: a cell is occupied while its optical thickness is above ``most`` and above half the mean of all."""
        compiled = native()
        assert compiled is not None
        per_cube = self.sigmas.reshape(self.cubes, -1).mean(1, dtype=np.float64)
        threshold = min(most, 0.5 * float((per_cube * self.cell_edges).mean()))
        limits = (threshold / self.cell_edges).astype(np.float32)
        compiled.field_refresh(self.sigmas, limits, self.resolution, self.occupied, self.coarse)

    def thickest(self) -> float:
        """The largest optical thickness of a cell."""
        return float((self.sigmas.reshape(self.cubes, -1).max(1) * self.cell_edges).max())

    def held(self) -> NDArray[np.int64]:
        """(n,) numbers of the occupied cells, in order."""
        words = np.flatnonzero(self.occupied)
        bits = np.flatnonzero(np.unpackbits(self.occupied[words].view(np.uint8), bitorder="little").view(bool))
        cells = 64 * words[bits >> 6] + (bits & 63)
        return cells[cells < len(self.sigmas)]

    def cells(self) -> NDArray[np.bool_]:
        """(cubes, r, r, r) whether each cell is occupied."""
        bits = np.unpackbits(self.occupied.view(np.uint8), bitorder="little")[: len(self.sigmas)]
        return bits.astype(bool).reshape(self.cubes, self.resolution, self.resolution, self.resolution)

    @property
    def fraction(self) -> float:
        """Occupied share of the cells of the inner cube."""
        return float(self.cells()[0].mean())

    def positions(self, cells: NDArray[np.int64], inside: Float, size: int = 1) -> Float:
        """Scene positions (n, 3) of points at ``inside`` (n, 3) in [0, 1) of blocks of size**3 cells, of which ``cells`` (n,)
        is the lowest."""
        r = self.resolution
        out = np.multiply(inside, size, dtype=np.float32)
        within = (cells % r**3).astype(np.int32)
        for axis, stride in enumerate((r * r, r, 1)):
            out[:, axis] += within // stride % r
        out *= 2 / r
        out -= 1
        out *= (self.domain.half * 2.0 ** (cells // r**3)).astype(np.float32)[:, None]
        out += np.array(self.domain.center, np.float32)
        return out

    def note(self, cells: NDArray[np.int64], sigmas: Float, decay: float = 0.8) -> None:
        """A cell that was looked at keeps max(decay * old, largest seen); cells may repeat."""
        self.sigmas[cells] = self.sigmas[cells] * np.float32(decay)  # repeated cells write the same number
        np.maximum.at(self.sigmas, cells, sigmas)

    def note_blocks(self, sigmas: Float, decay: float = 0.8) -> None:
        """The same of all cells at once: ``sigmas`` (cubes * (r / 2)**3,) was seen in each block of 2**3 cells."""
        r = self.resolution
        of_cells = self.sigmas.reshape(self.cubes, r // 2, 2, r // 2, 2, r)  # whole rows: loops of two are slow
        of_cells *= np.float32(decay)
        rows = np.repeat(sigmas, 2).reshape(self.cubes, r // 2, 1, r // 2, 1, r)
        np.maximum(of_cells, rows, out=of_cells)

    def blocks(self) -> NDArray[np.int64]:
        """(cubes * (r / 2)**3,) the lowest cell of each block of 2**3, in order."""
        r = self.resolution
        cube, place = np.arange(self.cubes)[:, None, None, None], np.arange(0, r, 2)
        return (cube * r**3 + place[:, None, None] * r**2 + place[:, None] * r + place).reshape(-1)

    def state_dict(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps, not copied: sigmas, occupied, coarse."""
        return {name: getattr(self, name) for name in ("sigmas", "occupied", "coarse")}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """The inverse, by copies; ValueError where an array does not fit."""
        for name in ("sigmas", "occupied", "coarse"):
            mine, given = getattr(self, name), np.asarray(state[name])
            if given.shape != mine.shape or given.dtype != mine.dtype:
                raise ValueError(
                    f"occupancy: {name} must be {mine.dtype} {mine.shape}, got {given.dtype} {given.shape}"
                )
            mine[...] = given


@dataclass(frozen=True)
class March:
    """Steps of rays through occupied cells. n_steps: along the diagonal of the inner cube; near_plane: nothing nearer to a
    ray's origin is looked at, in u; coarse: whether groups of steps are tested first, which changes no result."""

    occupancy: Occupancy
    n_steps: int
    near_plane: float = 0.0
    coarse: bool = True

    @property
    def edges(self) -> Float:
        """(n + 1,) distances from where a ray enters, u."""
        return np.array(step_edges(self.occupancy.domain, self.n_steps)[0], np.float32)

    @functools.cached_property
    def kernel(self) -> Any:
        """The same as the kernels' class, which reads the occupancy's own bits."""
        compiled, where, domain = native(), self.occupancy, self.occupancy.domain
        assert compiled is not None
        edges, step = step_edges(domain, self.n_steps)
        group = GROUP
        if (
            where.cubes == 1
        ):  # half a group must not be longer than a coarse cell; with more cubes, a larger one's serve
            while group > 1 and group * step / 2 > COARSE * where.cell_edges[0]:
                group //= 2
        coarse = where.coarse if self.coarse else np.full_like(where.coarse, ~np.uint64(0))
        return compiled.FieldMarch(
            np.array(edges, np.float32), group, step, self.near_plane, where.occupied, coarse, where.resolution,
            where.cubes,
        )  # fmt: skip

    def with_steps(self, n_steps: int) -> March:
        """The same with other steps."""
        return self if n_steps == self.n_steps else dataclasses.replace(self, n_steps=n_steps)
