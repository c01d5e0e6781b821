"""Level sets as solids, out of arrays and OpenVDB files; ``crossings.py`` finds them along a ray.

A solid is kept in the bricks that its surface crosses; of the others it is known whether they are inside.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from data_synth.bricks import BRICK, MOST, SIDE, TOGETHER
from data_synth.checks import vector
from data_synth.crossings import INSIDE, OUTSIDE, LevelSet
from data_synth.errors import InputError
from data_synth.media import triple
from data_synth.vdb import read_level_set
from data_synth.volumes import is_turned

if TYPE_CHECKING:
    from data_synth.vdb_tree import Tree

NEAR_ZERO = 1e-6  # of a brick's largest sample: bricks whose samples come that near to 0 count as crossed


def level_set(
    material: int, file: str | os.PathLike, grid: str | None = None, size: float | None = None,
    centre: ArrayLike | None = None, up: str = "z",
) -> LevelSet:  # fmt: skip
    """The solid of an OpenVDB file: its grid of class "level set", or the one called ``grid``.

    size: its longest side in u, by default as in the file; centre: the middle of its box, by default where the file has it.
    up: the file's axis that is upright, y (as film programs have it) or z.
    """
    turned = is_turned(up)
    tree, voxel_size, origin = read_level_set(file, grid)
    solid = of_tree(material, tree, voxel_size, origin)
    solid = upright(solid) if turned else solid
    try:
        low, high = extent_of(solid)
    except InputError:
        raise tree.r.fail("it encloses nothing: no value is below 0", "level set") from None
    if size is not None and not 0 < size < np.inf:
        raise InputError(f"level_set: size must be positive, got {size}")
    if size is not None and not (high > low).any():
        raise tree.r.fail("a single voxel of it is inside, and that has no size to scale: leave size out", "level set")
    by = 1.0 if size is None else size / (high - low).max()
    middle = 0.5 * (low + high)
    place = middle if centre is None else vector(centre, "centre")
    cell = triple(by * np.array(solid.cell))
    return solid._replace(lo=triple(place + by * (np.array(solid.lo) - middle)), cell=cell)


def upright(s: LevelSet) -> LevelSet:
    """With y up turned to z up, right-handed: x, y, z -> x, -z, y."""
    a, b, c = s.bricks
    offsets = np.ascontiguousarray(s.offsets.reshape(s.bricks)[:, :, ::-1].transpose(0, 2, 1)).ravel()
    samples = s.samples[1:].reshape(-1, SIDE, SIDE, SIDE)[..., ::-1].transpose(0, 1, 3, 2)
    lo = (s.lo[0], -(s.lo[2] + BRICK * c * s.cell[2]), s.lo[1])
    cell = (s.cell[0], s.cell[2], s.cell[1])
    return s._replace(
        lo=lo, cell=cell, bricks=(a, c, b), offsets=offsets, samples=np.concatenate([s.samples[:1], samples.ravel()])
    )


def extent_of(s: LevelSet) -> tuple[np.ndarray, np.ndarray]:
    """(lo, hi) of the box around the vertices that are inside."""
    index = np.stack(np.unravel_index(np.arange(len(s.offsets)), s.bricks), axis=1) * BRICK
    crossed = np.flatnonzero(s.offsets > 0)
    low, high = [], []
    inner = np.stack(np.unravel_index(np.arange(SIDE**3), (SIDE,) * 3), axis=1)
    for k in range(0, len(crossed), TOGETHER):
        which = crossed[k : k + TOGETHER]
        b, v = np.nonzero(s.samples[s.offsets[which][:, None] + np.arange(SIDE**3)] < 0)
        if len(b):
            at = index[which[b]] + inner[v]
            low.append(at.min(axis=0))
            high.append(at.max(axis=0))
    full = index[s.offsets == INSIDE]
    if len(full):
        low.append(full.min(axis=0))
        high.append(full.max(axis=0) + BRICK)
    if not low:
        raise InputError("level set: it encloses nothing, no value is below 0")
    return s.lo + np.min(low, axis=0) * np.array(s.cell), s.lo + np.max(high, axis=0) * np.array(s.cell)


def sampled(material: int, distance: ArrayLike, lo: ArrayLike, hi: ArrayLike) -> LevelSet:
    """The solid in which ``distance``, (nx, ny, nz) samples at the vertices of a grid from lo to hi, is below 0.

    Beyond the grid is outside: a solid that reaches its edge is closed within one further cell.
    """
    values = np.asarray(distance, np.float32)
    if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all():
        raise InputError(
            f"level set: expected a finite 3D array of at least 2 samples a side, got shape {values.shape}"
        )
    lo, hi = vector(lo, "lo"), vector(hi, "hi")
    if not (lo < hi).all():
        raise InputError(f"level set: expected lo < hi, got {lo.tolist()} and {hi.tolist()}")
    counts = np.array([-(-(n + 1) // BRICK) for n in values.shape])  # with a layer of vertices around
    beyond = max(float(np.abs(values).max()), 1e-30)
    padding = [(1, int(c * BRICK + 1 - n - 1)) for c, n in zip(counts, values.shape, strict=True)]
    whole = np.pad(values, padding, constant_values=beyond)
    blocks = np.full(tuple(counts), np.nan, np.float32)
    corners = BRICK * np.stack(np.unravel_index(np.arange(blocks.size), blocks.shape), axis=1)

    def windows(which: np.ndarray) -> np.ndarray:
        out = np.empty((len(which), SIDE, SIDE, SIDE), np.float32)
        for row, (a, b, c) in zip(out, corners[which], strict=True):
            row[:] = whole[a : a + SIDE, b : b + SIDE, c : c + SIDE]
        return out

    cell = (hi - lo) / (np.array(values.shape) - 1)
    return _built(material, lo - cell, cell, blocks, windows)


def _built(material: int, lo: np.ndarray, cell: np.ndarray, blocks: np.ndarray, windows: Callable) -> LevelSet:
    """blocks: (bx, by, bz) the value of blocks that have one alone, NaN of others; windows: the (n, 9, 9, 9) samples of
    bricks by number."""
    sign = np.where(np.isnan(blocks), 0, np.where(blocks < 0, -1, 1)).astype(np.int8)
    around = np.pad(sign, [(0, 1)] * 3, constant_values=1)
    mixed_ = sign == 0
    for s in np.ndindex(2, 2, 2):
        mixed_ |= around[tuple(slice(a, a + n) for a, n in zip(s, sign.shape, strict=True))] != sign
    offsets = np.where(sign < 0, INSIDE, OUTSIDE).astype(np.int64).ravel()
    asked, kept, total = np.flatnonzero(mixed_), [np.zeros(1, np.float32)], 1
    for k in range(0, len(asked), TOGETHER):
        which = asked[k : k + TOGETHER]
        values = windows(which).reshape(-1, SIDE**3)
        near = NEAR_ZERO * np.abs(values).max(axis=1)
        crossed = (values.min(axis=1) <= near) & (values.max(axis=1) >= -near)
        offsets[which] = np.where(values[:, 0] < 0, INSIDE, OUTSIDE)
        offsets[which[crossed]] = total + SIDE**3 * np.arange(crossed.sum())
        kept.append(values[crossed].ravel())
        total += kept[-1].size
    a, b, c = (int(n) for n in blocks.shape)
    return LevelSet(material, triple(lo), triple(cell), (a, b, c), offsets, np.concatenate(kept))


def holds(s: LevelSet, points: np.ndarray) -> np.ndarray:
    """Whether a solid holds each of the points (..., 3): ``within``, for arrays."""
    at = (points - s.lo) / s.cell
    n = BRICK * np.array(s.bricks)
    cell = np.clip(at.astype(np.int64), 0, n - 1)
    brick, inner = cell >> 3, cell & 7
    first = s.offsets[np.ravel_multi_index(tuple(np.moveaxis(brick, -1, 0)), s.bricks)]
    at_corner = np.maximum(first, 0) + np.where(first > 0, (inner * (SIDE * SIDE, SIDE, 1)).sum(-1), 0)
    u, v, w = np.moveaxis(at - cell, -1, 0)
    value = sum(
        s.samples[np.where(first > 0, at_corner + (i * SIDE + j) * SIDE + k, 0)]
        * (u if i else 1 - u) * (v if j else 1 - v) * (w if k else 1 - w)
        for i, j, k in np.ndindex(2, 2, 2)
    )  # fmt: skip
    return ((at > 0) & (at < n)).all(-1) & np.where(first > 0, value < 0, first == INSIDE)


def of_tree(material: int, tree: Tree, voxel_size: np.ndarray, origin: np.ndarray) -> LevelSet:
    """The solid of a grid as OpenVDB keeps it: leaves, tiles below 0, and the background around."""
    leaves = np.array(tree.leaves, np.int64).reshape(-1, 3)
    low = [leaves.min(axis=0)] if len(leaves) else []
    high = [leaves.max(axis=0) + BRICK] if len(leaves) else []
    for place, edge, _ in tree.inside:
        low.append(place.min(axis=0))
        high.append(place.max(axis=0) + edge)
    if not low:
        raise tree.r.fail("it encloses nothing: no value is below 0")
    first = np.min(low, axis=0) - BRICK  # a block more: what lies beyond is the background
    counts = (np.max(high, axis=0) - first) // BRICK
    tree.refuse(BRICK * counts, 12.0 * float(np.prod(counts.astype(float))) + 3000.0 * len(leaves), "bricks")
    if np.prod(counts.astype(float)) > MOST:
        raise tree.r.fail(f"its solid spans {'x'.join(str(8 * int(n)) for n in counts)} voxels")
    blocks = np.full(tuple(counts + 1), tree.background, np.float32)  # one more, for what bricks see of the next
    for place, edge, values in tree.inside:
        for at, value in zip((place - first) // BRICK, values, strict=True) if edge > BRICK else ():
            blocks[tuple(slice(a, a + edge // BRICK) for a in at)] = value
        if edge == BRICK:
            blocks[tuple(((place - first) // BRICK).T)] = values
    leaf = np.full(blocks.shape, -1, np.int32)
    at = tuple(((leaves - first) // BRICK).T)
    leaf[at], blocks[at] = np.arange(len(leaves)), np.nan
    stored = tree.values.reshape(-1, BRICK, BRICK, BRICK)

    def windows(which: np.ndarray) -> np.ndarray:
        out = np.empty((len(which), SIDE, SIDE, SIDE), np.float32)
        place = np.stack(np.unravel_index(which, counts), axis=1)
        for s in np.ndindex(2, 2, 2):
            at = tuple((place + s).T)
            here = out[(slice(None), *(slice(BRICK, SIDE) if a else slice(0, BRICK) for a in s))]
            here[:] = blocks[at][:, None, None, None]
            own = np.flatnonzero(leaf[at] >= 0)
            here[own] = stored[leaf[at][own]][(slice(None), *(slice(0, 1) if a else slice(None) for a in s))]
        return out

    return _built(material, origin + voxel_size * first, voxel_size, blocks[:-1, :-1, :-1], windows)
