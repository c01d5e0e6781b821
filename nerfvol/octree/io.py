"""Octree files: topology and vertex values in one safetensors file with a JSON document (docs/file_format.md).

Loading checks everything a hostile file could say before memory is spent on it: header, dtypes and shapes first, then
the topology (a vertex count that the masks cannot have is refused), then the values, which must be finite.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Literal, cast, get_args

import numpy as np

from nerfvol import __version__
from nerfvol.errors import InputError, shown
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.machine import require_memory
from nerfvol.octree import codec
from nerfvol.octree.rows import BLOCKS
from nerfvol.octree.topology import number_corners
from nerfvol.octree.tree import Octree

FORMAT = "nerfvol octree"
VERSION, MAPPED_VERSION = 1, 2
COLOUR_CONVENTION = "half_plus_sh"
DENSITY_CONVENTION = "explin"
LARGEST_VALUE = 1e6
"""Bound on |raw density| and |SH coefficient| when writing: far beyond any scene, far below float32 overflow. Files are
read up to twice that, since quantisation may round a value at the bound upwards."""

Storage = Literal["float32", "float16", "compact", "mapped"]


def storage_of(name: str) -> Storage:
    """``name`` where it is one of Storage; InputError where it is not."""
    if name not in get_args(Storage):
        raise InputError(f"storage should be {', '.join(get_args(Storage)[:-1])} or mapped, got {name!r}")
    return cast(Storage, name)


def save_octree(
    path: str | os.PathLike[str], octree: Octree, metadata: Mapping[str, Any], storage: Storage = "float32"
) -> int:
    """Write ``octree`` to ``path`` atomically and return the file's size in bytes.

    ``metadata`` is JSON-able and comes back from :func:`load_octree`; by custom it has "provenance" (data, command,
    seed, seconds), "background" and "orbit". ``storage``: "float32" is exact; "float16" halves the file; "compact" is
    quantised and deflated to about a tenth (see nerfvol.octree.codec); "mapped" is exact and holds every array as the
    kernels read it, so that it opens without a copy and processes share its pages (twice the size of "float32").

    Raises:
        InputError: no such storage, the path cannot be written, a value is not finite, or leaves that touch do not share their
            vertices (lod.cut, lod.at_level): a file says where leaves are, and their vertices follow from that.
    """
    storage = storage_of(storage)
    corners, n_vertices = number_corners(octree.leaf_level, octree.leaf_ijk)
    if n_vertices != octree.n_vertices or not np.array_equal(corners, octree.corners):
        raise InputError(
            f"cannot write {path}: leaves of this octree that touch do not share their vertices, as a file's do; "
            "nerfvol.octree.lod.simplified makes one that can be written"
        )
    density, sh = octree.density, octree.sh
    if not (_bounded(density) and _bounded(sh)):
        raise InputError(f"cannot write {path}: the octree holds values beyond {LARGEST_VALUE:g} or not finite")
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": MAPPED_VERSION if storage == "mapped" else VERSION,
        "nerfvol": __version__,
        "storage": storage,
        "colour": COLOUR_CONVENTION,
        "density": DENSITY_CONVENTION,
        "density_scale": octree.density_scale,
        "sh_degree": octree.sh_degree,
        "origin": [float(x) for x in octree.origin],
        "size": octree.size,
        "aabb": [[float(x) for x in octree.origin], [float(x) + octree.size for x in octree.origin]],
        "n_nodes": octree.n_nodes,
        "n_leaves": octree.n_leaves,
        "n_vertices": octree.n_vertices,
        "metadata": dict(metadata),
    }
    arrays = {"node_mask": octree.node_mask, "leaf_mask": octree.leaf_mask}
    if storage == "compact":
        planes, document["codec"] = codec.encode(density, sh)
        arrays.update(planes)
    elif storage == "mapped":
        arrays.update({name: getattr(octree, name) for name in _MAPPED})
    else:
        largest = np.finfo(storage).max
        arrays["density"] = np.clip(density, -largest, largest).astype(storage)
        arrays["sh"] = np.clip(sh, -largest, largest).astype(storage)
    return write_arrays(path, arrays, document)


_MAPPED = ("leaf_level", "leaf_ijk", "corners", "values")
"""What a mapped file holds beside the masks: see Octree's attributes."""


def load_octree(path: str | os.PathLike[str]) -> tuple[Octree, dict[str, Any]]:
    """The octree in ``path`` and the metadata it was saved with.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    with ArrayFile(path, "octree file") as file:
        frame = _check_document(file)
        n_vertices, degree = frame.pop("n_vertices"), frame["sh_degree"]
        _check_arrays(file, n_vertices, (degree + 1) ** 2)
        if file.document["storage"] == "mapped":
            return _map_octree(file, frame), file.document["metadata"]
        node_mask, leaf_mask = file.read("node_mask"), file.read("leaf_mask")
        # Every leaf's lowest corner is its own, and a leaf has eight corners: a bound that holds before any is counted.
        n_leaves = int(np.unpackbits(leaf_mask).sum())
        if not n_leaves < n_vertices <= 8 * n_leaves:
            raise file.fault(f"it declares {n_vertices} vertices, which {n_leaves} leaves cannot have")
        row, channels = 64 * BLOCKS[degree], 1 + 3 * (degree + 1) ** 2
        require_memory(n_vertices * (row + 8 * channels) + 128 * n_leaves, str(path))  # a bomb is refused, not tried
        try:
            octree = Octree(node_mask, leaf_mask, **frame)
        except InputError as error:
            raise file.fault(str(error)) from error
        if octree.n_vertices != n_vertices:
            raise file.fault(f"it declares {n_vertices} vertices, its masks make {octree.n_vertices}")
        octree.density, octree.sh = _read_values(file, n_vertices, (degree + 1) ** 2)
        return octree, file.document["metadata"]


def _map_octree(file: ArrayFile, frame: dict[str, Any]) -> Octree:
    try:
        octree = Octree.from_parts(*(file.map(name) for name in ("node_mask", "leaf_mask", *_MAPPED)), **frame)
    except InputError as error:
        raise file.fault(str(error)) from error
    if not _bounded(octree.values, 2 * LARGEST_VALUE):
        raise file.fault(f"some values are not finite or beyond {LARGEST_VALUE:g}")
    return octree


def describe_octree(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON document in the header of ``path``, checked, without the arrays."""
    with ArrayFile(path, "octree file") as file:
        _check_document(file)
        return file.document


