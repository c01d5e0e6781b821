"""Distillation: a radiance field becomes a sparse octree of several leaf sizes, and what that costs is measured.

1. Candidates: the field is looked at in coarse cells; only cells that hold something, and their neighbours, are looked
   at again at half the size, down to the finest level (outside the inner cube: the coarser the farther out).
2. Values: coefficient and spherical harmonics at the leaves' vertices, averaged around the vertex.
3. Merging: eight leaves whose values the parent's own corners reproduce become one. Done before pruning, so that thin
   haze is judged by large leaves, in which it has weight.
4. Visibility: the training rays are rendered, and leaves no ray needs are removed [PlenOctrees, section 4].
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nerfvol import sh as spherical
from nerfvol.cameras.camera import Camera
from nerfvol.config.training import DistillConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.tiles import TileBank
from nerfvol.errors import InputError
from nerfvol.field.fields import Domain, RadianceField, SHField
from nerfvol.kernels import ops
from nerfvol.machine import return_free_memory
from nerfvol.measure.scores import evaluate, score_views
from nerfvol.octree.merge import merge_smooth
from nerfvol.octree.rows import DENSITY_SCALE, EMPTY_DENSITY, explin_inverse
from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel

COMPARED_VIEWS = 2
"""Training views on which field and octree are compared."""
JUDGED_PIXELS = 200
"""Along the longer side of an image: what visibility and comparison need is seen in so many; ..."""
JUDGED_DOWNSCALE = 4
"""... but larger images are averaged by no more than this, lest what is thin goes unseen."""
_CHUNK = 32768  # points of one evaluation of the field
_FACES = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1  # the 26 neighbours of a cell


@dataclasses.dataclass
class DistillReport:
    """What came out and what was lost; PSNR in dB over the same views of the dataset."""

    leaves: int
    vertices: int
    leaves_per_level: dict[int, int]
    bytes: int
    candidates: int
    merged: int
    pruned: int
    field_psnr: float
    octree_psnr: float
    messages: list[str]

    @property
    def lost_db(self) -> float:
        """PSNR of the field minus PSNR of the octree."""
        return self.field_psnr - self.octree_psnr

    def __str__(self) -> str:
        levels = ", ".join(f"{n} at level {level}" for level, n in self.leaves_per_level.items())
        return (
            f"distilled {self.leaves} leaves ({levels}), {self.vertices} vertices, {self.bytes / 1e6:.1f} MB; "
            f"field {self.field_psnr:.2f} dB, octree {self.octree_psnr:.2f} dB on the same views: "
            f"{self.lost_db:.2f} dB lost"
        )


def distill(
    field: RadianceField,
    domain: Domain,
    dataset: Dataset,
    background: Sequence[float],
    config: DistillConfig,
    render_field: Callable[[Camera], np.ndarray] | None = None,
) -> tuple[Octree, DistillReport]:
    """Octree of a field.

    Args:
        field: with an SH head (``field.sh``), or any field, whose colour is then projected on SH by quadrature.
        domain: the field's region.
        dataset: the training views: they decide what is visible, and some serve for the comparison.
        background: RGB behind the scene.
        render_field: camera -> (h, w, 3) image of the field; None: no comparison is made (PSNRs are NaN).

    Raises:
        InputError: the field is empty: nothing in it is as opaque as ``empty_opacity``.
    """
    config = config.for_scene(dataset.scene)
    messages: list[str] = []
    frame = Frame.of(domain, cast(int, config.level))
    level, ijk = candidate_cells(field, frame, config, messages)
    kept = ~dataset.before_a_lens(frame.origin + (ijk + 0.5) * (frame.size / 2.0**level)[:, None])
    level, ijk = level[kept], ijk[kept]
    return_free_memory()
    octree = Octree.from_leaves(
        level, ijk, frame.origin.tolist(), frame.size, cast(int, config.sh_degree), DENSITY_SCALE / (2 * domain.half)
    )
    write_values(octree, field)
    candidates = octree.n_leaves
    octree = merge_smooth(octree, config.coarse_level, config.merge_tolerance)
    merged = octree.n_leaves
    return_free_memory()
    if config.prune_weight > 0:
        weights = largest_weights(octree, dataset, background, judged_downscale(dataset))
        keep = weights >= config.prune_weight
        if not keep.any():
            raise InputError(
                "the field holds nothing that the training views can see; train it longer or use --init direct"
            )
        octree, _ = octree.prune(keep)
    return_free_memory()
    field_psnr = octree_psnr = math.nan
    if render_field is not None:
        few = dataset.evenly(COMPARED_VIEWS).smaller(judged_downscale(dataset), background)
        field_psnr = score_views(render_field, few, background)["psnr"]
        octree_psnr = evaluate(OctreeModel(octree), few, background)["psnr"]
    levels, counts = np.unique(octree.leaf_level, return_counts=True)
    report = DistillReport(
        leaves=octree.n_leaves, vertices=octree.n_vertices,
        leaves_per_level=dict(zip(levels.tolist(), counts.tolist(), strict=True)),
        bytes=octree.values.nbytes + octree.corners.nbytes, candidates=candidates, merged=candidates - merged,
        pruned=merged - octree.n_leaves, field_psnr=field_psnr, octree_psnr=octree_psnr, messages=messages,
    )  # fmt: skip
    return octree, report


def judged_downscale(dataset: Dataset) -> int:
    """The factor by which images are averaged before leaves are judged by them: about JUDGED_PIXELS are left."""
    longest = max(max(c.intrinsics.width, c.intrinsics.height) for c in dataset.cameras)
    return min(JUDGED_DOWNSCALE, max(1, longest // JUDGED_PIXELS))


@dataclasses.dataclass(frozen=True)
class Frame:
    """The octree's root cube, and how fine it is where.

    origin (3,), size: the root cube. finest: the level of leaves in the inner cube. center, half: the inner cube.
    """

    origin: np.ndarray
    size: float
    finest: int
    center: np.ndarray
    half: float

    @classmethod
    def of(cls, domain: Domain, level: int) -> Frame:
        """The inner cube itself, or the smallest power-of-two multiple of it that holds the background."""
        doublings = max(0, math.ceil(math.log2(domain.outer) - 1e-6))
        center, size = np.array(domain.center), 2 * domain.half * 2.0**doublings
        return cls(center - size / 2, size, level + doublings, center, domain.half)

    def wanted_level(self, level: int, ijk: np.ndarray) -> np.ndarray:
        """(n,) finest level wanted in cells (n, 3) of ``level``: one less at each doubling of the distance."""
        edge = self.size / 2**level
        low = self.origin + ijk * edge - self.center
        nearest = np.maximum(np.maximum(low, -(low + edge)), 0).max(1)  # Chebyshev distance of the cell's nearest point
        # Shell k holds distances from 2**(k - 1) to 2**k; the inner cube itself is 0.
        shells = np.where(
            nearest < self.half * (1 - 1e-9), 0, np.floor(np.log2(np.maximum(nearest / self.half, 1)) + 1e-9) + 1
        )
        return self.finest - shells.astype(np.int64)


@torch.no_grad()
def in_chunks(function: Callable[[Tensor], Tensor], positions: np.ndarray) -> np.ndarray:
    """``function`` of positions (n, 3), in chunks; the result as one array of n rows."""
    points = torch.from_numpy(np.ascontiguousarray(positions, dtype=np.float32))
    return torch.cat([function(part) for part in points.split(_CHUNK)]).numpy()


def candidate_cells(
    field: RadianceField, frame: Frame, config: DistillConfig, messages: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Levels (n,) and positions (n, 3) of the cells that may hold something, at most ``config.max_leaves``.

    Where they do not fit, all leaves are made coarser: they hold all of a haze, and the octree's training splits them where
    that pays. Only where the coarsest do not fit either, the thinnest are left out.

    Raises:
        InputError: nothing in the field is opaque enough for a leaf.
    """
    level, threshold = cast(int, config.level), -math.log1p(-config.empty_opacity)
    start = max(1, config.coarse_level + frame.finest - level)
    start = min(start, frame.finest, 6 if frame.finest > level else start)
    while (found := _search(field, frame, start, threshold, config.max_leaves)) is None:
        if level > config.coarse_level and frame.finest > start:
            level, frame = level - 1, dataclasses.replace(frame, finest=frame.finest - 1)
        else:
            threshold *= 2
    if level < cast(int, config.level):
        messages.append(
            f"the field is hazy: with leaves smaller than 1/{1 << level} of the inner cube it would not fit into "
            f"{config.max_leaves:,} leaves"
        )
    if threshold > -math.log1p(-config.empty_opacity):
        messages.append(
            f"the field is hazy: only what is more opaque than {-math.expm1(-threshold):.2g} a leaf fits into "
            f"{config.max_leaves:,} leaves"
        )
    if not len(found[0]):
        raise InputError(
            "the field is empty: nothing in it is opaque enough for a leaf; train it longer, check the background "
            "colour and the scene bounds, or use --init direct"
        )
    return found


