"""One view of a model: colours, depth, opacity and normals."""

from __future__ import annotations

import copy
import functools
import importlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cameras.through_lens import through_lens
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD, WHITE
from nerfvol.errors import InputError, shown
from nerfvol.kernels import ops
from nerfvol.kernels.splat_ops import render_splats
from nerfvol.kernels.splat_state import view_of
from nerfvol.kernels.state import OUTPUTS, in_squares
from nerfvol.octree.io import load_octree, save_octree, storage_of
from nerfvol.octree.tree import Octree
from nerfvol.splats.io import load_splats, save_splats
from nerfvol.splats.packing import PackedSplats, as_packed, unpack
from nerfvol.splats.ply import load_ply
from nerfvol.splats.rows32 import load_splat
from nerfvol.splats.splats import Splats
from nerfvol.splats.spz import load_spz

if TYPE_CHECKING:
    from nerfvol.models import Model

Float = NDArray[np.float32]
_FAR, _SMALLEST, _LARGEST = 16.0, 2.0**-8, 2.0**20
# Sides of the root cube from the origin, and sides in scene units, beyond which float32 loses digits that are seen.
SMALL = 1 / 64
"""Of its distance: a cell of a smaller side is shaded along one ray, where a picture need not be exact."""
NEAREST = 1e-3
"""Of the extent of splats: what is nearer to a camera is not drawn, where the file says no more."""
NOTEBOOK = "nerfvol.viewer.notebook"
"""Makes what a notebook shows of a model; imported where one asks."""


def render_image(
    octree: Octree,
    camera: Camera,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    outputs: Sequence[str] = OUTPUTS,
    lod: float = DEFAULT_LOD,
) -> dict[str, Float]:
    """One view: float32 arrays (H, W, 3) or (H, W) for the names in ``outputs`` (see ops.render_rays).

    ``rgb`` is not clipped. With 0 as ``early_stop_eps`` every ray goes to its end and is shaded along itself. A node of the
    octree that is smaller than ``lod`` pixels in the middle of the picture is drawn in place of its leaves; 0: none is.
    ValueError where ``lod`` is negative or not finite.
    """
    if not 0 <= lod < np.inf:
        raise ValueError(f"lod must be a number of pixels, 0 or more and finite, got {lod}")
    lens = camera.intrinsics
    near, pose, scale = _near_origin(octree, camera)
    view = ops.View(_directions(lens), pose, lens.height, lens.width)
    small = SMALL if early_stop_eps > 0 else 0.0
    out = ops.render_view(near, view, background, early_stop_eps, outputs, lod / max(lens.fx, lens.fy), small)
    if near is not octree:
        octree.prefiltered = near.prefiltered
        for name in ("depth", "median_depth"):
            if name in out:
                out[name] *= np.float32(scale)
    return beyond_reach(out, lens, background)


def _near_origin(octree: Octree, camera: Camera) -> tuple[Octree, NDArray[np.float64], float]:
    """Octree, pose and the length of a unit, scene units, as float32 can hold them; as they are for ordinary octrees.

    Kernels compute in float32 from the world's origin, of which map coordinates leave nothing of the digits of a scene.
    """
    middle = octree.origin + octree.size / 2
    far = bool(np.abs(middle).max() > _FAR * octree.size)
    extreme = not _SMALLEST <= octree.size <= _LARGEST
    if not (far or extreme):
        return octree, camera.c2w, 1.0
    scale, near, pose = (octree.size if extreme else 1.0), copy.copy(octree), camera.c2w.copy()
    near.origin, near.size = (octree.origin - middle) / scale, octree.size / scale
    near.density_scale = octree.density_scale * scale
    pose[:3, 3] = (pose[:3, 3] - middle) / scale
    return near, pose, scale


def beyond_reach(out: dict[str, Float], lens: Intrinsics, background: Sequence[float]) -> dict[str, Float]:
    """The picture with background, and nothing of anything else, where the lens does not reach."""
    seen = lens.seen()
    if seen is not None:
        for name, picture in out.items():
            picture[~seen] = np.asarray(background, np.float32) if name == "rgb" else 0.0
    return out


@functools.lru_cache(maxsize=1)
def _directions(lens: Intrinsics) -> Float:
    """Unit directions in camera axes, as :class:`ops.View` has them. Kept for a path."""
    return in_squares(lens.directions())


def surface_depth(image: Mapping[str, Float]) -> Float:
    """Mean distance (H, W) of what a pixel sees, sum_i w_i t_i / opacity; 0 where the opacity is below 1e-3."""
    opacity = image["opacity"]
    return np.where(opacity > 1e-3, image["depth"] / np.maximum(opacity, 1e-3), 0.0).astype(np.float32)