def _check_document(file: ArrayFile) -> dict[str, Any]:
    """The arguments of Octree, and n_vertices, from the file's document."""
    document = file.document
    if document.get("format") != FORMAT:
        raise file.fault(f"expected the format {FORMAT!r}, it says {shown(document.get('format'))}")
    if document.get("version") not in (VERSION, MAPPED_VERSION):
        known = f"versions {VERSION} and {MAPPED_VERSION}"
        raise file.fault(f"this nerfvol reads {known}, it has version {shown(document.get('version'))}")
    for key, known in (("colour", COLOUR_CONVENTION), ("density", DENSITY_CONVENTION)):
        if document.get(key) != known:
            raise file.fault(f"its {key} convention is {shown(document.get(key))}, expected {known!r}")
    if document.get("storage") not in get_args(Storage):
        raise file.fault(
            f"its storage is {shown(document.get('storage'))}, expected one of {', '.join(get_args(Storage))}"
        )
    if not isinstance(document.get("metadata"), dict):
        raise file.fault("its metadata is not a JSON object")
    box = document.get("aabb")
    if box is not None and not (
        isinstance(box, list) and len(box) == 2
        and all(isinstance(c, list) and len(c) == 3 and all(_is_number(x, -1e13, 1e13) for x in c) for c in box)
    ):  # fmt: skip
        raise file.fault(f"its aabb is {shown(box)}, expected two corners of three numbers")
    if not isinstance(document.get("nerfvol", ""), str):
        raise file.fault(f"it says that nerfvol {shown(document['nerfvol'])} wrote it, expected a version")
    degree, n_vertices = document.get("sh_degree"), document.get("n_vertices")
    if type(degree) is not int or not 0 <= degree <= 3:
        raise file.fault(f"its sh_degree is {shown(degree)}, expected 0, 1, 2 or 3")
    if type(n_vertices) is not int or n_vertices < 0:
        raise file.fault(f"its n_vertices is {shown(n_vertices)}, expected a count")
    origin = document.get("origin")
    if not isinstance(origin, list) or len(origin) != 3 or not all(_is_number(x, -1e12, 1e12) for x in origin):
        raise file.fault(f"its origin is {shown(origin)}, expected three finite numbers")
    for key in ("size", "density_scale"):
        if not _is_number(document.get(key), 1e-12, 1e12):
            raise file.fault(f"its {key} is {shown(document.get(key))}, expected a positive number")
    return {
        "n_vertices": n_vertices, "sh_degree": degree, "origin": origin,
        "size": document["size"], "density_scale": document["density_scale"],
    }  # fmt: skip


def _check_arrays(file: ArrayFile, n_vertices: int, basis_dim: int) -> None:
    """dtypes and shapes against the document, before any array is read."""
    (n_nodes,) = file.expect("node_mask", "uint8", (None,))
    file.expect("leaf_mask", "uint8", (n_nodes,))
    storage = file.document["storage"]
    if storage == "mapped":
        (n_leaves,) = file.expect("leaf_level", "int8", (None,))
        file.expect("leaf_ijk", "int32", (n_leaves, 3))
        file.expect("corners", "int32", (n_leaves, 8))
        file.expect("values", "float32", (n_vertices, 16 * BLOCKS[file.document["sh_degree"]]))
        if not n_leaves:
            raise file.fault("it has no leaves")
    elif storage == "compact":
        for name in codec.plane_names(basis_dim):
            file.expect(name, "uint8", (None,))
    else:
        file.expect("density", storage, (n_vertices,))
        file.expect("sh", storage, (n_vertices, 3, basis_dim))


def _read_values(file: ArrayFile, n_vertices: int, basis_dim: int) -> tuple[np.ndarray, np.ndarray]:
    if file.document["storage"] == "compact":
        parameters = file.document.get("codec")
        if not isinstance(parameters, dict):
            raise file.fault("its codec parameters are missing")
        try:
            density, sh = codec.decode(n_vertices, basis_dim, file.read, parameters)
        except InputError:
            raise
        except ValueError as error:
            raise file.fault(str(error)) from error
    else:
        density, sh = file.read("density"), file.read("sh")
    for name, values in (("density", density), ("sh", sh)):
        if not _bounded(values, 2 * LARGEST_VALUE):
            raise file.fault(f"some values of {name!r} are not finite or beyond {LARGEST_VALUE:g}")
    return density, sh


def _bounded(values: np.ndarray, bound: float = LARGEST_VALUE) -> bool:
    """All finite and at most ``bound`` in magnitude; NaN fails both comparisons."""
    return not values.size or (float(values.min()) >= -bound and float(values.max()) <= bound)


def _is_number(value: Any, low: float, high: float) -> bool:
    return type(value) in (int, float) and low <= value <= high  # false for NaN; true numbers of any length compare
