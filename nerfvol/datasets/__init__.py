"""Posed images from the formats in use: one file per on-disk format, one ``load_dataset`` for all."""

from nerfvol.datasets.dataset import Dataset, SceneBounds
from nerfvol.datasets.load import SPLITS, load_dataset

__all__ = ["SPLITS", "Dataset", "SceneBounds", "load_dataset"]
