"""Pictures rendered in parts by several machines, with the bits of one machine.

A part is a band of rows and, of a path tracer, a range of its samples. Samples come in blocks of 16: block b of pixel p is
the random stream (seed, p + b pixels), whoever renders it. The sums of blocks are joined by a fixed binary tree: a node of
level l is the sum, in float64, of blocks k 2^l ... (k + 1) 2^l - 1, as far as there are any, its left half plus its right
half. A part holds whole nodes of one level, so that what comes of it does not depend on how a picture was cut, nor on which
part arrived first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

BLOCK = 16
"""Samples of one random stream."""
WHOLE_RAYS = 2**22
"""Rays up to which a picture stays whole: a few seconds of one core."""
PART_RAYS = 2**22
"""Rays of a part, at most."""
PART_PIXELS = 2**16
"""Pixels of a part, at most: its sums, float64, take 4 MiB."""


class Part(NamedTuple):
    """Rows top ... bottom - 1 and, of each pixel, blocks first ... last - 1 of samples; ``first`` is a multiple of a power
    of two that is at least last - first."""

    top: int
    bottom: int
    first: int
    last: int


def blocks(samples: int) -> int:
    """Blocks that ``samples`` samples a pixel make."""
    return -(-samples // BLOCK)


def whole(height: int, samples: int = 1) -> Part:
    """All of a picture."""
    return Part(0, height, 0, blocks(samples))


def cut(height: int, width: int, samples: int = 1, splits: bool = False) -> list[Part]:
    """The parts of a picture, bands of rows one after the other and of each band its samples; one where it is small.

    ``samples``: rays a pixel; ``splits``: whether they may be rendered apart.
    """
    if height * width * samples <= WHOLE_RAYS:
        return [whole(height, samples)]
    rays = min(samples, BLOCK) if splits else samples
    rows = max(1, min(PART_PIXELS // width, PART_RAYS // (width * rays)))
    bands = -(-height // rows)
    edges = [height * k // bands for k in range(bands + 1)]
    total, group = blocks(samples), 1
    while not splits and group < total:
        group *= 2
    while group < total and 2 * group * BLOCK * rows * width <= PART_RAYS:
        group *= 2
    return [
        Part(top, bottom, first, min(first + group, total))
        for top, bottom in zip(edges[:-1], edges[1:], strict=True)
        for first in range(0, total, group)
    ]


def tree_sum(nodes: Sequence[np.ndarray]) -> np.ndarray:
    """The sum of neighbouring nodes of one level, in their order, by the tree that the module's head describes."""
    level = list(nodes)
    while len(level) > 1:
        level = [level[k] + level[k + 1] if k + 1 < len(level) else level[k] for k in range(0, len(level), 2)]
    return level[0]


def joined(parts: Sequence[Part], sums: Iterator[np.ndarray]) -> np.ndarray:
    """The sums (H, W, channels) of a whole picture from those of its parts (rows, W, channels), in the order of ``cut``.

    Takes as many of ``sums`` as there are parts, and keeps those of one band at a time.
    """
    bands, waiting = [], []
    for k, part in enumerate(parts):
        waiting.append(next(sums))
        if k + 1 == len(parts) or parts[k + 1].top != part.top:
            bands.append(tree_sum(waiting))
            waiting = []
    return bands[0] if len(bands) == 1 else np.concatenate(bands)