def unit_normal(image: Mapping[str, Float]) -> Float:
    """The mean normal (H, W, 3) at unit length; zero where there is none."""
    normal = image["normal"]
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)


def depth_range(model: Model, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Nearest and farthest distance that a few of ``cameras`` see, to scale pictures of depth by.

    The 1st and 99th percentile of small renders, a tenth of their distance farther apart: single floaters do not count.
    Where nothing is seen, the distances at which something could be.
    """
    seen = []
    for camera in cameras[:: max(1, len(cameras) // 4)]:
        width = min(camera.intrinsics.width, 96)
        small = camera.resized(width, max(1, round(camera.intrinsics.height * width / camera.intrinsics.width)))
        image = model.render(small, outputs=("depth", "opacity"))
        seen.append(surface_depth(image)[image["opacity"] >= 0.5])
    depths = np.concatenate(seen)
    if not len(depths):
        low, high = model.aabb()
        reach, middle = float(np.linalg.norm(high - low)), (low + high) / 2
        distances = [float(np.linalg.norm(camera.position - middle)) for camera in cameras]
        return max(min(distances) - reach / 2, 0.0), max(distances) + reach / 2
    near, far = (float(value) for value in np.percentile(depths, (1, 99)))
    return max(near - 0.1 * (far - near), 0.0), far + 0.1 * (far - near)


def notebook_html(model: Model) -> str:
    """What a notebook shows of a model: the viewer's page, or a picture of what is too large for a cell."""
    return importlib.import_module(NOTEBOOK).repr_html(model)


class OctreeModel:
    """An octree as a model (models.Model). ``octree`` is the octree itself."""

    kind = "octree"

    def __init__(self, octree: Octree, metadata: Mapping[str, Any] | None = None) -> None:
        self.octree, self.metadata = octree, dict(metadata or {})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> OctreeModel:
        """The model in an octree file; InputError where it is none."""
        return cls(*load_octree(path))

    @classmethod
    def load_plenoctree(cls, path: str | os.PathLike[str]) -> OctreeModel:
        """The model in a PlenOctree's .npz; InputError where it is none."""
        from nerfvol.octree.plenoctree import load_plenoctree

        return cls(load_plenoctree(path))

    def save(self, path: str | os.PathLike[str], storage: str = "compact") -> int:
        """See models.Model; storage: "float32", "float16" or "compact" (octree.io.save_octree)."""
        return save_octree(path, self.octree, self.metadata, storage_of(storage))

    def render(
        self,
        camera: Camera,
        background: Sequence[float] | None = None,
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = DEFAULT_EARLY_STOP,
        lod: float = DEFAULT_LOD,
    ) -> dict[str, Float]:
        """See models.Model."""
        colour = self.metadata.get("background", WHITE) if background is None else background
        return render_image(self.octree, camera, colour, early_stop_eps, outputs, lod)

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) corners of the box around all leaves."""
        half, center = self.octree.leaf_sizes()[:, None] / 2, self.octree.leaf_centers()
        return np.stack([(center - half).min(axis=0), (center + half).max(axis=0)])

    def _repr_html_(self) -> str:
        return notebook_html(self)

    def describe(self) -> dict[str, Any]:
        """Counts, leaves by level, the share of the root cube that leaves fill, their bounding box, bytes in memory."""
        octree = self.octree
        levels, counts = np.unique(octree.leaf_level, return_counts=True)
        arrays = octree.values, octree.corners, octree.leaf_ijk, octree.leaf_level
        masks = octree.node_mask, octree.leaf_mask, octree.first_node, octree.first_leaf
        return {
            "nodes": octree.n_nodes,
            "leaves": octree.n_leaves,
            "vertices": octree.n_vertices,
            "leaves_by_level": {int(level): int(count) for level, count in zip(levels, counts, strict=True)},
            "finest_grid": 2**octree.max_level,
            "filled_share": float((8.0 ** -levels.astype(float) * counts).sum()),
            "leaf_bounds": self.aabb().tolist(),
            "bytes_in_memory": sum(int(array.nbytes) for array in (*arrays, *masks)),
        }


class SplatModel:
    """Gaussian splats as a model (models.Model). ``splats``: Splats, or packed as the kernels keep them.

    ``metadata`` may hold "near": what is nearer to a camera's plane is not drawn, scene units.
    """

    kind = "splats"

    def __init__(self, splats: Splats | PackedSplats, metadata: Mapping[str, Any] | None = None) -> None:
        self.packed, self.metadata = as_packed(splats), dict(metadata or {})
        near = self.metadata.get("near")
        if near is not None and (type(near) not in (int, float) or not 0 < near < 1e30):
            raise InputError(f"splats: near must be a positive number, got {shown(near):.60}")
        self.near = NEAREST * self._extent() if near is None else float(near)

    @property
    def splats(self) -> Splats:
        """A copy as plain arrays."""
        return unpack(self.packed)

    def _extent(self) -> float:
        """Half the width of the middle 80 % of the means, scene units."""
        if not self.packed.n:
            return 1.0
        rows = [self.packed.params[:, k].reshape(-1)[: self.packed.n] for k in range(3)]
        return float(max(np.subtract(*np.quantile(row, (0.9, 0.1))) for row in rows)) / 2 or 1.0

    @functools.cached_property
    def _corners(self) -> NDArray[np.float64]:
        """(8, 3) of the box around all means, relative to the origin."""
        rows = [self.packed.params[:, k].reshape(-1)[: self.packed.n] for k in range(3)]
        ends = [(float(row.min()), float(row.max())) for row in rows]
        return np.array(np.meshgrid(*ends, indexing="ij")).reshape(3, 8).T

    def _nearest(self, camera: Camera) -> float:
        """Less than the depth of anything; the kernels tell depths apart over 16 octaves behind the near plane, so that a
        camera far away needs a far one."""
        if not self.packed.n:
            return 0.0
        return 0.99 * float(((self._corners + self.packed.origin - camera.position) @ camera.forward).min())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SplatModel:
        """The model in a file of splats, our own or, by its suffix, .ply, .spz or .splat; InputError where it is none."""
        reader = {".ply": load_ply, ".spz": load_spz, ".splat": load_splat}.get(Path(path).suffix.lower())
        splats, metadata = load_splats(path) if reader is None else (reader(path), {})
        if reader is not None and not splats.n:
            raise InputError(f"{path} holds no Gaussians, so there is nothing to draw")
        try:
            return cls(splats, metadata)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def save(self, path: str | os.PathLike[str], storage: str = "compact") -> int:
        """See models.Model; splats have one storage, and every name of an octree's means it."""
        storage_of(storage)
        return save_splats(path, self.splats, self.metadata)

    def render(
        self,
        camera: Camera,
        background: Sequence[float] | None = None,
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = DEFAULT_EARLY_STOP,
        lod: float = DEFAULT_LOD,
    ) -> dict[str, Float]:
        """See models.Model; through any lens. ``lod`` changes nothing: splats have no levels."""
        return self.drawn_by(render_splats, camera, background, outputs, early_stop_eps)

    def drawn_by(
        self,
        operator: Callable[..., dict[str, Float]],
        camera: Camera,
        background: Sequence[float] | None,
        outputs: Sequence[str],
        early_stop_eps: float,
    ) -> dict[str, Float]:
        """As :meth:`render`, by render_splats or render_points of splat_ops."""
        colour = self.metadata.get("background", WHITE) if background is None else background

        def pinhole(seen: Camera) -> dict[str, Float]:
            view = view_of(seen, self.packed.origin, max(self.near, self._nearest(seen)))
            return operator(self.packed, view, colour, early_stop_eps, outputs)

        return beyond_reach(through_lens(pinhole, camera), camera.intrinsics, colour)

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) corners of the box around the middle 98 % of the means, three deviations wide: few lie far out."""
        splats = self.splats
        low, high = (np.quantile(splats.means, q, axis=0) for q in (0.01, 0.99)) if splats.n else (0.0, 0.0)
        middle = ((splats.means >= low) & (splats.means <= high)).all(1)
        return splats.select(middle).aabb() if middle.any() else splats.aabb()

    def _repr_html_(self) -> str:
        return notebook_html(self)

    def describe(self) -> dict[str, Any]:
        """Count, degree, mode, quantiles of opacity and of the longest scale, bounding box, bytes in memory."""
        splats = self.splats
        opacity = 1 / (1 + np.exp(-splats.logits.astype(np.float64)))
        longest = np.exp(splats.log_scales.max(1, initial=-np.inf)) if splats.n else np.zeros(1)
        levels = (0.1, 0.5, 0.9)
        return {
            "splats": splats.n,
            "sh_degree": splats.sh_degree,
            "mode": splats.mode,
            "opacity_quantiles": np.quantile(opacity, levels).round(4).tolist() if splats.n else [],
            "scale_quantiles": [float(f"{x:.4g}") for x in np.quantile(longest, levels)],
            "aabb": self.aabb().tolist(),
            "bytes_in_memory": int(self.packed.params.nbytes),
        }
