"""Occupancy grid: where a field may be something, so that rays skip the rest while the field trains.

The grid is a stack of cubes around the inner cube of a ``Domain``, each twice as large as the one before and all
with the same number of cells (Mueller et al. 2022); a bounded scene has one. A cell remembers the largest coefficient
the field was seen to have in it, decaying at each visit. Samples leave ``march`` packed: one row a kept segment.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerfvol.errors import EmptyModel, InputError
from nerfvol.field.fields import NeuralField
from nerfvol.field.layout import GROUP, Domain, step_edges
from nerfvol.field.sampling import intersect_aabb

_POOL = 4  # cells of the grid along an edge of a cell of the coarse grid


class Samples(NamedTuple):
    """Packed segments: ray_indices (n,) int64, not decreasing; t_starts and t_ends (n,) in u, front to back."""

    ray_indices: Tensor
    t_starts: Tensor
    t_ends: Tensor

    def positions(self, rays_o: Tensor, rays_d: Tensor) -> Tensor:
        """(n, 3): the middles of the segments."""
        middle = (self.t_starts + self.t_ends) / 2
        return torch.addcmul(rays_o[self.ray_indices], rays_d[self.ray_indices], middle[:, None])


class StepSchedule:
    """Edges of the marching steps, as distances from where a ray enters the domain.

    Steps are equal in a bounded scene (``n_steps`` along its diagonal); with a background they grow with the distance.
    """

    def __init__(self, domain: Domain, n_steps: int) -> None:
        edges, self.step_size = step_edges(domain, n_steps)
        self.edges = torch.tensor(edges, dtype=torch.float32)


class OccupancyGrid:
    """Cells that may hold something.

    Args:
        domain: the field's region.
        resolution: cells along an edge of each cube, a multiple of 4.
        threshold: a cell is occupied while its optical thickness (sigma * cell edge) is above this.
        decay: what a visit leaves of the remembered coefficient.
    """

    def __init__(self, domain: Domain, resolution: int = 64, threshold: float = 0.04, decay: float = 0.8) -> None:
        if resolution % _POOL:
            raise ValueError(f"resolution must be a multiple of {_POOL}, got {resolution}")
        self.domain, self.resolution, self.threshold, self.decay = domain, resolution, threshold, decay
        self.n_cubes = domain.cubes
        edge = 2 * domain.half / resolution
        self.cell_edges = edge * 2.0 ** torch.arange(self.n_cubes)
        # Start above the threshold everywhere: a cell has to be seen empty several times before it is skipped.
        self.sigmas = (2 * threshold / self.cell_edges).repeat_interleave(resolution**3)
        self.refresh()

    def refresh(self) -> None:
        """Derive the cells to visit from the remembered coefficients."""
        r = self.resolution
        thickness = self.sigmas.view(self.n_cubes, -1) * self.cell_edges[:, None]
        cells = (thickness > self.threshold).view(self.n_cubes, 1, r, r, r)
        inner = slice(r // 4, r - r // 4)
        for k in range(
            1, self.n_cubes
        ):  # points are noted in the smallest cube: the larger ones' middle is its summary
            cells[k, :, inner, inner, inner] = functional.max_pool3d(cells[k - 1].float(), 2) > 0
        self.occupied = cells.reshape(-1)
        pooled = functional.max_pool3d(cells.float(), _POOL)
        # One cell of dilation: a group of steps is tested at its middle and is never longer than two coarse cells.
        self.coarse = functional.max_pool3d(pooled, 3, stride=1, padding=1).reshape(-1) > 0

    @property
    def fraction(self) -> float:
        """Occupied share of the cells of the inner cube."""
        return float(self.occupied[: self.resolution**3].float().mean())

    def check_not_empty(self) -> None:
        """Raise EmptyModel when nothing is left: the field has collapsed to empty space."""
        if not bool(self.occupied.any()):
            raise EmptyModel(
                "the field collapsed to empty space: no cell of the scene holds anything; check that --background is "
                "the images' background and that the scene bounds contain the object, lower field.rate or "
                "field.sparsity_weight, or start with --init direct"
            )

    def _cube_of(self, size: Tensor, at_least: Tensor | float = 0.0) -> Tensor:
        """Index of the smallest cube that holds points at Chebyshev distance ``size`` (in units of half)."""
        if self.n_cubes == 1:
            return torch.zeros_like(size, dtype=torch.int64)
        wanted = torch.ceil(torch.log2(torch.clamp(size, min=1e-6)) - 1e-6)
        return torch.clamp(torch.maximum(wanted, torch.as_tensor(at_least)), 0, self.n_cubes - 1).long()

    def _indices(self, x: Tensor, y: Tensor, z: Tensor, resolution: int, cube: Tensor | None = None) -> Tensor:
        """Flat cell index of points in units of the inner cube ([-1, 1]); broadcasts; outside is clamped."""
        if self.n_cubes > 1:
            if cube is None:
                cube = self._cube_of(torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs()))
            shrink = torch.exp2(-cube.to(x.dtype))
            x, y, z = x * shrink, y * shrink, z * shrink
        half = resolution / 2
        i, j, k = (((c + 1) * half).to(torch.int32).clamp_(0, resolution - 1) for c in (x, y, z))
        flat = (i * resolution + j) * resolution + k
        return flat if cube is None else flat + cube.to(torch.int32) * resolution**3

    def cells_at(self, positions: Tensor) -> Tensor:
        """(n, 3) scene positions -> (n,) flat cell index, in the smallest cube that holds each."""
        x, y, z = self.domain.scaled(positions).unbind(-1)
        return self._indices(x, y, z, self.resolution).long()

    def update(self, positions: Tensor, sigmas: Tensor) -> None:
        """Note coefficients (n,) seen at (n, 3): a visited cell keeps max(decay * old, largest seen)."""
        cells = self.cells_at(positions)
        # Points of one cell all write the same decayed value: work in proportion to the points, not to the grid.
        self.sigmas[cells] = self.sigmas[cells] * self.decay
        self.sigmas.scatter_reduce_(0, cells, sigmas.detach().float(), "amax")

    def probe(self, density: Callable[[Tensor], Tensor], n_points: int, generator: torch.Generator) -> None:
        """Look at ``n_points`` random points of random cells, so that space that was given up can come back.

        ``density``: positions (n, 3), scene units -> coefficients (n,), 1/u.
        """
        r = self.resolution
        cells = torch.randint(len(self.sigmas), (n_points,), generator=generator)
        cube, inner = cells // r**3, cells % r**3
        ijk = torch.stack([inner // r**2, inner // r % r, inner % r], dim=-1)
        unit = (ijk + torch.rand(n_points, 3, generator=generator)) / r * 2 - 1
        scaled = unit * torch.exp2(cube.float())[:, None]
        positions = scaled * self.domain.half + scaled.new_tensor(self.domain.center)
        with torch.no_grad():
            self.update(positions, density(positions))

    def march(
        self,
        rays_o: Tensor,
        rays_d: Tensor,
        schedule: StepSchedule,
        near_plane: float = 0.0,
        jitter: Tensor | None = None,
    ) -> Samples:
        """Segments of each ray whose middles lie in occupied cells.

        Args:
            rays_o, rays_d: (n, 3), directions unit.
            near_plane: nothing nearer than this to the origin is sampled, in u.
            jitter: (n,) in [0, 1): shift of the ray's steps, in steps; None = 1/2.
        """
        near, far = intersect_aabb(rays_o, rays_d, self.domain.aabb.to(rays_o.dtype))
        near = near.clamp(min=near_plane)
        shift = torch.zeros_like(near) if jitter is None else (jitter - 0.5) * schedule.step_size
        start = near + shift
        origin, direction = self.domain.scaled(rays_o), rays_d / self.domain.half
        edges = schedule.edges
        rays, groups = self._coarse_hits(origin, direction, start, far, edges)
        steps = (groups * GROUP)[:, None] + torch.arange(GROUP)
        t_starts, t_ends = start[rays, None] + edges[steps], start[rays, None] + edges[steps + 1]
        middle = (t_starts + t_ends) / 2
        o, d = origin[rays], direction[rays]
        x, y, z = (torch.addcmul(o[:, i, None], d[:, i, None], middle) for i in range(3))
        keep = self.occupied[self._indices(x, y, z, self.resolution)]
        keep &= (middle < far[rays, None]) & (middle >= near[rays, None])
        row, column = keep.nonzero(as_tuple=True)
        return Samples(rays[row], t_starts[row, column], t_ends[row, column])

    def _coarse_hits(
        self, origin: Tensor, direction: Tensor, start: Tensor, far: Tensor, edges: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Ray and group of each group of steps that may meet an occupied cell, in order."""
        lower, upper = edges[:-1:GROUP], edges[GROUP::GROUP]
        middle = start[:, None] + (lower + upper) / 2
        x, y, z = (torch.addcmul(origin[:, i, None], direction[:, i, None], middle) for i in range(3))
        cube = None
        coarse = self.resolution // _POOL
        if self.n_cubes > 1:
            size = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())
            # Half a group must not be longer than a coarse cell (2 / coarse in these units).
            half_group = (upper - lower) / 2 / self.domain.half
            needed = torch.ceil(torch.log2((half_group * coarse / 2).clamp(min=1e-6)))
            cube = self._cube_of(size + half_group, needed)
        hit = self.coarse[self._indices(x, y, z, coarse, cube)] & (start[:, None] + lower < far[:, None])
        rays, groups = hit.nonzero(as_tuple=True)
        return rays, groups

    def state_dict(self) -> dict[str, Tensor]:
        """What is needed to go on, not copied.

        sigmas (n_cubes * resolution**3,) float32, 1/u: the remembered coefficients. What follows from them, bool: occupied, of
        the same shape, and coarse, of groups of cells.
        """
        return {"sigmas": self.sigmas, "occupied": self.occupied, "coarse": self.coarse}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of ``state_dict``, by copies; InputError where an array has another shape or dtype than this grid's."""
        for name in ("sigmas", "occupied", "coarse"):
            mine, given = getattr(self, name), state[name]
            if mine.shape != given.shape or mine.dtype != given.dtype:
                expected, got = f"{mine.dtype} {tuple(mine.shape)}", f"{given.dtype} {tuple(given.shape)}"
                raise InputError(f"occupancy grid of the checkpoint: {name} must be {expected}, got {got}")
            setattr(self, name, given.clone())


