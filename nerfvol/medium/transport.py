r"""Single scattering in a medium on a grid, with gradients: the readable reference, in torch.

A medium has an extinction sigma_t (1/u, grey) and an albedo a (RGB), both linear between the vertices of a grid and nothing
outside. Of light that was scattered once, a ray x(t) = o + t d receives [Max 1995, eq. 21, with the source of one sun]

    L = integral T(t) sigma_t(x) a(x) sum_k f(d . w_k) E_k exp(-tau_k(x)) dt,      T(t) = exp(-integral_0^t sigma_t),

w_k the direction towards sun k, E_k its irradiance, tau_k(x) the optical depth from x to it: the deep shadow map [Lokovic &
Veach 2000] of the medium itself, so that the gradient of L also says what density should throw more or less shadow.

tau_k is found for all vertices at once: along the axis nearest to w_k the grid's planes are sheared until the ways to the sun
are its columns; a cumulative trapezoid sum down the columns, and back. All of it is linear in sigma_t; torch transposes it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from nerfvol.medium.lighting import Beam, Lobe

THIN = 1e-6
"""Optical depth of a step below which nothing is looked up."""
HIDDEN = 1e-3
"""Transmittance below which nothing is looked up any more."""


class Medium(NamedTuple):
    """sigma_t (nx, ny, nz), 1/u; albedo (3, nx, ny, nz) in [0, 1]; lo, hi (3,): the first and the last vertex."""

    sigma_t: Tensor
    albedo: Tensor
    lo: Tensor
    hi: Tensor

    @property
    def voxel(self) -> Tensor:
        """(3,) distance of vertices."""
        return (self.hi - self.lo) / (torch.tensor(self.sigma_t.shape) - 1)


class Received(NamedTuple):
    """Linear radiance (n, 3), opacity (n,) and the mean distance of what is seen times opacity (n,) of n rays."""

    radiance: Tensor
    opacity: Tensor
    depth: Tensor


def at_points(volume: Tensor, lo: Tensor, hi: Tensor, points: Tensor) -> Tensor:
    """A volume (c, nx, ny, nz) at points (n, 3), linear between vertices from lo to hi: (n, c)."""
    place = 2 * (points - lo) / (hi - lo) - 1
    # Twice half of the points: torch shares out the first dimension among threads and no other.
    halves = torch.nn.functional.pad(place.flip(-1), (0, 0, 0, len(points) % 2)).view(2, -1, 1, 1, 3)
    found = grid_sample(volume[None].expand(2, -1, -1, -1, -1), halves, align_corners=True)
    return found[..., 0, 0].movedim(1, 2).reshape(-1, len(volume))[: len(points)]


def phase_function(cosine: Tensor, lobes: Sequence[Lobe]) -> Tensor:
    """Sum of Henyey-Greenstein lobes, 1/sr, of the cosine between the directions of propagation."""
    total = torch.zeros_like(cosine)
    for lobe in lobes:
        q = 1 + lobe.g**2 - 2 * lobe.g * cosine
        total = total + lobe.weight * (1 - lobe.g**2) / (4 * math.pi * q**1.5)
    return total


def depth_to_light(medium: Medium, towards: Sequence[float]) -> Tensor:
    """Optical depth from every vertex to a sun in direction ``towards`` (unit): (nx, ny, nz)."""
    voxel = [float(v) for v in medium.voxel]
    axis = max(range(3), key=lambda k: abs(towards[k]) / voxel[k])
    order = (axis, *(k for k in range(3) if k != axis))
    planes = medium.sigma_t.permute(order)
    planes = planes.flip(0) if towards[axis] < 0 else planes  # the last plane is the nearest to the sun
    per_plane = voxel[axis] / abs(towards[axis])
    slopes = tuple(towards[k] * per_plane / voxel[k] for k in order[1:])
    n, rows, columns = planes.shape
    sheared, back = _shears(n, rows, columns, slopes[0], slopes[1], planes.dtype)
    straight = grid_sample(planes[:, None], sheared, align_corners=True)[:, 0]
    segments = 0.5 * per_plane * (straight[:-1] + straight[1:])
    depths = torch.cat([segments.flip(0).cumsum(0).flip(0), torch.zeros_like(straight[:1])])
    found = grid_sample(depths[:, None], back, align_corners=True)[:, 0]
    found = found.flip(0) if towards[axis] < 0 else found
    return found.permute([order.index(k) for k in range(3)])


@functools.lru_cache(maxsize=64)
def _shears(n: int, rows: int, columns: int, a: float, b: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Where the columns to the sun are in each plane (n, m, k, 2), and where the planes' vertices are among the columns
    (n, rows, columns, 2), in grid_sample's numbers. A column moves by (a, b) vertices from plane to plane."""
    plane = torch.arange(n, dtype=torch.float64)
    pairs = []
    for size, slope in ((rows, a), (columns, b)):
        first = math.floor(min(0.0, -slope * (n - 1)))
        last = math.ceil(size - 1 + max(0.0, -slope * (n - 1)))
        count = last - first + 1
        column = first + torch.arange(count, dtype=torch.float64)
        into = 2 * (column + slope * plane[:, None]) / max(size - 1, 1) - 1
        out = 2 * (torch.arange(size, dtype=torch.float64) - slope * plane[:, None] - first) / max(count - 1, 1) - 1
        pairs.append((into, out))
    grids = []
    for way in range(2):
        u, v = pairs[0][way], pairs[1][way]
        shape = (n, u.shape[1], v.shape[1])
        grids.append(torch.stack([v[:, None, :].expand(shape), u[:, :, None].expand(shape)], -1).to(dtype))
    return grids[0], grids[1]


