"""The memory of an octree under training: an estimate, a refusal, and a bound on its leaves where there is little."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.tiles import foreground_share
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.kernels.state import TILE_RAYS
from nerfvol.machine import available_memory
from nerfvol.octree.rows import BLOCKS
from nerfvol.octree.tree import Octree
from nerfvol.training.backgrounds import second_background
from nerfvol.training.memory.base import BASE_BYTES, SHARE, gib
from nerfvol.training.memory.fields import FIELD_BYTES, distillation_bytes

LEAF_BYTES = 32 + 1 + 12 + 12 + 2
"""Per leaf: corners (8 int32), level (int8), position (3 int32), three float32 of statistics, a fifth of a node (10)."""
VERTEX_BYTES = 4
"""Per vertex: a slot (int32), next to two rows of floats."""
VERTICES_PER_LEAF = 1.65
"""Vertices of an octree that was split where it pays, for each leaf: measured on lego, 1.5 to 1.7 at every size."""
BEFORE_SHARE = 0.4
"""Of the leaves of the largest octree: those that the octree before it had, which is in memory while its leaves are split."""
TILE_BYTES_PER_PIXEL = 0.33
"""Per training pixel: a 64th of a tile's image, number, row, place in two queues (int32 each) and colour (bool); next to
8-bit RGB of the foreground, before each background."""
LEAVES_PER_PIXEL = 2.2
"""Leaves of an octree split where it pays, for each pixel of one view: 1.38 million for lego at 800x800. Thick media have
several times as many."""
PHOTOGRAPH_LEAVES_PER_PIXEL = 0.8
"""The same for photographs, whose stages split less: 0.37 million for fox at 540x960."""
MOST_LEAVES = 1 << 27
"""Eight corners each are numbered with 31 bits."""


@dataclass(frozen=True)
class OtherMemory:
    """What a run holds besides the octree and its training images.

    foreground_share: of the training tiles, those of the foreground. backgrounds: that these are held before. held_out_bytes:
    of images. field: whether the octree comes from a field. splats: bytes of all that is there while splats are trained that
    it comes from; 0: it does not.
    """

    foreground_share: float = 1.0
    held_out_bytes: int = 0
    field: bool = False
    splats: int = 0
    backgrounds: int = 1


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes by use; ``leaves`` is the largest number of leaves that was planned for.

    Images, octree and change are there at one time, the distillation of a field or splats (0: there are none) at another.
    """

    base: int
    images: int
    octree: int
    change: int
    leaves: int
    distillation: int = 0
    splats: int = 0

    @property
    def peak(self) -> int:
        """Everything at its largest."""
        return self.base + max(self.images + self.octree + self.change, self.distillation, self.splats)

    def sentence(self) -> str:
        """The parts in words."""
        before = f", before that {gib(self.distillation)} to distil the field" if self.distillation else ""
        before = f", before that {gib(self.splats)} for splats" if self.splats else before
        return (
            f"{gib(self.peak)} at its peak: images {gib(self.images)}, an octree of up to {self.leaves:,} leaves "
            f"{gib(self.octree)}, changing it {gib(self.change)}, the program {gib(self.base)}{before}"
        )


def octree_bytes(leaves: int, sh_degree: int, vertices: float | None = None) -> int:
    """Bytes of an octree under training, with its second moments and statistics; ``vertices`` None: VERTICES_PER_LEAF."""
    count = VERTICES_PER_LEAF * leaves if vertices is None else vertices
    return int(LEAF_BYTES * leaves + (VERTEX_BYTES + 2 * row_bytes(sh_degree)) * count)


def change_bytes(leaves: int, sh_degree: int, vertices: float | None = None) -> int:
    """Bytes needed next to an octree that has just been split into so many leaves, while the second moments follow the values.

    Of the octree before: second moments and corners; and where each leaf and vertex came from, 5 bytes each. Pruning the
    largest octree would take a quarter more, but it has few leaves to lose, and then it is not done
    (octree_trainer.WORTH_PRUNING).
    """
    count = VERTICES_PER_LEAF * leaves if vertices is None else vertices
    return int(BEFORE_SHARE * (row_bytes(sh_degree) * count + 32 * leaves) + 5 * (leaves + count))


def row_bytes(sh_degree: int) -> int:
    """Bytes of one row of values or second moments."""
    return 4 * 16 * BLOCKS[sh_degree]


def estimate_training(
    dataset: Dataset, leaves: int, sh_degree: int, other: OtherMemory | None = None, vertices: int | None = None
) -> MemoryEstimate:
    """What training an octree of at most ``leaves`` leaves on ``dataset`` takes.

    ``vertices`` None: VERTICES_PER_LEAF, and an octree that is largest when the training images are in tiles and their
    files' pixels were released; these count where they are more than what the octree still has to grow by, or
    cannot be released. With ``vertices`` the octree is there, and so are the images that it has next to it now.
    """
    other = other or OtherMemory()
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    octree, change = octree_bytes(leaves, sh_degree, vertices), change_bytes(leaves, sh_degree, vertices)
    growth = 0 if not dataset.can_reload or vertices is not None else change + octree // 2
    colours = 3 * other.backgrounds * pixels
    tiles = int(TILE_BYTES_PER_PIXEL * pixels + other.foreground_share * colours)
    return MemoryEstimate(
        base=BASE_BYTES + (FIELD_BYTES if other.field else 0),
        images=tiles + other.held_out_bytes + max(0, dataset.nbytes - growth),
        octree=octree,
        change=change,
        leaves=leaves,
        distillation=distillation_bytes(dataset, other.backgrounds, other.held_out_bytes) if other.field else 0,
        splats=other.splats,
    )


