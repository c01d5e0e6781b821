"""What RUN|FILE means to a command: the model, its background and the orbit around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nerfvol.cameras.paths import default_orbit, describe_orbit
from nerfvol.config.assemble import run_settings
from nerfvol.defaults import WHITE
from nerfvol.octree.tree import Octree


def resolve_background(given: Sequence[float] | None, target: str, metadata: Mapping[str, Any]) -> tuple[float, ...]:
    """The background to render on: as given, else the run's, else the octree file's, else white."""
    for candidate in (given, metadata.get("background"), run_settings(target).get("background")):
        if candidate is not None:
            from nerfvol.config.values import Colour, coerce

            return coerce(candidate, Colour, "background")
    return WHITE


def find_orbit(target: str, octree: Octree, metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """The orbit stored with the octree, else that of the run's training cameras, else one that shows the octree."""
    stored = metadata.get("orbit")
    if isinstance(stored, dict) and {"center", "radius", "elevation_deg"} <= stored.keys():
        return stored
    data = run_settings(target).get("data")
    if data and Path(data).exists():
        from nerfvol.datasets.load import load_dataset

        dataset = load_dataset(data, "train")
        return describe_orbit(dataset.cameras, dataset.scene.aabb)
    size = octree.leaf_sizes()[:, None]
    center = octree.leaf_centers()
    return default_orbit([(center - size / 2).min(axis=0), (center + size / 2).max(axis=0)])
