"""What training needs of the machine's memory, before it starts: an estimate, a refusal, or a bound on the octree.

The figures are sums of array sizes (docstrings say which), so they hold on any machine; tests compare them with what a
run really takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nerfvol.datasets import Dataset
from nerfvol.errors import InputError
from nerfvol.machine import available_memory
from nerfvol.octree import BLOCKS

BASE_BYTES = 270 << 20
"""The interpreter with torch and numpy loaded."""
LEAF_BYTES = 32 + 8 + 24 + 12
"""Per leaf: corners (8 int32), level (int64), position (3 int64), three float32 of statistics."""
VERTEX_BYTES = 4 + 24
"""Per vertex: a slot (int32) and its lattice position (3 int64), beside two rows of floats."""
VERTICES_PER_LEAF = 1.25
"""Vertices of a thin shell of leaves, measured on trained octrees: 1.12 to 1.3."""
CHANGE_BYTES_PER_LEAF = 250
"""Per leaf while the octree is rebuilt: what describes the change, and the old octree (an eighth of a split one's size)
or the new one (half of a pruned one's). Measured with tracemalloc, see the tests."""
TILE_BYTES_PER_PIXEL = 6
"""Per training pixel: the image composited to 8-bit RGB, and the same in 8x8 tiles (the former is then let go)."""
SHARE = 0.9
"""Of the memory at hand that a run may plan for."""


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes by use; ``leaves`` is the largest number of leaves that was reckoned with."""

    base: int
    images: int
    octree: int
    change: int
    leaves: int

    @property
    def peak(self) -> int:
        """Everything at its largest."""
        return self.base + self.images + self.octree + self.change

    def sentence(self) -> str:
        """The parts in words."""
        return (
            f"{gib(self.peak)} at its peak: images {gib(self.images)}, an octree of up to {self.leaves:,} leaves "
            f"{gib(self.octree)}, changing it {gib(self.change)}, the program {gib(self.base)}"
        )


def octree_bytes(leaves: int, sh_degree: int) -> int:
    """Bytes of an octree of ``leaves`` leaves under training, with its second moments and statistics."""
    rows = 2 * 4 * 16 * BLOCKS[sh_degree]
    return int(leaves * (LEAF_BYTES + VERTICES_PER_LEAF * (VERTEX_BYTES + rows)))


def estimate_training(dataset: Dataset, leaves: int, sh_degree: int) -> MemoryEstimate:
    """What training an octree of at most ``leaves`` leaves on ``dataset`` takes."""
    pixels = sum(image.shape[0] * image.shape[1] for image in dataset.images)
    return MemoryEstimate(
        base=BASE_BYTES,
        images=dataset.nbytes + TILE_BYTES_PER_PIXEL * pixels,
        octree=octree_bytes(leaves, sh_degree),
        change=CHANGE_BYTES_PER_LEAF * leaves,
        leaves=leaves,
    )


def require_memory(estimate: MemoryEstimate, available: int | None = None) -> None:
    """Refuse a run that cannot fit, with what to try. ``available`` defaults to what the machine has free."""
    free = available_memory() if available is None else available
    if free is not None and estimate.peak > SHARE * free:
        raise InputError(
            f"training would need {estimate.sentence()}, but {gib(free)} of memory are free; "
            "use a larger --downscale or a smaller octree (its finest level costs most)"
        )


def affordable_leaves(
    dataset: Dataset, sh_degree: int, wanted: int, least: int = 1 << 18, available: int | None = None
) -> int:
    """The most leaves, up to ``wanted``, with which training fits in the memory at hand.

    Raises:
        InputError: not even ``least`` leaves fit beside the images.
    """
    free = available_memory() if available is None else available
    if free is None:
        return wanted
    fixed = estimate_training(dataset, 0, sh_degree).peak
    per_leaf = octree_bytes(1 << 20, sh_degree) / (1 << 20) + CHANGE_BYTES_PER_LEAF
    leaves = int((SHARE * free - fixed) / per_leaf)
    if leaves < min(least, wanted):
        require_memory(estimate_training(dataset, min(least, wanted), sh_degree), free)
    return min(wanted, leaves)


def largest_octree(levels: Sequence[int]) -> int:
    """Leaves to reckon with for stages whose finest levels are ``levels``: a surface's worth, 20 * 4^level, or all.

    Trained octrees hold about 10 * 4^level leaves after pruning; splitting the level above makes twice that.
    """
    return max(min(8**level, 20 * 4**level) for level in levels)


def gib(size: int) -> str:
    """Bytes in GiB with two digits."""
    return f"{size / 2**30:.2f} GiB"
