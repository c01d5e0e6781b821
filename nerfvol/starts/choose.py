"""Which start a dataset gets, and why: a row a start, asked in order; a name overrules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.splats.points import PointCloud
from nerfvol.starts.hull import has_silhouettes, hull_points
from nerfvol.starts.model_points import has_points, model_points
from nerfvol.starts.plane_sweep import SweepView, plane_sweep, sweep_factor
from nerfvol.starts.random import random_points
from nerfvol.starts.subject import Subject, subject_of

FEW_POINTS = 10_000
"""A model with fewer points gets those of a plane sweep next to them: 4,516 alone cost 1.2 dB (a fox by a phone, at equal
steps), with 11,084 (a bonsai) the sweep gains in steps what it costs in seconds."""


@dataclass(frozen=True, eq=False)
class Start:
    """``cloud``: the points, none where nothing was found; ``subject``: its distance and the depths of the scene;
    ``name``: the row of :data:`STARTS`; ``sentence``: what was chosen, why, and how many points came of it."""

    cloud: PointCloud
    subject: Subject
    name: str
    sentence: str


def choose_start(dataset: Dataset, photographs: Photographs, name: str | None = None, seed: int = 0) -> Start:
    """The points that splats of this dataset begin from.

    Objects whose pictures are cut out begin from the hull of their silhouettes, others from random points in their box;
    photographs from the points of their COLMAP model, else from a plane sweep; a model of fewer than 10,000 points gets the
    sweep's as well. Where nothing is found, what there is of a model, or random points, are used. ``name``: one of
    :data:`STARTS`.

    Raises:
        InputError: an unknown name, or what is asked for by name finds nothing.
    """
    if name is not None and name not in STARTS:
        raise InputError(f"the start must be one of {', '.join(STARTS)}, got {name!r}")
    subject = subject_of(dataset)
    chosen, why = (name, "as asked") if name else _suited(dataset)
    cloud, found = STARTS[chosen](dataset, photographs, subject, seed)
    if not len(cloud) and name:
        raise InputError(f"the start {name!r} cannot be used: {found}")
    if not len(cloud):
        cloud = random_points(dataset.scene, seed=seed)
        instead = f"{len(cloud)} random points in the scene's box instead"
        chosen, found = "random", f"{found}; {instead}{': expect little' if dataset.scene.is_unbounded else ''}"
    return Start(cloud, subject, chosen, f"start: {found} ({why})")


def _suited(dataset: Dataset) -> tuple[str, str]:
    """The row that suits a dataset and why."""
    if has_silhouettes(dataset):
        return "hull", "an object whose pictures are cut out"
    if not dataset.scene.is_unbounded:
        return "random", "an object without surroundings is seen whole"
    if not has_points(dataset):
        return "sweep", "photographs with poses alone"
    n = len(model_points(dataset)[0])
    if n < FEW_POINTS:
        return (
            "points+sweep",
            f"the model's {n:,} good points are few: below {FEW_POINTS:,} a sweep's beside them train better",
        )
    return "points", f"the model has points enough: {n:,}"


def sweep_views(photographs: Photographs) -> list[SweepView]:
    """The photographs at the size at which they are swept, without their padding."""
    lens = [camera.intrinsics for camera in photographs.cameras]
    factor = sweep_factor(int(np.median([i.width for i in lens])), int(np.median([i.height for i in lens])))
    held = factor in photographs.held
    views = [
        SweepView(np.ascontiguousarray(v.image[: v.height, : v.width]), v.camera) for v in photographs.level(factor)
    ]
    if not held:
        photographs.drop(factor)
    return views


_Found = tuple[PointCloud, str]


def _points(dataset: Dataset, photographs: Photographs, subject: Subject, seed: int) -> _Found:
    return model_points(dataset)


def _sweep(dataset: Dataset, photographs: Photographs, subject: Subject, seed: int) -> _Found:
    return plane_sweep(sweep_views(photographs), subject.near, subject.far, seed=seed)


def _both(dataset: Dataset, photographs: Photographs, subject: Subject, seed: int) -> _Found:
    (a, first), (b, second) = (found(dataset, photographs, subject, seed) for found in (_points, _sweep))
    return PointCloud.joined(a, b), f"{first}, and {second}"


def _hull(dataset: Dataset, photographs: Photographs, subject: Subject, seed: int) -> _Found:
    if not has_silhouettes(dataset):
        return PointCloud.empty(), "its pictures have no silhouettes: they are not cut out"
    cloud = hull_points(dataset, seed=seed)
    if not len(cloud):
        return cloud, "the silhouettes of its pictures have nothing in common"
    return cloud, f"{len(cloud):,} points on the hull of the silhouettes"


def _random(dataset: Dataset, photographs: Photographs, subject: Subject, seed: int) -> _Found:
    cloud = random_points(dataset.scene, seed=seed)
    return cloud, f"{len(cloud)} random points in the scene's box"


STARTS: dict[str, Callable[[Dataset, Photographs, Subject, int], _Found]] = {
    "points": _points,
    "sweep": _sweep,
    "points+sweep": _both,
    "hull": _hull,
    "random": _random,
}