def _search(
    field: RadianceField, frame: Frame, start: int, threshold: float, most: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Cells of an optical thickness above ``threshold`` and their neighbours, found from level ``start`` on; None: more
    than ``most``."""
    cells = np.stack(np.meshgrid(*[np.arange(1 << start)] * 3, indexing="ij"), -1).reshape(-1, 3)
    levels, done = [], []
    for level in range(start, frame.finest + 1):
        wanted = frame.wanted_level(level, cells)
        edge = frame.size / 2**level
        sigmas = largest_sigma(field, frame.origin + cells * edge, edge, per_axis=4 if level == start else 2)
        # Thickness of the leaf this cell would be cut into.
        thickness = sigmas * (frame.size / 2.0 ** np.maximum(wanted, level))
        kept = dilated(cells, thickness > threshold, 1 << level)
        finished = wanted[kept] <= level
        most -= int(finished.sum())
        if most < 4 * (~finished).sum():  # so many cells a surface has at half their size
            return None
        levels.append(np.full(finished.sum(), level))
        done.append(cells[kept][finished])
        cells = (2 * cells[kept][~finished][:, None] + OFFSETS).reshape(-1, 3)
    return np.concatenate(levels), np.concatenate(done)


def largest_sigma(field: RadianceField, corners: np.ndarray, edge: float, per_axis: int) -> np.ndarray:
    """Largest coefficient among per_axis**3 evenly spaced points in each cell; corners (n, 3) -> (n,)."""
    steps = (np.arange(per_axis) + 0.5) / per_axis * edge
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    best = np.zeros(len(corners), dtype=np.float32)
    for offset in offsets:
        np.maximum(best, in_chunks(field.density, corners + offset), out=best)
    return best


def dilated(cells: np.ndarray, holds: np.ndarray, n: int) -> np.ndarray:
    """Cells (m, 3) of an n**3 grid that hold something or touch one that does: (m,) bool."""

    def key(ijk: np.ndarray) -> np.ndarray:
        return (ijk[:, 0] * (n + 2) + ijk[:, 1]) * (n + 2) + ijk[:, 2]

    keys = key(cells + 1)
    occupied = np.sort(keys[holds])
    kept = holds.copy()
    if not len(occupied):
        return kept
    for offset in _FACES:
        rest = np.flatnonzero(~kept)
        wanted = keys[rest] + (offset[0] * (n + 2) + offset[1]) * (n + 2) + offset[2]
        place = np.minimum(np.searchsorted(occupied, wanted), len(occupied) - 1)
        kept[rest[occupied[place] == wanted]] = True
    return kept


def write_values(octree: Octree, field: RadianceField, samples_per_vertex: int = 8) -> None:
    """Fill an octree's vertices from a field.

    With 8 samples a vertex is the mean over the middles of the eight cells around it, of half the size of the finest
    leaf that has the vertex; colour is weighted by the coefficient, so that space in front of a surface has its colour.

    Raises:
        ValueError: samples_per_vertex is neither 1 nor 8.
    """
    if samples_per_vertex not in (1, 8):
        raise ValueError(f"samples_per_vertex must be 1 or 8, got {samples_per_vertex}")
    positions = octree.vertex_positions()
    spacing = np.full(octree.n_vertices, np.inf)
    np.minimum.at(spacing, octree.corners.reshape(-1), np.repeat(octree.leaf_sizes(), 8))
    to_sh = sh_of(field, octree.sh_degree)
    offsets = (OFFSETS - 0.5) / 2 if samples_per_vertex == 8 else np.zeros((1, 3))
    sigma = np.empty(octree.n_vertices)
    sh = np.empty((octree.n_vertices, 3 * spherical.basis_dim(octree.sh_degree)), np.float32)
    for start in range(0, octree.n_vertices, _CHUNK):  # a part at a time: sums take several times what is kept
        part = slice(start, start + _CHUNK)
        sigma_sum, sh_sum = np.zeros_like(sigma[part]), np.zeros_like(sh[part], np.float64)
        for offset in offsets:
            rows = in_chunks(to_sh, positions[part] + spacing[part, None] * offset).astype(np.float64)
            sigma_sum = sigma_sum + rows[:, 0]
            sh_sum = sh_sum + (rows[:, :1] + 1e-6) * rows[:, 1:]
        sh[part] = sh_sum / (sigma_sum + 1e-6 * len(offsets))[:, None]
        # Beyond an optical thickness of 20 a leaf is opaque: larger numbers change nothing and are hard to optimise.
        sigma[part] = np.minimum(sigma_sum / len(offsets), 20 / spacing[part])
    octree.sh = sh.reshape(octree.n_vertices, 3, -1)
    octree.density = np.maximum(explin_inverse(np.maximum(sigma / octree.density_scale, 1e-30)), EMPTY_DENSITY)


def sh_of(field: RadianceField, degree: int) -> Callable[[Tensor], Tensor]:
    """Function from positions (n, 3) to rows (n, 1 + 3 * basis_dim): coefficient, then SH by channel."""
    dim = spherical.basis_dim(degree)
    if getattr(field, "has_sh", False):
        with_head = cast(SHField, field)

        def from_head(points: Tensor) -> Tensor:
            sigma, sh = with_head.sh(points)
            rows = points.new_zeros(len(points), 3, dim)
            shared = min(dim, sh.shape[-1])
            rows[..., :shared] = sh[..., :shared]
            return torch.cat([sigma[:, None], rows.flatten(1)], dim=1)

        return from_head
    dirs, weights = _sphere(degree + 3)
    projector = (weights[:, None] * spherical.eval_basis(degree, dirs)).float()

    def by_quadrature(points: Tensor) -> Tensor:
        rows = points.new_zeros(len(points), 3, dim)
        sigma = points.new_zeros(len(points))
        for direction, row in zip(dirs.float(), projector, strict=True):
            sigma, rgb = field(points, direction.expand_as(points))
            rows += (rgb - 0.5)[..., None] * row
        return torch.cat([sigma[:, None], rows.flatten(1)], dim=1)

    return by_quadrature


def _sphere(n: int) -> tuple[Tensor, Tensor]:
    """Directions and weights of a product quadrature, exact for polynomials of degree < 2 n."""
    z, w = np.polynomial.legendre.leggauss(n)
    z, phi = (a.reshape(-1) for a in np.meshgrid(z, np.pi * np.arange(2 * n) / n, indexing="ij"))
    s = np.sqrt(1 - z * z)
    dirs = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
    return torch.from_numpy(dirs), torch.from_numpy(np.repeat(w, 2 * n) * np.pi / n)


def largest_weights(octree: Octree, dataset: Dataset, background: Sequence[float], downscale: int) -> np.ndarray:
    """(n_leaves,) largest rendering weight of each leaf over all rays of the dataset at 1/downscale of its size."""
    bank = TileBank(dataset, background, downscale)
    statistics, options = ops.LeafStatistics(octree), ops.LossOptions(tuple(background), early_stop_eps=1e-3)
    for tiles in np.array_split(np.arange(bank.n_tiles), max(1, bank.n_tiles // 32)):
        # At this size of the images leaves are small, and what a tile leaves behind for the second phase is large: few
        # tiles at a time.
        batch = bank.batch(tiles, np.ones(len(tiles), dtype=np.float32))
        ops.leaf_statistics(octree, batch, options, bank.pixel_angle, statistics)
    return statistics.max_weight
