"""A few training pictures, small, by which the kind of scene is judged; every split of a scene by the same ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.datasets.frames import View
from nerfvol.datasets.images import UInt8, map_threads, read_small, turned
from nerfvol.errors import InputError
from nerfvol.files.unchanged import while_unchanged

MOST_JUDGED = 24
"""Training pictures that the kind of scene is judged by, ..."""
JUDGED_SIZE = 128
"""... at about so many pixels along the shorter side."""
MOST_KEPT = 64 << 20
"""Bytes of them that are kept whole until they are wanted so."""


@dataclass(eq=False)
class Sampled:
    """A picture to look at, small, and the whole one until it is taken, as both came from the file."""

    small: UInt8
    whole: UInt8 | None

    def take(self) -> UInt8 | None:
        """The whole picture, once."""
        whole, self.whole = self.whole, None
        return whole


@while_unchanged(MOST_JUDGED)
def _sampled(path: Path) -> Sampled:
    """Every split of a scene is judged by the same pictures."""
    small, whole = read_small(path, JUDGED_SIZE)
    # Where the picture itself is small enough it is what is looked at: it would stay for as long as that does.
    kept = whole is not None and whole is not small and whole.nbytes <= MOST_KEPT // MOST_JUDGED
    return Sampled(small, whole if kept else None)


def sample(views: Sequence[View], threads: int | None) -> tuple[list[tuple[View, UInt8]], dict[Path, Sampled]]:
    """A few training views with their pictures, small, by which the kind of scene is judged; and these as their files have
    them, with what was decoded whole."""
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, MOST_JUDGED).round().astype(int))]

    def small(view: View) -> Sampled | InputError:
        try:
            return _sampled(view.path)
        except InputError as error:
            return error

    found = list(zip(chosen, map_threads(small, chosen, threads), strict=True))
    wrong = [error for _, error in found if isinstance(error, InputError)]
    if len(wrong) == len(found):
        raise wrong[0]
    good = [(view, sampled) for view, sampled in found if isinstance(sampled, Sampled)]
    return [(view, turned(s.small, view.orientation)) for view, s in good], {view.path: s for view, s in good}


def _seen_small(view: View, picture: UInt8) -> NDArray[np.bool_] | None:
    """Which pixels (h, w) of the view's small picture count; None: all."""
    mask = view.seen()
    if mask is None:
        return None
    rows, columns = (
        ((np.arange(n) + 0.5) * have / n).astype(int) for n, have in zip(picture.shape[:2], mask.shape, strict=True)
    )
    return mask[rows[:, None], columns] > 127


def seen_small(judged: Sequence[tuple[View, UInt8]]) -> tuple[list[UInt8], list[NDArray[np.bool_] | None]]:
    """The small pictures (h, w, 3 or 4) and which of their pixels (h, w) count, None for all; without those whose masks cannot
    be read, of which the reading of the whole set will say more.

    Raises:
        InputError: no mask can be read.
    """
    pictures, seen, wrong = [], [], []
    for view, picture in judged:
        try:
            seen.append(_seen_small(view, picture))
        except InputError as error:
            wrong.append(error)
        else:
            pictures.append(picture)
    if wrong and not pictures:
        raise wrong[0]
    return pictures, seen
