"""Posed images from the formats in use: one file per on-disk format, one ``load_dataset`` for all.

What is named here is loaded when asked for, so that ``nerfvol.datasets.formats`` alone needs no numpy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfvol.datasets.dataset import Dataset as Dataset
    from nerfvol.datasets.formats import SPLITS as SPLITS
    from nerfvol.datasets.load import load_dataset as load_dataset
    from nerfvol.region import SceneBounds as SceneBounds

_HOMES = {
    "SPLITS": "nerfvol.datasets.formats",
    "Dataset": "nerfvol.datasets.dataset",
    "SceneBounds": "nerfvol.region",
    "load_dataset": "nerfvol.datasets.load",
}

__all__ = ["SPLITS", "Dataset", "SceneBounds", "load_dataset"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