class OccupiedField:
    """A field that is empty where an occupancy grid says so, as it was in training; the rest is the field's own.

    What lies in cells that training skips is whatever the network happens to hold there. Points in skipped cells cost
    nothing here.
    """

    def __init__(self, field: NeuralField, grid: OccupancyGrid) -> None:
        self.field, self.grid = field, grid
        self.has_sh = field.has_sh
        self.sh_degree = field.sh_degree

    def _inside(self, positions: Tensor) -> Tensor:
        return self.grid.occupied[self.grid.cells_at(positions)].nonzero()[:, 0]

    def density(self, positions: Tensor) -> Tensor:
        """(n, 3) -> sigma (n,) in 1/u."""
        inside = self._inside(positions)
        sigma = positions.new_zeros(len(positions))
        return sigma.index_copy(0, inside, self.field.density(positions[inside]))

    def sh(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 3) -> sigma (n,), sh (n, 3, basis_dim)."""
        inside = self._inside(positions)
        sigma, sh = self.field.sh(positions[inside])
        zeros = positions.new_zeros(len(positions))
        coefficients = zeros[:, None, None].expand(-1, *sh.shape[1:]).clone()
        return zeros.index_copy(0, inside, sigma), coefficients.index_copy(0, inside, sh)

    def __call__(self, positions: Tensor, viewdirs: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 3), (n, 3) unit -> sigma (n,), rgb (n, 3)."""
        inside = self._inside(positions)
        sigma, rgb = self.field(positions[inside], viewdirs[inside])
        zeros = positions.new_zeros(len(positions))
        return zeros.index_copy(0, inside, sigma), torch.zeros_like(positions).index_copy(0, inside, rgb)