def require_memory(estimate: MemoryEstimate, available: int | None = None) -> None:
    """Refuse a run that cannot fit, by an InputError that says what to try.

    ``available``: bytes; by default what the machine has free.
    """
    free = available_memory() if available is None else available
    if free is not None and estimate.peak > SHARE * free:
        raise InputError(
            f"training would need {estimate.sentence()}, but {gib(free)} of memory are free; "
            "use a larger --downscale or a smaller octree (its finest level costs most)"
        )


def affordable_leaves(
    dataset: Dataset,
    sh_degree: int,
    least: int = 1 << 18,
    available: int | None = None,
    other: OtherMemory | None = None,
) -> int:
    """The most leaves with which training fits in the memory at hand; MOST_LEAVES where nobody tells how much that is.

    Raises:
        InputError: not even ``least`` leaves fit next to the images.
    """
    free = available_memory() if available is None else available
    if free is None:
        return MOST_LEAVES
    require_memory(estimate_training(dataset, least, sh_degree, other), free)
    low, high = least, MOST_LEAVES
    while high - low > 1:
        middle = (low + high) // 2
        fits = estimate_training(dataset, middle, sh_degree, other).peak <= SHARE * free
        low, high = (middle, high) if fits else (low, middle)
    return low


def largest_octree(levels: Sequence[int], view_pixels: int, photographs: bool = False) -> int:
    """Leaves to plan for in stages whose finest levels are ``levels``, the first of which is full from the start.

    Splitting every leaf of a trained octree makes about 12 * 4^level. Since only leaves of more than a pixel are split,
    LEAVES_PER_PIXEL (or PHOTOGRAPH_LEAVES_PER_PIXEL) times the pixels of one view are a bound of their own.
    """
    surface = max(min(8**level, 12 * 4**level) for level in levels)
    per_pixel = PHOTOGRAPH_LEAVES_PER_PIXEL if photographs else LEAVES_PER_PIXEL
    return max(8 ** levels[0], min(surface, int(per_pixel * view_pixels)))


def splits_within(split: np.ndarray, gain: np.ndarray, most: int | None) -> np.ndarray:
    """``split`` (n,) bool without the leaves whose splitting would make more than ``most`` leaves; None: no bound.

    Each split makes seven more leaves; those of the largest ``gain`` (n,) are kept, the first of equal ones. Says so.
    """
    wanted = np.flatnonzero(split)
    room = len(wanted) if most is None else max(0, (most - len(split)) // 7)
    if len(wanted) <= room:
        return split
    print(f"memory allows {most:,} leaves: {room:,} of {len(wanted):,} leaves are split, those with the largest error")
    kept = np.zeros(len(split), dtype=bool)
    kept[wanted[np.argsort(-gain[wanted], kind="stable")[:room]]] = True
    return kept


class OctreePlan:
    """How large the octree of a run may become, and what memory that takes next to everything else.

    Attributes: max_leaves, a bound on splitting; foreground_tiles, about so many training tiles show more than the background.
    """

    def __init__(
        self, config: Config, dataset: Dataset, held_out_bytes: int, splats: int = 0, leaves: int = 0, grows: bool = False
    ) -> None:  # fmt: skip
        """``splats``: bytes next to the program while splats are trained that it comes from, and become an octree of at most
        about ``leaves`` leaves; 0: there are none. ``grows``: whether its stages split these.

        Raises:
            InputError: not even a coarse octree fits in the memory at hand.
        """
        self._dataset, lens = dataset, dataset.cameras[0].intrinsics
        share = foreground_share(dataset, config.background or WHITE)
        pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
        self.foreground_tiles = max(share, 0.01) * pixels / TILE_RAYS
        in_field = config.init == "mlp" and len(dataset) <= config.field.few_views
        two = second_background(dataset, WHITE, bool(config.octree.two_backgrounds) or in_field) is not None
        backgrounds = 1 + two
        self._other = OtherMemory(
            share, held_out_bytes, field=config.init == "mlp", splats=splats, backgrounds=backgrounds
        )
        self._degree = max(config.octree.sh_degree or 0, config.octree.final_sh_degree)
        wanted = largest_octree(config.octree.levels, lens.width * lens.height, dataset.scene.is_unbounded)
        wanted = leaves if leaves and not grows else max(wanted, leaves)
        self.max_leaves = affordable_leaves(dataset, self._degree, least=min(wanted, 1 << 18), other=self._other)
        self._announced = min(wanted, self.max_leaves)

    def sentence(self) -> str:
        """The estimate in words."""
        return estimate_training(self._dataset, self._announced, self._degree, self._other).sentence()

    def outgrown(self, octree: Octree) -> str | None:
        """A sentence where ``octree`` has more leaves than were announced: a surface has about so many, a thick medium
        several times as many. Once for each larger octree."""
        if octree.n_leaves <= self._announced:
            return None
        self._announced = octree.n_leaves
        estimate = estimate_training(self._dataset, self._announced, self._degree, self._other, octree.n_vertices)
        return f"memory: the octree outgrew the estimate; now {estimate.sentence()}"
