"""A neural field as a model: its file, and views of it drawn by the compiled kernels.

A file is a safetensors container with a JSON document: ``table`` and ``network`` of the field (kernels.field_state), exact, and
``occupied``, the bits of the cells that it may fill. Everything else follows from the network's shape, which the document
states. Positions of the field are those of the scene, moved by ``origin`` and divided by ``scale``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol import __version__
from nerfvol.cameras.camera import Camera
from nerfvol.config.assemble import assemble, to_plain
from nerfvol.config.field import FieldShape
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD, WHITE
from nerfvol.errors import InputError, shown
from nerfvol.field.layout import Domain, GridLevels, layers_of
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.kernels import field_ops
from nerfvol.kernels.field_model import CompiledField
from nerfvol.kernels.field_state import FieldState, March, Occupancy
from nerfvol.octree.io import storage_of
from nerfvol.octree.points import Y00
from nerfvol.views import beyond_reach

FORMAT = "nerfvol field"
VERSION = 1
LARGEST_VALUE = 1e15
OUTPUTS = ("rgb", "opacity", "depth", "normal")

Float = NDArray[np.float32]


class FieldModel:
    """A field with a hash grid or frequencies, as the kernels hold it, as a model (models.Model).

    field: in its own frame; origin (3,), scale: scene = origin + scale * own. Needs the compiled kernels.
    """

    kind = "field"

    def __init__(
        self,
        field: CompiledField,
        metadata: Mapping[str, Any] | None = None,
        origin: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
        scale: float = 1.0,
    ) -> None:
        self.field, self.metadata = field, dict(metadata or {})
        self.origin, self.scale = np.asarray(origin, np.float64), float(scale)

    @property
    def domain(self) -> Domain:
        """The field's region, in its own frame."""
        return self.field.state.domain

    def render(
        self,
        camera: Camera,
        background: Sequence[float] | None = None,
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = DEFAULT_EARLY_STOP,
        lod: float = DEFAULT_LOD,
    ) -> dict[str, Float]:
        """See models.Model; through any lens, the same bits for any number of threads. ``lod`` changes nothing.

        ``normal``: the direction in which the density falls at the mean depth, times the opacity; there is no
        ``median_depth``.
        """
        if unknown := [name for name in outputs if name not in OUTPUTS]:
            raise InputError(f"a field is drawn as {', '.join(OUTPUTS)}, not as {unknown[0]}")
        colour = self.metadata.get("background", WHITE) if background is None else background
        pose = camera.c2w.copy()
        pose[:3, 3] = (pose[:3, 3] - self.origin) / self.scale
        seen = replace(camera, c2w=pose)
        drawn = [name for name in OUTPUTS[:3] if name in outputs or name != "rgb" and "normal" in outputs]
        out = self.field.render(seen, colour, drawn, early_stop_eps)
        if "normal" in outputs:
            out["normal"] = self._normals(seen, out["depth"], out["opacity"])
        if "depth" in out:
            out["depth"] *= np.float32(self.scale)
        return beyond_reach({name: out[name] for name in outputs}, camera.intrinsics, colour)

    def _normals(self, camera: Camera, depth: Float, opacity: Float) -> Float:
        """(H, W, 3) opacity times the unit vector against the density's gradient, by differences over four cells: finer ones
        are noise inside a surface."""
        origin, directions = camera.rays()
        normals = np.zeros((depth.size, 3), np.float32)
        held = np.flatnonzero(opacity.reshape(-1) > 1e-3)
        share, directions = opacity.reshape(-1)[held], directions.reshape(-1, 3)[held]
        places = origin + directions * (depth.reshape(-1)[held] / share)[:, None]
        step = 4 * self.domain.half / self.field.march.occupancy.resolution
        slope = np.zeros((len(held), 3))
        for axis in range(3):
            move = step * np.eye(3)[axis]
            ahead, behind = (field_ops.evaluate(self.field.state, (places + s * move).astype(np.float32), values=False)[0]
                             for s in (1, -1))  # fmt: skip
            slope[:, axis] = behind.astype(np.float64) - ahead
        length = np.linalg.norm(slope, axis=1)
        normals[held] = slope * (share / np.maximum(length, 1e-30))[:, None]
        return normals.reshape(*depth.shape, 3)

    def density(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Extinction at scene positions (n, 3), 1/u: (n,); 0 outside the occupied cells."""
        return self.field.evaluate(self._own(points), values=False)[0].astype(np.float64) / self.scale

    def colour(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Colour at scene positions (n, 3), not clipped: (n, 3); the mean over all directions, and with an rgb head that seen
        from above; 0 outside the occupied cells."""
        own = self._own(points)
        if self.field.has_sh:
            sigma, sh = self.field.evaluate(own)
            assert sh is not None
            rows = 0.5 + Y00 * sh[:, :, 0].astype(np.float64)
        else:
            down = np.broadcast_to(np.array([0, 0, -1], np.float32), own.shape)
            sigma, rgb = field_ops.evaluate(self.field.state, own, down, self.field.march)
            assert rgb is not None
            rows = rgb.astype(np.float64)
        return np.where(sigma[:, None] > 0, rows, 0.0)

    def _own(self, points: NDArray[np.float64]) -> Float:
        return ((points - self.origin) / self.scale).astype(np.float32)

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) corners of the box around the occupied cells; of the inner cube where none is."""
        where, box = self.field.march.occupancy, []
        r, center = where.resolution, np.asarray(self.domain.center)
        for cube, cells in enumerate(where.cells()):
            if cube:  # its middle is the cube before
                cells[r // 4 : r - r // 4, r // 4 : r - r // 4, r // 4 : r - r // 4] = False
            held = [np.flatnonzero(cells.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
            if len(held[0]):
                ends = np.array([[rows[0], rows[-1] + 1] for rows in held]).T
                box.append(center + (2 * ends / r - 1) * self.domain.half * 2.0**cube)
        if not box:
            box.append(np.stack([center - self.domain.half, center + self.domain.half]))
        corners = np.stack(box)
        return np.stack([corners[:, 0].min(0), corners[:, 1].max(0)]) * self.scale + self.origin

    def describe(self) -> dict[str, Any]:
        """Numbers of grid and network, levels of the grid, layers, occupied share, bounding box, bytes in memory."""
        state, where = self.field.state, self.field.march.occupancy
        return {
            "parameters": state.table.size + state.network.size,
            "grid_levels": list(state.levels.resolutions) if state.levels else [],
            "layers": [f"{layer.inputs} to {layer.outputs}" for layer in state.layers],
            "sh_degree": self.field.sh_degree,
            "occupied_share": round(where.fraction, 6),
            "aabb": self.aabb().tolist(),
            "bytes_in_memory": state.nbytes + where.occupied.nbytes,
        }

    def save(self, path: str | os.PathLike[str], storage: str = "compact") -> int:
        """See models.Model; fields have one storage, and every name of an octree's means it.

        Raises:
            InputError: the path cannot be written, or a value is not finite.
        """
        storage_of(storage)
        state, march, domain = self.field.state, self.field.march, self.domain
        for name in ("table", "network"):
            if not np.isfinite(state.array(name)).all():
                raise InputError(f"cannot write {path}: some values of the field's {name} are not finite")
        document = {
            "format": FORMAT, "version": VERSION, "nerfvol": __version__, "shape": to_plain(state.shape),
            "center": list(domain.center), "half": domain.half, "outer": domain.outer, "origin": self.origin.tolist(),
            "scale": self.scale, "grid_resolution": march.occupancy.resolution, "march_steps": march.n_steps,
            "near": march.near_plane, "metadata": self.metadata,
        }  # fmt: skip
        arrays = {"table": state.table, "network": state.network, "occupied": march.occupancy.occupied}
        return write_arrays(path, arrays, document)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> FieldModel:
        """The model in a field's file; InputError, one sentence, where it is none or the kernels cannot hold it."""
        with ArrayFile(path, "field file") as file:
            numbers = _checked(file)
            if not isinstance(given := file.document.get("shape"), dict):
                raise file.fault(f"its shape is {shown(given)}, expected an object")
            try:
                shape = assemble(FieldShape, (given, "its shape"))
            except InputError as error:
                raise file.fault(str(error)) from error
            if (refused := field_ops.refusal(shape)) is not None:
                raise InputError(f"{path} cannot be drawn: {refused}")
            domain = Domain(numbers["center"], numbers["half"], numbers["outer"])
            resolution = numbers["grid_resolution"]
            entries = 0
            if shape.encoding == "hash":
                grid = GridLevels.of(shape.hash_levels, shape.log2_table, shape.hash_min, shape.finest)
                entries = grid.starts[-1]
            file.expect("table", "float32", (entries, shape.hash_features))
            file.expect("network", "float32", (sum(layer.numbers for layer in layers_of(shape)),))
            file.expect("occupied", "uint64", (domain.cubes * resolution**3 // 64,))
            state = FieldState(domain, shape)
            for name in ("table", "network"):
                values = file.read(name)
                if not (np.abs(values) <= LARGEST_VALUE).all():  # fails for what is no number as well
                    raise file.fault(f"some values of {name!r} are not finite or beyond {LARGEST_VALUE:g}")
                getattr(state, name)[...] = values
            occupancy = Occupancy.of_bits(domain, resolution, file.read("occupied"))
            metadata = file.document["metadata"]
        march = March(occupancy, numbers["march_steps"], numbers["near"])
        field = CompiledField(state, march, WHITE)
        return cls(field, metadata, numbers["origin"], numbers["scale"])


def _checked(file: ArrayFile) -> dict[str, Any]:
    """The numbers of a file's document; InputError where one is not what it should be."""
    document = file.document
    if document.get("format") != FORMAT:
        raise file.fault(f"expected the format {FORMAT!r}, it says {shown(document.get('format'))}")
    if document.get("version") != VERSION:
        raise file.fault(f"this nerfvol reads version {VERSION}, it has version {shown(document.get('version'))}")
    if not isinstance(document.get("metadata"), dict):
        raise file.fault("its metadata is not a JSON object")
    found: dict[str, Any] = {}
    for name in ("center", "origin"):
        value = document.get(name)
        if not isinstance(value, list) or len(value) != 3 or not all(_is_number(x, -1e15, 1e15) for x in value):
            raise file.fault(f"its {name} is {shown(value)}, expected three numbers")
        found[name] = (float(value[0]), float(value[1]), float(value[2]))
    ranges = {"half": (1e-15, 1e15), "scale": (1e-15, 1e15), "outer": (1, 2**20), "near": (0, 1e15)}
    for name, (low, high) in ranges.items():
        if not _is_number(document.get(name), low, high):
            raise file.fault(f"its {name} is {shown(document.get(name))}, expected a number from {low:g} to {high:g}")
        found[name] = float(document[name])
    for name, (low, high, factor) in {"grid_resolution": (8, 512, 4), "march_steps": (8, 1 << 16, 1)}.items():
        value = document.get(name)
        if type(value) is not int or not low <= value <= high or value % factor:
            of = f", a multiple of {factor}" if factor > 1 else ""
            raise file.fault(f"its {name} is {shown(value)}, expected a whole number from {low} to {high}{of}")
        found[name] = value
    return found


def _is_number(value: Any, low: float, high: float) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and low <= value <= high
