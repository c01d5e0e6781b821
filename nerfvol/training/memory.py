"""What training needs of the machine's memory, before it starts: an estimate, a refusal, or a bound on the octree.

The figures are sums of array sizes (docstrings say which), so they hold on any machine; tests compare them with what a
run really takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfvol.config.field import FieldConfig
from nerfvol.config.medium import MediumConfig
from nerfvol.config.splats import SplatConfig
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs, estimate_bytes
from nerfvol.datasets.tiles import foreground_share
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.field.layout import layers_of
from nerfvol.kernels.state import TILE_RAYS
from nerfvol.machine import available_memory
from nerfvol.octree.rows import BLOCKS
from nerfvol.octree.tree import Octree
from nerfvol.training.backgrounds import second_background
from nerfvol.training.splat_schedule import Schedule

BASE_BYTES = 160 << 20
"""The interpreter with numpy and Pillow (45 MiB resident), the kernels' records of a step, and what the allocator keeps: what
runs have at their peak next to the arrays named below."""
FIELD_BYTES = 310 << 20
"""torch, the code that it compiles and what the training of a field leaves behind: measured."""
DISTILL_BYTES = 290 << 20
"""Next to the field, the images and their pixels over the background (3 bytes each): an octree of candidates before
and after leaves were merged (0.9 million for lego)."""
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
BYTES_PER_LIT_PIXEL = 28
"""Per training pixel of a medium: a ray (six float32) and four bytes."""
BYTES_PER_LIT_SAMPLE = 80
"""Per step along a ray of a medium, looked up or not: position, thickness, transmittance, and what torch keeps of them."""
SURFACE_LEAVES_PER_SPLAT, SURFACE_LEAVES_PER_PIXEL, PHOTOGRAPH_SURFACE_LEAVES_PER_PIXEL = 32, 2.5, 10.0
"""Leaves of the octree that splats become, for each splat, and for each pixel of one view of an object or a photograph (in a
room: of all directions), whichever is less: leaves are no finer than pixels, and fill what all views show. Lego has 6 and 2.3,
at 800x800 19 and 1.6; bonsai 29 and 4.0, fern 29 and 5.6, at half its size 16 and 9.1."""
SURFACE_BYTES = 1300
"""A leaf of that octree, while it is made: cells of each Gaussian, sums of what they hold, values of corners. Fern takes 1,040
to 1,070, a wall of discs that overlap much 1,290."""
LOOK_BYTES = 40
"""Per pixel of the pictures of splats that an octree of their surfaces is made by: colours, opacity and distance, float32, and
what drawing them takes besides."""
SHARE = 0.9
"""Of the memory at hand that a run may plan for."""


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


def distillation_bytes(dataset: Dataset, backgrounds: int, held_out_bytes: int) -> int:
    """Bytes, next to the program, while a field is trained and distilled: images, and their pixels before each background."""
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    return dataset.nbytes + 3 * backgrounds * pixels + held_out_bytes + DISTILL_BYTES


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


SPLAT_BYTES = 3 * 4 + 84 + 6 * 81
"""Per Gaussian, next to its parameters and moments: statistics, a record, and gradients of six tiles (mostly 4 to 8)."""


PHOTOGRAPHS_SHARE = 0.5
"""Of the memory at hand that sizes and canvases of photographs may take; what is beyond is made again when it is needed."""


def photographs_bytes(available: int | None = None) -> int | None:
    """Most bytes that a run's photographs may keep next to the images that were read; None where nobody tells.

    ``available``: bytes; by default what the machine has free.
    """
    free = available_memory() if available is None else available
    return None if free is None else int(PHOTOGRAPHS_SHARE * free)


def photographs_held(dataset: Dataset, photographs: Photographs, factors: Sequence[int]) -> tuple[int, float]:
    """Bytes of the images of ``dataset`` and of all that ``photographs`` come to keep of them at the sizes 1 / ``factors``; and
    the share of what would be kept without their bound."""
    backgrounds = 1 + (photographs.second is not None)
    wanted, most = backgrounds * estimate_bytes(photographs.cameras, factors), photographs.most_bytes
    kept = wanted if most is None else min(wanted, most)
    return dataset.nbytes + kept, kept / wanted


def splat_bytes(schedule: Schedule, config: SplatConfig) -> int:
    """Bytes of the most splats of ``schedule`` under training: parameters, moments, gradients and statistics."""
    row = 4 * (11 + 3 * ((config.sh_degree or 0) + 1) ** 2)
    return schedule.most * (4 * row + SPLAT_BYTES)


def starting_splats_bytes(
    dataset: Dataset,
    photographs: Photographs,
    schedule: Schedule,
    config: SplatConfig,
    held_out_bytes: int,
    looked_at: int,
    leaves: int = 0,
) -> int:
    """Bytes, next to the program, of splats that an octree of ``leaves`` leaves is made of: while they are trained, and while
    pictures of ``looked_at`` pixels in all tell their surfaces; the photographs are there meanwhile."""
    held, _ = photographs_held(dataset, photographs, schedule.factors)
    return held + held_out_bytes + max(splat_bytes(schedule, config), LOOK_BYTES * looked_at + SURFACE_BYTES * leaves)


def surface_leaves(splats: int, view_pixels: int, photographs: bool = True) -> int:
    """Leaves, at most about, of the octree that so many ``splats`` become; ``view_pixels``: of a view that they suit."""
    per_pixel = PHOTOGRAPH_SURFACE_LEAVES_PER_PIXEL if photographs else SURFACE_LEAVES_PER_PIXEL
    return int(min(SURFACE_LEAVES_PER_SPLAT * splats, per_pixel * view_pixels))


def splat_memory(
    dataset: Dataset,
    photographs: Photographs,
    schedule: Schedule,
    config: SplatConfig,
    held_out_bytes: int,
    field_backgrounds: int = 0,
) -> str:
    """The estimate of training ``schedule.most`` splats, in words; InputError where that does not fit in the memory at hand.

    The images of ``dataset`` and what ``photographs`` hold are there already. field_backgrounds: that the pictures are seen
    before by a field that the splats begin with; 0: there is none.
    """
    held, kept = photographs_held(dataset, photographs, schedule.factors)
    images, splats = held + held_out_bytes, splat_bytes(schedule, config)
    base, field = BASE_BYTES, 0
    if field_backgrounds:
        base += FIELD_BYTES
        field = photographs.nbytes + distillation_bytes(dataset, field_backgrounds, held_out_bytes)
    peak = base + max(images + splats, field)
    part = "" if kept == 1 else f" ({kept:.0%} of the sizes; the others are made again for each step)"
    before = "" if photographs.second is None else " before two backgrounds"
    first = "" if not field else f", before that {gib(field)} to distil the field"
    sentence = (
        f"{gib(peak)} at its peak: photographs and {len(schedule.factors)} sizes of them{before} {gib(images)}{part}, up to "
        f"{schedule.most:,} splats {gib(splats)}, the program {gib(base)}{first}"
    )
    free, more = available_memory(), peak - dataset.nbytes - held_out_bytes - photographs.nbytes
    if free is not None and more > SHARE * free:
        raise InputError(
            f"training would need {sentence}, but {gib(free)} of memory are free; use a larger --downscale or fewer splats "
            "(--set splats.max_splats=N)"
        )
    return sentence


def field_backgrounds(config: Config, dataset: Dataset) -> int:
    """The backgrounds, one or two, that a field sees the pictures of ``dataset`` before."""
    return 1 + (second_background(dataset, WHITE, len(dataset) <= config.field.few_views) is not None)


def field_memory(dataset: Dataset, config: FieldConfig, held_out_bytes: int) -> str:
    """The estimate of training a field that is the product, in words."""
    shape = config.shape
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    backgrounds = 1 + (second_background(dataset, WHITE, len(dataset) <= config.few_views) is not None)
    images = dataset.nbytes + 3 * backgrounds * pixels // min(config.downscales) ** 2 + held_out_bytes
    entries = shape.hash_levels * shape.hash_features << shape.log2_table if shape.encoding == "hash" else 0
    network = sum(layer.numbers for layer in layers_of(shape))
    field = 4 * 4 * (entries + network) + 4 * config.grid_resolution**3 * (1 + dataset.scene.n_shells)
    peak = BASE_BYTES + images + field
    return f"{gib(peak)} at its peak: images {gib(images)}, the field {gib(field)}, the program {gib(BASE_BYTES)}"


def medium_memory(dataset: Dataset, config: MediumConfig, held_out_bytes: int) -> str:
    """The estimate of fitting a medium, in words."""
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    images = dataset.nbytes + BYTES_PER_LIT_PIXEL * pixels + held_out_bytes
    # Parameters, moments and gradients; sheared planes of up to four times as many vertices for each light
    medium = 4 * max(config.resolutions) ** 3 * (16 + 24 * config.lights)
    samples = BYTES_PER_LIT_SAMPLE * config.rays * round(2 * max(config.resolutions) / config.step_voxels)
    torch = 300 << 20
    peak = BASE_BYTES + torch + images + medium + samples
    return (f"{gib(peak)} at its peak: images {gib(images)}, the medium {gib(medium)}, samples {gib(samples)}, the program "
            f"{gib(BASE_BYTES + torch)}")  # fmt: skip


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


def gib(size: int) -> str:
    """Bytes in GiB with two digits."""
    return f"{size / 2**30:.2f} GiB"
