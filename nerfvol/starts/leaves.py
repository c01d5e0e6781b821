"""An octree around Gaussian splats: leaves where Gaussians are, as fine as these are, and what they hold to begin with.

A Gaussian is taken for a density: along its shortest axis it is as thick as its opacity says, -ln(1 - o). That is right for one
alone and too thick for many that overlap, each of which was trained to cover what the others do; the values are a start that
is fitted to pictures of the splats afterwards (training/convert.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.errors import InputError
from nerfvol.native import native
from nerfvol.octree.rows import DENSITY_SCALE, DENSITY_SLOT, EMPTY_DENSITY, explin_inverse, sh_slots
from nerfvol.octree.topology import demorton, morton
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds
from nerfvol.rotations import rotations
from nerfvol.splats.splats import Splats

FAINTEST = 0.1
"""Opacity down to which a Gaussian's ellipsoid is filled with leaves; of one that is nowhere so dense its middle alone is."""
WIDEST = 2.0
"""... but no farther than so many deviations."""
PIXELS = 1.4
"""Side of the finest leaf in pixels of the nearest camera."""
SCALES = 1.2
"""... and in units of a Gaussian's middle deviation, where that is larger."""
SPACING = 0.7
"""Of a leaf's side: samples of an ellipsoid are so far apart, so that no leaf within it is missed by much."""
LARGEST_LATTICE = 12
"""Samples to each side along an axis of a Gaussian, at most: its leaves are coarser where that is not enough."""
BLUR = 0.35
"""Of a leaf's side: what a Gaussian's deviations are widened by, in squares, where leaves sample it."""
PAIRS = 1 << 21
"""Of a Gaussian and a cell, which are weighed at a time."""
_THICKEST = 4.0  # optical thickness of one leaf at the start: beyond, no gradient passes

Float = NDArray[np.float64]


@dataclass(frozen=True)
class _Gaussians:
    """What is asked of n splats: means (n, 3), axes (n, 3, 3) in columns, scales (n, 3), opacity (n,), all float64."""

    means: Float
    axes: Float
    scales: Float
    opacity: Float

    @classmethod
    def of(cls, splats: Splats) -> _Gaussians:
        return cls(
            splats.means + splats.origin, np.ascontiguousarray(rotations(splats.quats)),
            np.exp(splats.log_scales.astype(np.float64)), 1 / (1 + np.exp(-splats.logits.astype(np.float64))),
        )  # fmt: skip

    def __getitem__(self, chosen: NDArray) -> _Gaussians:
        return _Gaussians(self.means[chosen], self.axes[chosen], self.scales[chosen], self.opacity[chosen])

    @property
    def reach(self) -> Float:
        """(n,) deviations at which the opacity falls to FAINTEST, between 0 and WIDEST."""
        return np.minimum(np.sqrt(2 * np.log(np.maximum(self.opacity / FAINTEST, 1.0))), WIDEST)


def octree_around(
    splats: Splats, scene: SceneBounds, cameras: Sequence[Camera], level: int, sh_degree: int = 1
) -> Octree:
    """The octree of ``splats`` as they stand, in the root cube of ``scene``; what lies outside that is left out.

    Args:
        cameras: that see the splats: a leaf need not be finer than their pixels. None: as fine as the Gaussians.
        level: the finest leaves: 2**level along the scene's inner cube, one level less in each shell.
        sh_degree: of the octree's colours.

    Raises:
        InputError: no splat lies in the root cube.
    """
    size = scene.side * 2.0**scene.n_shells
    origin = scene.center - size / 2
    means = splats.means + splats.origin
    inside = np.flatnonzero(((means > origin) & (means < origin + size)).all(1))
    if not len(inside):
        raise InputError(
            f"none of the {splats.n} splats lies in the region of the octree, {origin} and {size:.4g} beyond"
        )
    gaussians, sh = _Gaussians.of(splats)[inside], splats.with_sh_degree(sh_degree).sh[inside]
    levels = _levels(gaussians, scene, cameras, level, size)
    which, leaf_level, codes = _filled(gaussians, levels, origin, size)
    octree = Octree.from_leaves(*_resolved(leaf_level, codes), origin, size, sh_degree, DENSITY_SCALE / scene.side)
    _write(octree, gaussians, sh.reshape(len(sh), -1), which, (leaf_level, codes))
    return octree


def _levels(g: _Gaussians, scene: SceneBounds, cameras: Sequence[Camera], level: int, size: float) -> NDArray[np.int64]:
    """(n,) the level of the leaves that each Gaussian is made of."""
    side = SCALES * np.sort(g.scales, axis=1)[:, 1]
    if cameras:
        side = np.maximum(side, PIXELS * np.sqrt(_pixel_squares(g.means, cameras)))
    longest = (2 * g.reach * g.scales.max(1)) / (2 * LARGEST_LATTICE * SPACING)
    wanted = np.round(np.log2(size / np.maximum(np.maximum(side, longest), 1e-300))).astype(np.int64)
    return np.clip(wanted, min(3 + scene.n_shells, level), scene.finest_levels(g.means, level))