def receive(
    medium: Medium, rays: tuple[Tensor, Tensor], beams: Sequence[Beam], lobes: Sequence[Lobe], step: float,
    jitter: Tensor | None = None, depths: Sequence[Tensor] | None = None,
) -> Received:  # fmt: skip
    """What rays receive; differentiable in the medium.

    Args:
        rays: origins (n, 3) and unit directions (n, 3).
        step: length of the steps along rays, u; each is looked up once, in its middle or where ``jitter`` (n,) in [0, 1) says.
        depths: those of :func:`depth_to_light` for each beam, if they are at hand.
    """
    o, d = rays
    depths = [depth_to_light(medium, beam.towards) for beam in beams] if depths is None else depths
    t, width = _steps(medium, o, d, step, jitter)
    with torch.no_grad():
        points = o[:, None] + t[..., None] * d[:, None]
        inside = torch.nonzero(width.reshape(-1) > 0)[:, 0]
        thickness = torch.zeros(width.numel(), dtype=width.dtype)
        box = medium.lo, medium.hi
        thickness[inside] = at_points(medium.sigma_t[None], *box, points.view(-1, 3)[inside])[:, 0]
        thickness = thickness.view_as(width) * width
        before = torch.cumsum(thickness, 1) - thickness
        held = torch.nonzero(((thickness > THIN) & (before < -math.log(HIDDEN))).reshape(-1))[:, 0]
        ray = held // width.shape[1]
    found = at_points(
        torch.cat([medium.sigma_t[None], medium.albedo, *(x[None] for x in depths)]), *box, points.view(-1, 3)[held]
    )
    thickness = torch.zeros(width.numel(), dtype=width.dtype).index_put((held,), found[:, 0] * width.reshape(-1)[held])
    thickness = thickness.view_as(width)
    through = torch.exp(thickness - torch.cumsum(thickness, 1))
    weight = (through * -torch.expm1(-thickness)).reshape(-1)[held]
    source = torch.zeros(len(held), 3, dtype=width.dtype)
    for k, beam in enumerate(beams):
        arriving = torch.exp(-found[:, 4 + k]) * phase_function(d @ d.new_tensor(beam.towards), lobes)[ray]
        source = source + arriving[:, None] * d.new_tensor(beam.irradiance)
    scattered = weight[:, None] * found[:, 1:4] * source
    radiance = torch.zeros(len(o), 3, dtype=width.dtype).index_add(0, ray, scattered)
    total = torch.stack([weight, weight * t.reshape(-1)[held]], 1)
    opacity, depth = torch.zeros(len(o), 2, dtype=width.dtype).index_add(0, ray, total).unbind(1)
    return Received(radiance, opacity, depth)


def _steps(medium: Medium, o: Tensor, d: Tensor, step: float, jitter: Tensor | None) -> tuple[Tensor, Tensor]:
    """Distances (n, m) at which rays are looked up and widths (n, m) of the steps; 0 where a ray has left the box."""
    safe = torch.where(d.abs() < 1e-12, torch.full_like(d, 1e-12), d)
    near, far = ((corner - o) / safe for corner in (medium.lo, medium.hi))
    enter = torch.minimum(near, far).amax(1).clamp(min=0)
    length = (torch.maximum(near, far).amin(1) - enter).clamp(min=0)
    count = max(1, math.ceil(float(length.max()) / step)) if len(o) else 1
    edges = torch.minimum(step * torch.arange(count + 1, dtype=d.dtype), length[:, None])
    width = edges[:, 1:] - edges[:, :-1]
    share = 0.5 if jitter is None else jitter[:, None]
    return enter[:, None] + edges[:, :-1] + share * width, width


def displayed(received: Received, exposure: float) -> Tensor:
    """Straight sRGB colour (n, 3), not clipped, of what is seen: pictures with alpha hold it."""
    linear = exposure * received.radiance / received.opacity.clamp(min=1e-4)[:, None]
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-6) ** (1 / 2.4) - 0.055)
