"""``.glb .obj .ply`` of a triangle mesh with a colour a vertex, made from what views of the model see (tsdf.py).

- glTF 2.0 binary: y up, colours linear (the specification's COLOR_0), a material without light (KHR_materials_unlit).
- OBJ: ``v x y z r g b``, colours as in the training images, as MeshLab writes and Blender reads; y up.
- PLY: the scene's axes unless ``up`` says else, colours bytes as in the training images.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.export.part import Up, turn_to
from nerfvol.export.surface import Cameras, bytes_of_shots, shoot
from nerfvol.export.tsdf import Mesh, mesh_of_shots, require_library
from nerfvol.files.atomic import atomic_write
from nerfvol.files.pictures import srgb_to_linear
from nerfvol.models import Model
from nerfvol.splats.near import offset_for
from nerfvol.splats.plyfile import write_ply

VIEWS = 60
RESOLUTION = 256
_RUN = 1 << 16  # lines of text at a time
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123  # glTF's names of types


def memory(
    model: Model, views: int = VIEWS, cameras: Cameras | None = None, resolution: int = RESOLUTION, up: Up | None = None
) -> int:
    """Bytes that writing takes: the views, the dense grid with its masks, and the voxels near surfaces."""
    return bytes_of_shots(views, cameras, resolution) + 12 * resolution**3 + 200 * 60 * resolution**2


def write(
    model: Model, path: str | os.PathLike[str], views: int = VIEWS, cameras: Cameras | None = None,
    resolution: int = RESOLUTION, up: Up | None = None,
) -> int:  # fmt: skip
    """The mesh from ``views`` views with ``resolution`` voxels along the longest side of what there is.

    Raises:
        InputError: scikit-image is missing, there is no surface, or the path cannot be written.
    """
    require_library()
    ending = Path(path).suffix.lower()
    shots = shoot(model, views, cameras, resolution)
    low, high = model.aabb()
    seen = np.concatenate([shot.points(0.5)[0] for shot in shots])
    a, b = np.quantile(seen, (0.005, 0.995), axis=0)
    reach = 0.5 * (b - a).max()  # backgrounds of photographs lie far beyond what is seen closely
    mesh = mesh_of_shots(shots, np.maximum(low, a - reach), np.minimum(high, b + reach), resolution)
    turn = turn_to(model, up or ("none" if ending == ".ply" else "+y"))
    return _WRITERS[ending](path, Mesh(mesh.vertices @ turn.T, mesh.faces, mesh.colours))


_DIGITS = 1e-5
"""Of the mesh's extent: where float32 rounds vertices by more, formats that can hold more of them."""


def _offset(mesh: Mesh) -> NDArray[np.float64]:
    """(3,) what vertices are to be relative to; 0 where float32 holds them as they are."""
    return offset_for(mesh.vertices, _DIGITS * float(np.ptp(mesh.vertices, axis=0).max(initial=0.0)))


def _write_ply(path: str | os.PathLike[str], mesh: Mesh) -> int:
    kind = np.float64 if _offset(mesh).any() else np.float32
    columns: dict[str, NDArray] = {n: mesh.vertices[:, k].astype(kind) for k, n in enumerate("xyz")}
    columns |= {n: _bytes(mesh.colours)[:, k] for k, n in enumerate(("red", "green", "blue"))}
    return write_ply(path, [], columns, mesh.faces)


def _write_obj(path: str | os.PathLike[str], mesh: Mesh) -> int:
    vertex = "{:.15g} {:.15g} {:.15g}" if _offset(mesh).any() else "{:.6g} {:.6g} {:.6g}"
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii") as file:
        file.write("# nerfvol; colours sRGB\n")
        rows = np.hstack([mesh.vertices, mesh.colours])
        for at in range(0, len(rows), _RUN):
            file.writelines(f"v {vertex} {{:.4f}} {{:.4f}} {{:.4f}}\n".format(*row) for row in rows[at : at + _RUN])
        for at in range(0, len(mesh.faces), _RUN):
            file.writelines("f {} {} {}\n".format(*face) for face in mesh.faces[at : at + _RUN] + 1)
        return file.tell()


def _write_glb(path: str | os.PathLike[str], mesh: Mesh) -> int:
    offset = _offset(mesh)
    vertices = (mesh.vertices - offset).astype("<f4")
    node = {"mesh": 0, "name": "nerfvol"} | ({"translation": offset.tolist()} if offset.any() else {})
    colours = np.full((len(vertices), 4), 65535, "<u2")  # bytes would show steps where it is dark: they are linear
    colours[:, :3] = np.rint(65535 * srgb_to_linear(np.clip(mesh.colours, 0, 1)))
    parts = [vertices.tobytes(), colours.tobytes(), mesh.faces.astype("<u4").tobytes()]
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    accessor = lambda view, kind, count, shape, **more: {  # noqa: E731
        "bufferView": view, "componentType": kind, "count": count, "type": shape, **more,
    }  # fmt: skip
    low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
    document = {
        "asset": {"version": "2.0", "generator": "nerfvol"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True,
            "extensions": {"KHR_materials_unlit": {}},
        }],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": at, "byteLength": len(part), "target": target}
            for at, part, target in zip(offsets, parts, (34962, 34962, 34963), strict=False)
        ],
        "accessors": [
            accessor(0, _FLOAT, len(vertices), "VEC3", min=low, max=high),
            accessor(1, _USHORT, len(vertices), "VEC4", normalized=True),
            accessor(2, _UINT, 3 * len(mesh.faces), "SCALAR"),
        ],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + offsets[-1]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", offsets[-1], b"BIN\0"))
        for part in parts:
            file.write(part)
    return size


def _bytes(colours: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)


_WRITERS: dict[str, Callable[[str | os.PathLike[str], Mesh], int]] = {
    ".ply": _write_ply, ".obj": _write_obj, ".glb": _write_glb,
}  # fmt: skip
