"""Numbers that float32 can hold: a frame near the scene and of its size, for scenes in map coordinates or odd units.

Training works in float32, in which a map coordinate of five million has steps of half a unit. Where the scene lies far from
the origin or its unit is extreme, cameras, bounds and points are brought into a frame (in float64) before anything becomes
float32, and the finished model is brought back: x = scale * x' + shift. Ordinary scenes are left alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.points import ModelPoints
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds
from nerfvol.splats.splats import Splats

FAR = 16.0
"""Sides of the region of detail: nearer to the origin float32 loses four bits at most."""
SMALLEST, LARGEST = 2.0**-8, 2.0**12
"""Sides of the region of detail, scene units, between which no unit is too small or large."""

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Frame:
    """``shift`` (3,), scene units, and ``scale``, a power of two: x = scale * x' + shift."""

    shift: Float = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0

    @classmethod
    def of(cls, scene: SceneBounds) -> Frame:
        """The frame that suits a scene; the identity for ordinary ones."""
        side, center = scene.side, scene.center
        scale = 1.0 if SMALLEST <= side <= LARGEST else 2.0 ** round(math.log2(side) - 1)
        far = float(np.abs(center).max()) > FAR * side
        return cls(center if far else np.zeros(3), scale)

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        return self.scale == 1 and not self.shift.any()

    def into(self, points: Float) -> Float:
        """Points (..., 3) in scene units as the frame has them."""
        return points if self.is_identity else (np.asarray(points, np.float64) - self.shift) / self.scale

    def back(self, points: Float) -> Float:
        """Points (..., 3) of the frame in scene units."""
        return points if self.is_identity else np.asarray(points, np.float64) * self.scale + self.shift

    def camera_into(self, camera: Camera) -> Camera:
        """A camera in scene units as the frame has it."""
        return camera if self.is_identity else _placed(camera, self.into(camera.position))

    def scene_into(self, scene: SceneBounds) -> SceneBounds:
        """Bounds in scene units as the frame has them."""
        return scene if self.is_identity else _bounds(scene, self.into)

    def _moved(self, dataset: Dataset, move: Callable[[Float], Float], frame: Frame | None) -> Dataset:
        bounds, read = _bounds(dataset.scene, move), dataset.read_points

        def points() -> ModelPoints:
            assert read is not None
            found = read()
            return replace(found, positions=move(found.positions))

        cameras = [_placed(camera, move(camera.position)) for camera in dataset.cameras]
        return replace(
            dataset, cameras=cameras, scene=bounds, read_points=None if read is None else points, frame=frame
        )

    def dataset_into(self, dataset: Dataset) -> Dataset:
        """The dataset in the frame; the same images."""
        return dataset if self.is_identity else self._moved(dataset, self.into, self)

    def dataset_back(self, dataset: Dataset) -> Dataset:
        """A dataset of the frame in scene units."""
        return dataset if self.is_identity else self._moved(dataset, self.back, None)

    def octree_back(self, octree: Octree) -> Octree:
        """An octree of the frame in scene units; itself, changed: what it looks like stays."""
        if not self.is_identity:
            octree.origin = self.back(octree.origin)
            octree.size, octree.density_scale = octree.size * self.scale, octree.density_scale / self.scale
        return octree

    def octree_into(self, octree: Octree) -> Octree:
        """An octree in scene units as the frame has it; itself, changed."""
        if not self.is_identity:
            octree.origin = self.into(octree.origin)
            octree.size, octree.density_scale = octree.size / self.scale, octree.density_scale * self.scale
        return octree

    def splats_back(self, splats: Splats) -> Splats:
        """Splats of the frame in scene units."""
        return splats if self.is_identity else _scaled(splats, self.scale, self.back(splats.origin))

    def splats_into(self, splats: Splats) -> Splats:
        """Splats in scene units as the frame has them."""
        return splats if self.is_identity else _scaled(splats, 1 / self.scale, self.into(splats.origin))

    def orbit_back(self, orbit: Mapping[str, Any]) -> dict[str, Any]:
        """An orbit (cameras.paths) of the frame in scene units."""
        if self.is_identity:
            return dict(orbit)
        center = self.back(np.asarray(orbit["center"], np.float64))
        return {**orbit, "center": center.tolist(), "radius": orbit["radius"] * self.scale}


def _placed(camera: Camera, place: Float) -> Camera:
    pose = camera.c2w.copy()
    pose[:3, 3] = place
    return replace(camera, c2w=pose)


def _bounds(scene: SceneBounds, move: Callable[[Float], Float]) -> SceneBounds:
    outer = None if scene.background_cube is None else move(scene.background_cube)
    return replace(scene, aabb=move(scene.aabb), background_cube=outer)


def _scaled(splats: Splats, scale: float, origin: Float) -> Splats:
    log_scales = splats.log_scales + np.float32(math.log(scale))
    return replace(splats, means=splats.means * np.float32(scale), log_scales=log_scales, origin=origin)
