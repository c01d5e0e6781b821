"""Point clouds as models, and what a PLY file is: Gaussians or points."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.kernels.splat_ops import render_points, render_splats
from nerfvol.octree.io import storage_of
from nerfvol.splats.io import save_splats
from nerfvol.splats.ply import is_splat_ply
from nerfvol.splats.points import PointCloud, read_points, splats_of_points
from nerfvol.splats.splats import Splats
from nerfvol.views import SplatModel

if TYPE_CHECKING:
    from nerfvol.models import Model

Float = NDArray[np.float32]
Composite = Literal["surface", "over"]
_SCALES: dict[Composite, float] = {"surface": 0.5, "over": 0.6}
"""A point's deviation in distances to its neighbours. Laid over each other, Gaussians of 0.5 let 6 % of what is behind a screen
through and ripple by 1 %, those of 0.6 1.5 % and 0.4 %; averaged, the narrower ones are sharper and close a surface as well."""


class PointModel:
    """A point cloud as a model (models.Model), drawn by EWA splatting: a point is as wide as its neighbours are far.

    ``composite``: "surface": points at one depth are averaged first (kernels.point_reference), which no gap or overlap of
    points shows in; "over": almost opaque Gaussians one over the other, as viewers of splats draw them.
    """

    kind = "points"

    def __init__(
        self, cloud: PointCloud, metadata: Mapping[str, Any] | None = None, composite: Composite = "surface"
    ) -> None:
        self.cloud, self.metadata = cloud, dict(metadata or {})
        self.composite: Composite = composite
        self._model = SplatModel(splats_of_points(cloud, _SCALES[composite]), metadata)

    @property
    def near(self) -> float:
        """What is nearer to a camera's plane is not drawn, scene units."""
        return self._model.near

    @property
    def splats(self) -> Splats:
        """Gaussians that show the cloud in viewers of splats, a copy."""
        splats = self._model.splats
        return replace(splats, log_scales=splats.log_scales + math.log(_SCALES["over"] / _SCALES[self.composite]))

    def render(
        self,
        camera: Camera,
        background: Sequence[float] | None = None,
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = DEFAULT_EARLY_STOP,
        lod: float = DEFAULT_LOD,
    ) -> dict[str, Float]:
        """See models.Model; through any lens. ``lod`` changes nothing."""
        operator = render_points if self.composite == "surface" else render_splats
        return self._model.drawn_by(operator, camera, background, outputs, early_stop_eps)

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) corners of the box around the middle 98 % of the points, as for splats."""
        return self._model.aabb()

    def describe(self) -> dict[str, Any]:
        """Count, whether there are normals, the median distance that points are drawn apart, bounding box, bytes."""
        return {
            "points": len(self.cloud),
            "normals": self.cloud.normals is not None,
            "radius": float(f"{np.exp(np.median(self._model.splats.log_scales[:, 0])):.4g}"),
            "aabb": self.aabb().tolist(),
            "bytes_in_memory": int(self._model.packed.params.nbytes + self.cloud.positions.nbytes),
        }

    def save(self, path: str | os.PathLike[str], storage: str = "compact") -> int:
        """The Gaussians that draw the points, as a file of splats; ``storage`` as in SplatModel.save."""
        storage_of(storage)
        return save_splats(path, self.splats, self.metadata)


def load_ply_model(path: str | os.PathLike[str]) -> Model:
    """The Gaussians (3DGS layout) or the coloured points of a PLY file.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    if is_splat_ply(path):
        return SplatModel.load(path)
    cloud = read_points(path)
    try:
        return PointModel(cloud)
    except InputError as error:
        raise InputError(f"{path} cannot be drawn: {error}") from error
