"""The points of a model with their colours: where structure from motion found the same spot in several photographs.

COLMAP's come with the data set (``Dataset.points``); nerfstudio's transforms.json names a PLY file of them (``ply_file_path``).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nerfvol.datasets.dataset import Dataset
from nerfvol.files.atomic import read_json
from nerfvol.splats.points import PointCloud, read_points

SHORTEST_TRACK = 3
LARGEST_ERROR = 2.0
"""Pixels. Points seen by two photographs alone, or off by more, are as often wrong as right."""


def has_points(dataset: Dataset) -> bool:
    """Whether a model with points is where the dataset's poses are from."""
    return dataset.read_points is not None or _named_file(dataset) is not None


def _named_file(dataset: Dataset) -> Path | None:
    """The PLY file of points that a transforms.json names; None where there is none."""
    source = Path(dataset.source)
    if source.suffix != ".json" or not source.is_file():
        return None
    named = read_json(source).get("ply_file_path")
    if not isinstance(named, str) or "\0" in named or not named.lower().endswith(".ply"):
        return None
    path = source.parent / named
    return path if path.is_file() else None


def model_points(dataset: Dataset) -> tuple[PointCloud, str]:
    """The model's points and a sentence on what was found; of COLMAP's those with at least 3 observations and an error
    below 2 pixels.

    The cloud is empty where there is no model or no such point; the sentence says so.

    Raises:
        InputError: the file is there and damaged.
    """
    path = _named_file(dataset)
    if path is not None:
        cloud = read_points(path)
        if dataset.frame is not None:
            cloud = replace(cloud, positions=dataset.frame.into(cloud.positions))
        return cloud, f"{len(cloud)} points of {path}"
    points = dataset.points
    if points is None:
        return PointCloud.empty(), f"{dataset.source} comes without the points of a model"
    good = (points.track_lengths >= SHORTEST_TRACK) & (points.errors < LARGEST_ERROR)
    cloud = PointCloud(points.positions[good], (points.colours[good] / np.float32(255)).astype(np.float32))
    return (
        cloud,
        f"{len(cloud)} of the {len(good)} points of {points.source} (seen 3 times or more, error below 2 pixels)",
    )
