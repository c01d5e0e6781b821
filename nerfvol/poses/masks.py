"""Masks of photographs, by the conventions that training reads (datasets.listing): what they leave out gives no features
either, and their copies lie beside the copies of the photographs, upright and of the same size.

COLMAP looks for the mask of ``images/a.jpg`` as ``masks/a.jpg.png``, and so does training.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from nerfvol.datasets.images import image_header, image_size, map_threads, read_mask
from nerfvol.datasets.listing import MaskFile
from nerfvol.datasets.masks import MaskFinder
from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write
from nerfvol.poses.sources import HEIF_SUFFIXES, Photograph, formats_for


def find_masks(folder: Path, paths: Sequence[Path]) -> dict[str, tuple[MaskFile, ...]]:
    """The masks of the photographs ``paths`` of ``folder`` that have any, by the photograph's file name."""
    if not paths:
        return {}
    finder = MaskFinder(folder, paths[0].parent)
    found = {path.name: finder.of(path.name, path) for path in paths}
    return {name: masks for name, masks in found.items() if masks}


def copy_masks(
    masks: dict[str, tuple[MaskFile, ...]], originals: Path, photographs: Sequence[Photograph], folder: Path
) -> list[str]:
    """Writes ``folder/NAME.png`` for each of the ``photographs`` that has masks; a sentence for a person, where any has.

    ``originals``: the folder of the photographs as they came. Pixels that any of its masks leaves out are black.

    Raises:
        InputError: a mask is of another shape than its photograph, or all of them leave nothing.
    """
    masked = [photograph for photograph in photographs if masks.get(photograph.source)]
    for photograph in photographs:  # of an earlier call
        (folder / f"{photograph.name}.png").unlink(missing_ok=True)
    if not masked:
        return []
    folder.mkdir(exist_ok=True)

    def copy(photograph: Photograph) -> bool:
        size, orientation = upright_size(originals / photograph.source)
        kept = np.full((photograph.height, photograph.width), 255, np.uint8)
        for mask in masks[photograph.source]:
            painted_upright = orientation >= 5 and _wide(image_size(mask.path)) == _wide(size)
            pixels = read_mask(mask.path, size, 1 if painted_upright else orientation)
            pixels = pixels if mask.black_is_out else 255 - pixels
            small = Image.fromarray(pixels).resize((photograph.width, photograph.height), Image.Resampling.BOX)
            kept[np.asarray(small) < 255] = 0  # a pixel that shows a part of what is left out
        with atomic_write(folder / f"{photograph.name}.png") as temporary:
            Image.fromarray(kept).save(temporary, format="PNG")
        return bool(kept.any())

    if not any(map_threads(copy, masked)) and len(masked) == len(photographs):
        raise InputError(
            f"{masks[masked[0].source][0].path}: the masks of all {len(masked)} photographs leave nothing to look at"
        )
    return [
        f"{len(masked)} of {len(photographs)} photographs have masks: what those leave out gives no features, and takes no "
        "part in training and scores"
    ]


def upright_size(path: Path) -> tuple[tuple[int, int], int]:
    """((width, height) once upright, EXIF's orientation) of a photograph, HEIC too."""
    if path.suffix.lower() in HEIF_SUFFIXES:
        with Image.open(path, formats=formats_for(path)) as image:  # Pillow's plug-in turns these itself
            return image.size, 1
    header = image_header(path)
    return header.upright, header.orientation


def _wide(size: tuple[int, int]) -> bool | None:
    """Whether a picture is wider than high; None: it is square."""
    return None if size[0] == size[1] else size[0] > size[1]
