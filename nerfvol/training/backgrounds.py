"""What cut-out pictures are seen before while a model is trained: their background and the colour farthest from it.

Splats have both of all objects, fields and octrees of those that few views show. Before one colour whatever has that colour
costs nothing, in front of the object or beside it, and views do not show that it is there, few of them least of all. Before two
in turn opacity is the silhouette's: what is half transparent is wrong before one of them.
"""

from __future__ import annotations

from collections.abc import Sequence

from nerfvol.datasets.dataset import Dataset
from nerfvol.starts.hull import has_silhouettes

Colour = tuple[float, float, float]


def farthest(background: Sequence[float]) -> Colour:
    """The colour of the RGB cube that is farthest from ``background`` (3,) in [0, 1]."""
    r, g, b = (0.0 if c >= 0.5 else 1.0 for c in background)
    return r, g, b


def second_background(dataset: Dataset, background: Sequence[float], wanted: bool) -> Colour | None:
    """The second of the two colours; None: there is one alone, for a second is not wanted or not all pictures are cut out: an
    opaque one has its background painted in."""
    return farthest(background) if wanted and has_silhouettes(dataset, all_of_them=True) else None


def is_second(second: Colour | None, step: int, every: int = 2) -> bool:
    """Whether step ``step`` has the second colour behind, as one of ``every`` steps has."""
    return second is not None and step % every == 1