def _pixel_squares(points: Float, cameras: Sequence[Camera]) -> Float:
    """(n,) square of a pixel's width, scene units, at each of ``points`` (n, 3): that of the camera where it is smallest."""
    middle = np.mean([camera.position for camera in cameras], axis=0)
    apart, nearest = points - middle, np.full(len(points), np.inf)
    own = np.einsum("ni,ni->n", apart, apart)
    for camera in cameras:
        place, focal = camera.position - middle, max(camera.intrinsics.fx, camera.intrinsics.fy)
        square = own - apart @ (2 * place)  # |a - b|^2 without a row of differences for each camera
        square += place @ place
        np.minimum(nearest, square * (1 / focal**2), out=nearest)
    return np.maximum(nearest, 0)


def _filled(
    g: _Gaussians, levels: NDArray[np.int64], origin: Float, size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a Gaussian and a cell that it fills: the Gaussian's number, the cell's level and Morton code, (m,) each.

    Compiled in the order of the Gaussians (csrc/around.cpp); the same pairs in any order in numpy.
    """
    side = size / 2.0**levels
    half = g.reach[:, None] * np.hypot(g.scales, BLUR * side[:, None])  # so that thin discs are closed
    steps = np.ceil(half / (SPACING * side[:, None])).astype(np.int64)
    compiled = native()
    if compiled is not None:
        which, code = compiled.fill_cells(
            means=g.means, axes=g.axes, side=side, half=half, steps=steps, level=levels, origin=origin
        )
        return which, levels[which], code
    shapes, group = np.unique(steps, axis=0, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(group.reshape(-1), minlength=len(shapes)))
    numbers, found, codes = [], [], []
    for shape, members in zip(shapes, np.split(order, ends[:-1]), strict=True):
        lattice = np.stack(np.meshgrid(*[np.linspace(-1, 1, 2 * n + 1) if n else np.zeros(1) for n in shape],
                                       indexing="ij"), -1).reshape(-1, 3)  # fmt: skip
        lattice = lattice[(lattice**2).sum(1) <= 1 + 1e-9] if (shape > 0).any() else lattice
        if (shape > 0).any() and not len(lattice):
            lattice = np.zeros((1, 3))
        for part in np.array_split(members, 1 + len(members) * len(lattice) // 500_000):
            own = lattice * half[part, None]
            points = g.means[part, None] + own @ g.axes[part].transpose(0, 2, 1)
            cells = np.floor((points - origin) / side[part, None, None]).astype(np.int64)
            inside = np.asarray((cells >= 0) & (cells < (1 << levels[part])[:, None, None]))
            within = np.asarray(inside.all(2))
            keys = morton(np.where(within[..., None], cells, 0).reshape(-1, 3)).reshape(within.shape)
            keys = np.sort(np.where(within, keys, -1), axis=1)
            new = np.asarray(keys >= 0)
            new[:, 1:] &= keys[:, 1:] != keys[:, :-1]
            rows, _ = np.nonzero(new)
            numbers.append(part[rows])
            found.append(levels[part[rows]])
            codes.append(keys[new])
    return np.concatenate(numbers), np.concatenate(found), np.concatenate(codes)


def _resolved(level: NDArray[np.int64], codes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Leaves (levels, positions) that cover the same cells, each once: a cell that holds finer ones is split."""
    coarsest, finest = int(level.min()), int(level.max())
    own = {k: _distinct(codes[level == k]) for k in range(coarsest, finest + 1)}
    above = {finest: np.empty(0, np.int64)}
    for k in range(finest - 1, coarsest - 1, -1):
        above[k] = _distinct(np.concatenate([own[k + 1], above[k + 1]]) >> 3)
    levels, leaves, pushed = [], [], np.empty(0, np.int64)
    for k in range(coarsest, finest + 1):
        cells = _distinct(np.concatenate([own[k], pushed]))
        split = _among(cells, above[k])
        leaves.append(cells[~split])
        levels.append(np.full(len(leaves[-1]), k))
        pushed = (cells[split][:, None] * 8 + np.arange(8)).reshape(-1)
    return np.concatenate(levels), demorton(np.concatenate(leaves))


def _among(cells: NDArray[np.int64], codes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of ``cells`` (n,) are among ``codes`` (m,), both rising."""
    if not len(codes):
        return np.zeros(len(cells), bool)
    return codes[np.minimum(np.searchsorted(codes, cells), len(codes) - 1)] == cells


def _distinct(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different ones of (n,) codes, rising; sorted, which is several times as fast as numpy's unique."""
    compiled = native()
    if compiled is not None:
        return compiled.distinct_codes(codes)
    codes = np.sort(codes)
    return codes[np.concatenate([[True], codes[1:] != codes[:-1]])] if len(codes) else codes


def _write(
    octree: Octree,
    g: _Gaussians,
    sh: NDArray,
    which: NDArray[np.int64],
    pairs: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> None:
    """Density and colour of the leaves, and from them those of the vertices; ``pairs`` (levels, codes) fill the leaves."""
    levels, codes = pairs
    colours = np.column_stack([np.ones(len(sh)), sh]).astype(np.float64)  # the first column adds up the densities
    sums = np.zeros((octree.n_leaves, colours.shape[1]))
    for start in range(0, len(which), PAIRS):  # a million Gaussians fill 20 million cells
        part = slice(start, start + PAIRS)
        leaf, sigma = _weighed(octree, g, which[part], levels[part], codes[part])
        _add(colours, which[part], sigma, leaf, sums)
    share = sums / np.maximum(sums[:, :1], 1e-12)
    share[:, 0] = 1
    values = _at_vertices(octree, share, np.minimum(sums[:, 0], _THICKEST / octree.leaf_sizes()))
    total, count = values[:, 0], np.bincount(octree.corners.reshape(-1), minlength=octree.n_vertices)
    slots = sh_slots(octree.sh_degree).reshape(-1)
    columns = (
        slice(slots[0], slots[-1] + 1) if len(slots) == 1 + slots[-1] - slots[0] else slots
    )  # a copy, no scattering
    octree.values[:, columns] = values[:, 1:] * (1 / np.maximum(total, 1e-12))[:, None]
    raw = explin_inverse(np.maximum(total / count / octree.density_scale, 1e-30))
    octree.values[:, DENSITY_SLOT] = np.maximum(raw, EMPTY_DENSITY)
    octree.prefiltered = None


def _weighed(
    octree: Octree, g: _Gaussians, which: NDArray[np.int64], levels: NDArray[np.int64], codes: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Float]:
    """The leaf that each pair's cell lies in, -1: none, and the density of its Gaussian there, (m,) each.

    A cell that was split: its density goes to the leaf at its middle, where finer Gaussians fill that as well.
    """
    thickness = -np.log1p(-np.minimum(g.opacity, 0.99))
    compiled = native()
    if compiled is not None:
        leaf, sigma = np.empty(len(which), np.int64), np.empty(len(which))
        compiled.weigh_cells(
            node_mask=octree.node_mask, leaf_mask=octree.leaf_mask, first_node=octree.first_node, first_leaf=octree.first_leaf,
            means=g.means, axes=g.axes, squares=g.scales**2, thickness=thickness, blur=BLUR, origin=octree.origin,
            size=octree.size, gaussian=which, level=levels, code=codes, leaf=leaf, weight=sigma,
        )  # fmt: skip
        return leaf, sigma
    side = octree.size / 2.0**levels
    centers = octree.origin + (demorton(codes) + 0.5) * side[:, None]
    own = np.einsum("nij,ni->nj", g.axes[which], centers - g.means[which])
    wide = g.scales[which] ** 2 + (BLUR * side[:, None]) ** 2
    sigma = thickness[which] / np.sqrt(2 * np.pi * wide.min(1)) * np.exp(-0.5 * (own**2 / wide).sum(1))
    return octree.query(centers), sigma


def _add(rows: Float, of: NDArray[np.int64], weight: Float, to: NDArray[np.int64], sums: Float) -> None:
    """Adds ``weight`` (m,) times the rows (any, width) numbered ``of`` (m,) to the rows ``to`` (m,) of ``sums`` (n, width);
    to none where that is negative."""
    compiled = native()
    if compiled is not None:
        compiled.add_rows(np.ascontiguousarray(rows), of, weight, to, sums)
        return
    chosen = np.flatnonzero(to >= 0)
    of, weight, to = of[chosen], weight[chosen], to[chosen]
    for column, total in zip(rows.T, sums.T, strict=True):
        total += np.bincount(to, weight * column[of], len(sums))


def _at_vertices(octree: Octree, rows: Float, weight: Float) -> Float:
    """(n_vertices, width): the leaves' rows (n_leaves, width) times ``weight`` (n_leaves,), added up at their corners."""
    sums, compiled = np.zeros((octree.n_vertices, rows.shape[1])), native()
    if compiled is not None:
        compiled.add_to_corners(rows, weight, octree.corners, sums)
    else:
        _add(rows, np.repeat(np.arange(len(rows)), 8), np.repeat(weight, 8), octree.corners.reshape(-1), sums)
    return sums
