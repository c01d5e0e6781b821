"""Views held out together: an arc of neighbours, which says how good a model is away from the photographs it learnt from.

Every 8th view of a sequence has its nearest neighbours a step away on both sides among the training views; the middle of an
arc has none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.datasets.listing import HOLD_OUT_EVERY, Frame
from nerfvol.errors import InputError

HOLDOUTS = ("own", "arc")
"""own: what the files say, or every 8th view; arc: neighbours among the training views of that split."""
FEWEST = 2 * HOLD_OUT_EVERY


def hold_out_arc(frames: Sequence[Frame]) -> tuple[list[Frame], list[Frame], str]:
    """Frames kept, frames held out, and a sentence: an eighth of ``frames``, those nearest to the middle one by name.

    Nearest by the cameras' distance, equal ones by name. Both lists are in the order of names.

    Raises:
        InputError: there are fewer than 16 frames.
    """
    ordered = sorted(frames, key=lambda frame: frame.listed)
    if len(ordered) < FEWEST:
        raise InputError(f"an arc is held out of at least {FEWEST} training views, there are {len(ordered)}")
    places = np.stack([frame.c2w[:3, 3] for frame in ordered])
    middle = len(ordered) // 2
    distance = np.linalg.norm(places - places[middle], axis=1)
    distance[middle] = -1.0
    held = np.zeros(len(ordered), bool)
    held[np.argsort(distance, kind="stable")[: len(ordered) // HOLD_OUT_EVERY]] = True
    usual = float(np.median(_nearest(places, np.ones(len(ordered), bool))))
    gap = float(_nearest(places, ~held)[middle])
    sentence = (
        f"an arc is held out: the {held.sum()} of {len(ordered)} training views nearest to {ordered[middle].listed}, whose "
        f"nearest training camera is {gap / usual if usual else np.inf:.1f} times as far away as cameras are from each other"
    )
    kept = [frame for frame, out in zip(ordered, held, strict=True) if not out]
    return kept, [frame for frame, out in zip(ordered, held, strict=True) if out], sentence


def _nearest(places: NDArray[np.float64], among: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(n,) the distance of each place to the nearest other one of those chosen."""
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return distance[:, among].min(axis=1)
