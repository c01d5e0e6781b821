"""The cells of a field that may hold something: looked for from coarse to fine, each level only where the last one found.

Cells are integer positions (n, 3) int32 of a level; a level has 2**level cells along the root cube.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import cast

import numpy as np

from nerfvol.config.field import DistillConfig
from nerfvol.errors import EmptyModel
from nerfvol.field.layout import Domain, PointField
from nerfvol.native import native
from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree
from nerfvol.starts.visible import thickness

CHUNK = 32768
"""Points of one evaluation of the field: what it takes and gives stays in the cache."""
CHILDREN = 4
"""Of a cell's eight parts, those that hold a surface: what is reckoned with before they are looked at."""
EVERYWHERE = (np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / 4
"""Points of a cell that nothing is known of, in units of its side ..."""
TETRAHEDRON = 0.25 + 0.5 * OFFSETS[OFFSETS.sum(1) % 2 == 0]
"""... and of one of whose parent something is: its neighbours are kept too."""
_FACES = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1  # the 26 neighbours of a cell


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

    def finer(self, levels: int) -> Frame:
        """The same with leaves so many levels finer."""
        return dataclasses.replace(self, finest=self.finest + levels)

    def wanted_level(self, level: int | np.ndarray, ijk: np.ndarray) -> np.ndarray:
        """(n,) finest level wanted in cells (n, 3) of ``level``, one or (n,): one less at each doubling of the distance."""
        if self.size <= 2 * self.half:  # there are no shells
            return np.full(len(ijk), self.finest)
        edge = self.size / 2.0 ** np.reshape(level, (-1, 1))
        low = self.origin + ijk * edge - self.center
        nearest = np.maximum(np.maximum(low, -(low + edge)), 0).max(1)  # Chebyshev distance of the cell's nearest point
        # Shell k holds distances from 2**(k - 1) to 2**k; the inner cube itself is 0.
        shells = np.where(
            nearest < self.half * (1 - 1e-9), 0, np.floor(np.log2(np.maximum(nearest / self.half, 1)) + 1e-9) + 1
        )
        return self.finest - shells.astype(np.int64)


def evaluate(function: Callable[[np.ndarray], np.ndarray], corners: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """``function`` of the points corners (n, 3) + offsets (p, 3) or (n, p, 3), in one call: (n, p, ...) float32."""
    points = corners.astype(np.float32)[:, None] + offsets.astype(np.float32)
    return function(points.reshape(-1, 3)).reshape(*points.shape[:2], -1)


def candidate_cells(
    field: PointField, frame: Frame, config: DistillConfig, messages: list[str]
) -> tuple[Frame, np.ndarray, np.ndarray]:
    """Levels (n,) and positions (n, 3) of the cells that may hold something, at most ``config.max_leaves``; and their frame.

    Where they do not fit, all leaves are made coarser: they hold all of a haze, and are split where it pays
    (:func:`finer_cells`). Only where the coarsest do not fit either, the thinnest are left out.

    Raises:
        EmptyModel: nothing in the field is opaque enough for a leaf.
    """
    level, threshold = cast(int, config.level), -math.log1p(-config.empty_opacity)
    start = max(1, config.coarse_level + frame.finest - level)
    start = min(start, frame.finest, 6 if frame.finest > level else start)
    while (found := _search(field, frame, start, threshold, config.max_leaves)) is None:
        if level > config.coarse_level and frame.finest > start:
            level, frame = level - 1, frame.finer(-1)
        else:
            threshold *= 2
    if threshold > -math.log1p(-config.empty_opacity):
        messages.append(
            f"the field is hazy: only what is more opaque than {-math.expm1(-threshold):.2g} a leaf fits into "
            f"{config.max_leaves:,} leaves"
        )
    if not len(found[0]):
        raise EmptyModel(
            "the field is empty: nothing in it is opaque enough for a leaf; train it longer, check the background "
            "colour and the scene bounds, or use --init direct"
        )
    return frame, *found


def finer_cells(
    field: PointField, octree: Octree, frame: Frame, config: DistillConfig
) -> tuple[np.ndarray, np.ndarray, int]:
    """The leaves of ``octree``, whose finest cells are those of ``frame``, with these split: levels (n,), positions (n, 3), and
    how many stay whole because the others fill ``config.max_leaves``, the thinnest.

    Of a split leaf's parts those are leaves that hold something or touch one that does.
    """
    level, ijk = octree.leaf_level.astype(np.int64), octree.leaf_ijk
    finest = np.flatnonzero(level == frame.wanted_level(level, ijk))
    finest = finest[np.argsort(-thickness(octree)[finest], kind="stable")]
    room = config.max_leaves - octree.n_leaves
    split = finest[: max(0, room) // CHILDREN]
    parts = (2 * ijk[split][:, None] + OFFSETS.astype(np.int32)).reshape(-1, 3)
    levels, kept = np.repeat(level[split] + 1, 8), np.empty(len(parts), bool)
    for one in np.unique(levels):
        own, edge = np.flatnonzero(levels == one), frame.size / 2.0**one
        thick = edge * largest_sigma(field, parts[own], frame.origin, edge, TETRAHEDRON)
        kept[own] = dilated(parts[own], thick > -math.log1p(-config.empty_opacity))
    most = int(np.searchsorted(np.cumsum(kept.reshape(-1, 8).sum(1) - 1), room, side="right"))
    kept[8 * most :] = False
    whole = np.ones(octree.n_leaves, bool)
    whole[split[:most]] = False
    left = len(finest) - most
    return np.concatenate([level[whole], levels[kept]]), np.concatenate([ijk[whole], parts[kept]]), left


def _search(
    field: PointField, frame: Frame, start: int, threshold: float, most: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Cells of an optical thickness above ``threshold`` and their neighbours, found from level ``start`` on; None: more
    than ``most``."""
    cells = np.stack(np.meshgrid(*[np.arange(1 << start, dtype=np.int32)] * 3, indexing="ij"), -1).reshape(-1, 3)
    levels, done = [], []
    for level in range(start, frame.finest + 1):
        wanted = frame.wanted_level(level, cells)
        edge = frame.size / 2**level
        sigmas = largest_sigma(field, cells, frame.origin, edge, EVERYWHERE if level == start else TETRAHEDRON)
        # Thickness of the leaf this cell would be cut into.
        thickness = sigmas * (frame.size / 2.0 ** np.maximum(wanted, level))
        kept = dilated(cells, thickness > threshold)
        finished = wanted[kept] <= level
        most -= int(finished.sum())
        if most < CHILDREN * (~finished).sum():
            return None
        levels.append(np.full(finished.sum(), level))
        cells = cells[kept]
        done.append(cells[finished])
        cells = (2 * cells[~finished][:, None] + OFFSETS.astype(np.int32)).reshape(-1, 3)
    return np.concatenate(levels), np.concatenate(done)


def largest_sigma(
    field: PointField, cells: np.ndarray, origin: np.ndarray, edge: float, points: np.ndarray
) -> np.ndarray:
    """Largest coefficient among ``points`` (p, 3) in [0, 1] of each cell: (n,) float32.

    Cells (n, 3), in units of their side ``edge``, begin at origin + cells * edge.
    """
    offsets = points * edge
    best, some = np.empty(len(cells), np.float32), max(1, CHUNK // len(offsets))
    for at in range(0, len(cells), some):
        part = slice(at, at + some)
        best[part] = evaluate(field.density, origin + cells[part] * edge, offsets)[..., 0].max(1, initial=0)
    return best


def dilated(cells: np.ndarray, holds: np.ndarray) -> np.ndarray:
    """Cells (m, 3) of one level that hold something or touch one that does, corners included: (m,) bool."""
    compiled = native()
    if compiled is not None:
        kept = np.empty(len(cells), np.uint8)
        compiled.dilate_cells(np.ascontiguousarray(cells, np.int32), holds.view(np.uint8), kept)
        return kept.view(bool)

    def key(ijk: np.ndarray) -> np.ndarray:
        x, y, z = (ijk.astype(np.int64) + 1).T
        return (x << 42) + (y << 21) + z

    occupied, kept = np.sort(key(cells[holds])), holds.copy()
    for offset in _FACES:
        if not len(occupied):
            break
        rest = np.flatnonzero(~kept)
        wanted = key(cells[rest] + offset)
        place = np.minimum(np.searchsorted(occupied, wanted), len(occupied) - 1)
        kept[rest[occupied[place] == wanted]] = True
    return kept
