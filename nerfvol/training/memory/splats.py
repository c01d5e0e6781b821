"""The memory of splats and their photographs, and of the octree that they become."""

from __future__ import annotations

from collections.abc import Sequence

from nerfvol.config.splats import SplatConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs, estimate_bytes
from nerfvol.errors import InputError
from nerfvol.machine import available_memory
from nerfvol.training.memory.base import BASE_BYTES, SHARE, gib
from nerfvol.training.memory.fields import FIELD_BYTES, distillation_bytes
from nerfvol.training.splat_schedule import Schedule

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
