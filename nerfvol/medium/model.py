"""A medium as a model: its file, and views of it under any light. Drawing needs torch.

A file is a safetensors container with a JSON document: ``sigma_t`` (nx, ny, nz) float32, 1/u, and ``albedo`` (nx, ny, nz, 3)
float32 at the vertices of a grid over the box that the document states, and the lighting (``lighting.py``).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol import __version__
from nerfvol.cameras.camera import Camera
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD, WHITE
from nerfvol.errors import InputError, shown
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.kernels import ops
from nerfvol.medium.lighting import Lighting, parse_lighting
from nerfvol.native import need_torch
from nerfvol.octree.io import storage_of
from nerfvol.region import check_box
from nerfvol.views import beyond_reach

FORMAT = "nerfvol medium"
VERSION = 1
OUTPUTS = ("rgb", "opacity", "depth")
RUN = 1 << 14
"""Rays that are drawn at a time."""
STEP_VOXELS = 0.5
"""Length of the steps along rays in pictures, in distances of vertices."""

Float = NDArray[np.float32]


class MediumModel:
    """Extinction and albedo on a grid under suns, as a model (models.Model).

    sigma_t: (nx, ny, nz), 1/u; albedo: (nx, ny, nz, 3); box: (2, 3) the first and the last vertex, scene units; lighting:
    a camera's light is looked up there.
    """

    kind = "medium"

    def __init__(
        self, sigma_t: Float, albedo: Float, box: NDArray[np.float64], lighting: Lighting,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self.sigma_t, self.albedo, self.box, self.lighting = sigma_t, albedo, np.asarray(box, np.float64), lighting
        self.metadata = dict(metadata or {})

    def under(self, lighting: Lighting) -> MediumModel:
        """The same medium in another light."""
        return MediumModel(self.sigma_t, self.albedo, self.box, lighting, self.metadata)

    def moved(self, shift: NDArray[np.float64], scale: float) -> MediumModel:
        """The medium at scale * x + shift."""
        return MediumModel(
            self.sigma_t / np.float32(scale), self.albedo, self.box * scale + shift, self.lighting, self.metadata
        )

    def render(
        self,
        camera: Camera,
        background: Sequence[float] | None = None,
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = DEFAULT_EARLY_STOP,
        lod: float = DEFAULT_LOD,
    ) -> dict[str, Float]:
        """See models.Model: single scattering under the camera's light, else the first of the lighting; a picture as cameras
        take it, through the exposure and the sRGB curve. ``early_stop_eps`` and ``lod`` change nothing.

        Raises:
            InputError: torch is missing, or the camera's light is not among the lighting's.
        """
        if unknown := [name for name in outputs if name not in OUTPUTS]:
            raise InputError(f"a medium is drawn as {', '.join(OUTPUTS)}, not as {unknown[0]}")
        need_torch("drawing a medium")
        import torch

        from nerfvol.medium import transport

        ops.set_threads(ops.get_threads())  # torch may have been loaded only now
        colour = self.metadata.get("background", WHITE) if background is None else background
        beams, lobes = self.lighting.of(camera.light), self.lighting.phase
        parts = []
        with torch.no_grad():
            medium = self.on_torch()
            depths = [transport.depth_to_light(medium, beam.towards) for beam in beams]
            origin, directions = (torch.from_numpy(np.ascontiguousarray(rays)) for rays in camera.rays())
            step = STEP_VOXELS * float(medium.voxel.max())
            for d in directions.split(RUN):
                rays = origin.expand_as(d), d
                received = transport.receive(medium, rays, beams, lobes, step, depths=depths)
                straight = transport.displayed(received, self.lighting.exposure).clamp(0, 1)
                share = received.opacity[:, None]
                parts.append(
                    torch.cat(
                        [share * straight + (1 - share) * torch.tensor(colour), share, received.depth[:, None]], 1
                    )
                )
        lens = camera.intrinsics
        drawn = torch.cat(parts).to(torch.float32).numpy().reshape(lens.height, lens.width, 5)
        out = {"rgb": drawn[..., :3], "opacity": drawn[..., 3], "depth": drawn[..., 4]}
        return beyond_reach({name: np.ascontiguousarray(out[name]) for name in outputs}, lens, colour)

    def on_torch(self) -> Any:
        """The medium as the transport takes it (transport.Medium), float32."""
        import torch

        from nerfvol.medium.transport import Medium

        corners = torch.from_numpy(self.box.astype(np.float32))
        return Medium(
            torch.from_numpy(self.sigma_t), torch.from_numpy(self.albedo).movedim(-1, 0), corners[0], corners[1]
        )

    def at(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Extinction (n,), 1/u, and albedo (n, 3) at scene positions (n, 3), linear between vertices; 0 outside."""
        shape = np.array(self.sigma_t.shape)
        place = (points - self.box[0]) / (self.box[1] - self.box[0]) * (shape - 1)
        inside = ((place >= 0) & (place <= shape - 1)).all(1)
        low = np.clip(np.floor(place).astype(np.int64), 0, shape - 2)
        found = np.zeros((len(points), 4))
        both = np.concatenate([self.sigma_t[..., None], self.albedo], -1)
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, place - low, 1 - (place - low)), axis=1) * inside
            found += weight[:, None] * both[tuple((low + corner).T)]
        return found[:, 0], found[:, 1:]

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) corners of the grid."""
        return self.box

    def describe(self) -> dict[str, Any]:
        """Vertices, box, means of extinction and albedo (weighted by extinction), lights, bytes in memory."""
        weight = float(self.sigma_t.sum())
        mean = (self.sigma_t[..., None] * self.albedo).sum((0, 1, 2)) / max(weight, 1e-30)
        return {
            "vertices": int(self.sigma_t.size),
            "grid": list(self.sigma_t.shape),
            "aabb": self.box.tolist(),
            "largest_sigma_t": float(self.sigma_t.max()),
            "mean_albedo": [round(float(a), 4) for a in mean],
            "lights": len(self.lighting.lights),
            "bytes_in_memory": self.sigma_t.nbytes + self.albedo.nbytes,
        }

    def save(self, path: str | os.PathLike[str], storage: str = "compact") -> int:
        """See models.Model; media have one storage, and every name of an octree's means it.

        Raises:
            InputError: the path cannot be written, or a value is not finite.
        """
        storage_of(storage)
        arrays = {"sigma_t": np.ascontiguousarray(self.sigma_t), "albedo": np.ascontiguousarray(self.albedo)}
        for name, values in arrays.items():
            if not np.isfinite(values).all():
                raise InputError(f"cannot write {path}: some values of the medium's {name} are not finite")
        document = {
            "format": FORMAT, "version": VERSION, "nerfvol": __version__, "box": self.box.tolist(),
            "lighting": self.lighting.document(), "metadata": self.metadata,
        }  # fmt: skip
        return write_arrays(path, arrays, document)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MediumModel:
        """The model in a medium's file; InputError, one sentence, where it is none."""
        with ArrayFile(path, "medium file") as file:
            document = file.document
            if document.get("format") != FORMAT:
                raise file.fault(f"expected the format {FORMAT!r}, it says {shown(document.get('format'))}")
            if document.get("version") != VERSION:
                raise file.fault(f"this nerfvol reads version {VERSION}, it has {shown(document.get('version'))}")
            metadata = document.get("metadata")
            if not isinstance(metadata, dict):
                raise file.fault("its metadata is not a JSON object")
            try:
                box = check_box(document.get("box", ()), "its box")
                lighting = parse_lighting(document.get("lighting"), "its lighting")
            except InputError as error:
                raise file.fault(str(error)) from error
            shape = file.expect("sigma_t", "float32", (None, None, None))
            file.expect("albedo", "float32", (*shape, 3))
            sigma_t, albedo = file.read("sigma_t"), file.read("albedo")
        if min(shape) < 2:
            raise file.fault(f"its grid has {'x'.join(map(str, shape))} vertices, expected at least 2 along each axis")
        for name, values, most in (("sigma_t", sigma_t, 1e15), ("albedo", albedo, 1.0)):
            if not ((values >= 0) & (values <= most)).all():  # fails for what is no number as well
                raise file.fault(f"some values of {name!r} are not within 0 and {most:g}")
        return cls(sigma_t, albedo, box, lighting, metadata)
