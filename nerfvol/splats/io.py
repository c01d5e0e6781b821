"""Files of Gaussians: arrays in one safetensors file with a JSON document, checked before memory is spent on it.

Exact by default; "compact" files hold codes (splats/codec.py), as pages do.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from nerfvol import __version__
from nerfvol.errors import InputError, shown
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.octree.codec import plane_name
from nerfvol.splats import codec
from nerfvol.splats.splats import Splats

FORMAT = "nerfvol splats"
VERSION = 1
COLOUR_CONVENTION = "half_plus_sh_clamped"
FOOTPRINT_VARIANCE = 0.3
"""Pixels squared that are added to a footprint's covariance; stated in the file since opacities are trained with it."""
LARGEST_VALUE = 1e15
MOST_PER_BYTE = 1032
"""What deflate can make of a byte."""
_ARRAYS = {"means": (3,), "log_scales": (3,), "quats": (4,), "logits": ()}


def save_splats(
    path: str | os.PathLike[str], splats: Splats, metadata: Mapping[str, Any], compact: bool = False
) -> int:
    """Write ``splats`` to ``path`` atomically and return the file's size in bytes.

    ``compact``: in about a quarter of the bytes, rounded, in another order (splats/codec.py).

    ``metadata`` is JSON-able and comes back from :func:`load_splats`; by custom it has "provenance", "background" and
    "orbit" as an octree's.

    Raises:
        InputError: the path cannot be written, or a value is not finite.
    """
    try:
        splats.validate()
    except InputError as error:
        raise InputError(f"cannot write {path}: {error}") from error
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "nerfvol": __version__,
        "colour": COLOUR_CONVENTION,
        "mode": splats.mode,
        "footprint_variance": FOOTPRINT_VARIANCE,
        "sh_degree": splats.sh_degree,
        "n": splats.n,
        "origin": [float(x) for x in splats.origin],
        "metadata": dict(metadata),
    }
    if compact:
        arrays, document["codec"] = codec.encode(splats)
        document["storage"] = "compact"
    else:
        arrays = {name: getattr(splats, name) for name in (*_ARRAYS, "sh")}
    return write_arrays(path, arrays, document)


def load_splats(path: str | os.PathLike[str]) -> tuple[Splats, dict[str, Any]]:
    """The Gaussians in ``path`` and the metadata they were saved with.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    with ArrayFile(path, "splat file") as file:
        _check_document(file)
        document = file.document
        n, degree = document["n"], document["sh_degree"]
        arrays = _read_codes(file, n, degree) if document.get("storage") == "compact" else _read_exact(file, n, degree)
        for name, values in arrays.items():
            if values.size and not (np.abs(values) <= LARGEST_VALUE).all():  # fails for what is no number as well
                raise file.fault(f"some values of {name!r} are not finite or beyond {LARGEST_VALUE:g}")
        try:
            splats = Splats(**arrays, origin=np.array(document["origin"], np.float64), mode=document["mode"])
            splats.validate()
        except InputError as error:
            raise file.fault(str(error)) from error
        return splats, document["metadata"]


def _read_exact(file: ArrayFile, n: int, degree: int) -> dict[str, np.ndarray]:
    for name, row in _ARRAYS.items():
        file.expect(name, "float32", (n, *row))
    file.expect("sh", "float32", (n, 3, (degree + 1) ** 2))
    return {name: file.read(name) for name in (*_ARRAYS, "sh")}


def _read_codes(file: ArrayFile, n: int, degree: int) -> dict[str, np.ndarray]:
    basis, parameters = (degree + 1) ** 2, file.document.get("codec")
    for index in range(codec.n_channels(basis)):
        for plane in ("low", "high"):
            (length,) = file.expect(plane_name(index, plane), "uint8", (None,))
            if n > MOST_PER_BYTE * length:
                raise file.fault(f"it declares {n} splats, which the {length} bytes of channel {index} cannot hold")
    if not isinstance(parameters, dict):
        raise file.fault("its codec parameters are missing")
    try:
        return codec.decode(n, basis, file.read, parameters)
    except InputError:
        raise
    except ValueError as error:
        raise file.fault(str(error)) from error


def describe_splats(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON document in the header of ``path``, checked, without the arrays."""
    with ArrayFile(path, "splat file") as file:
        _check_document(file)
        return file.document


def _check_document(file: ArrayFile) -> None:
    document = file.document
    if document.get("format") != FORMAT:
        raise file.fault(f"expected the format {FORMAT!r}, it says {shown(document.get('format'))}")
    if document.get("version") != VERSION:
        raise file.fault(f"this nerfvol reads version {VERSION}, it has version {shown(document.get('version'))}")
    expected = (
        ("colour", (COLOUR_CONVENTION,)),
        ("footprint_variance", (FOOTPRINT_VARIANCE,)),
        ("mode", ("mip", "plain")),
    )
    for key, known in expected:
        if document.get(key) not in known:
            raise file.fault(f"its {key} is {shown(document.get(key))}, expected {' or '.join(map(str, known))}")
    if document.get("storage", "float32") not in ("float32", "compact"):
        raise file.fault(f"its storage is {shown(document.get('storage'))}, expected float32 or compact")
    degree, n, origin = document.get("sh_degree"), document.get("n"), document.get("origin")
    if type(degree) is not int or not 0 <= degree <= 3:
        raise file.fault(f"its sh_degree is {shown(degree)}, expected 0, 1, 2 or 3")
    if type(n) is not int or not 0 <= n < 1 << 31:
        raise file.fault(f"its n is {shown(n)}, expected a count")
    if not isinstance(origin, list) or len(origin) != 3 or not all(_is_place(x) for x in origin):
        raise file.fault(f"its origin is {shown(origin)}, expected three finite numbers")
    if not isinstance(document.get("metadata"), dict):
        raise file.fault("its metadata is not a JSON object")


def _is_place(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= LARGEST_VALUE
