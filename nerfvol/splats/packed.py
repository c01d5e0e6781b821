"""Gaussians that PlayCanvas' programs (SuperSplat, splat-transform) packed into a PLY, ``.compressed.ply``: 16 bytes each.

Element "chunk": for 256 Gaussians each the ends of their positions, logarithmic scales and, since version 2 of SuperSplat,
colours (min_x .. max_z, min_scale_x .. max_scale_z, min_r .. max_b). Element "vertex", four unsigned words, highest bits first:
packed_position and packed_scale 11, 10 and 11 bits between the chunk's ends; packed_rotation the number (2 bits) of the
quaternion's largest entry, w first, which is positive, then the other three in turn, 10 bits from -1/sqrt(2) to 1/sqrt(2);
packed_color 8 bits each of red, green, blue between the chunk's ends (older: 0 and 1) and opacity. Element "sh", where
there are harmonics: f_rest_0 .. as bytes, the middle of each of 256 equal parts of -4 to 4, but of the first and the last their
outer ends, for there is also what was beyond.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.octree.points import Y00
from nerfvol.splats.foreign import logits_of
from nerfvol.splats.plyfile import PlyFile

CHUNK = 256
LARGEST_HARMONIC = 4.0
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_ENDS = tuple(f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz")
_COLOUR_ENDS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
_POSITION_BITS = ((21, 11), (11, 10), (0, 11))
_ROTATION_BITS = ((20, 10), (10, 10), (0, 10))
_COLOUR_BITS = ((24, 8), (16, 8), (8, 8), (0, 8))


def is_packed(file: PlyFile) -> bool:
    """Whether the vertices are words that a chunk explains."""
    return _WORDS[0] in file.dtypes


def unpacked(file: PlyFile) -> dict[str, Any]:
    """means, log_scales, quats, logits and sh of the Gaussians, float32, shapes as in splats.Splats.

    Raises:
        InputError: an element or a property is missing, of another type or too short.
    """
    chunks = file.elements.get("chunk")
    ends = (*_ENDS, *(_COLOUR_ENDS if chunks is not None and "min_r" in chunks.dtypes else ()))
    _expect(file, "vertex", _WORDS, "u4")
    _expect(file, "chunk", ends, "f4")
    assert chunks is not None
    if chunks.count * CHUNK < file.count:
        raise file.fault(
            f"its {file.count} packed Gaussians need {-(-file.count // CHUNK)} chunks, it has {chunks.count}"
        )
    table, words = file.read("chunk"), file.read()
    chunk = np.arange(file.count) // CHUNK

    def between(what: str, parts: NDArray[np.float64]) -> NDArray[np.float64]:
        names = "rgb" if what == "rgb" else [f"{what}{axis}" for axis in "xyz"]
        low, high = (np.stack([table[f"{end}_{name}"] for name in names], 1)[chunk] for end in ("min", "max"))
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused where it is looked at
            return low * (1 - parts) + high * parts

    colour = _parts(words["packed_color"], _COLOUR_BITS)
    rgb = between("rgb", colour[:, :3]) if "min_r" in table else colour[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            "means": between("", _parts(words["packed_position"], _POSITION_BITS)).astype(np.float32),
            "log_scales": between("scale_", _parts(words["packed_scale"], _POSITION_BITS)).astype(np.float32),
            "quats": _rotations(words["packed_rotation"]),
            "logits": logits_of(colour[:, 3]),
            "sh": np.concatenate([((rgb - 0.5) / Y00).astype(np.float32)[:, :, None], _harmonics(file)], axis=2),
        }


def _expect(file: PlyFile, name: str, wanted: tuple[str, ...], kind: str) -> None:
    element = file.elements.get(name)
    if element is None:
        raise file.fault(f"its Gaussians are packed, and it has no element {name!r} that says between which ends")
    for each in wanted:
        if each not in element.dtypes:
            raise file.fault(f"its Gaussians are packed, and its element {name!r} has no property {each!r}")
        if element.dtypes[each].newbyteorder("=") != np.dtype(kind):
            expected = np.dtype(kind).name
            raise file.fault(f"its property {each!r} should be {expected}, it is {element.dtypes[each].name}")


def _parts(words: NDArray[np.uint32], fields: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """(n, fields) the bits from ``shift`` on, ``bits`` of them, as shares of the largest number they hold."""
    return np.stack([(words >> shift & (1 << bits) - 1) / ((1 << bits) - 1) for shift, bits in fields], axis=1)


def _rotations(words: NDArray[np.uint32]) -> NDArray[np.float32]:
    """(n, 4) unit quaternions, w first."""
    others = (_parts(words, _ROTATION_BITS) - 0.5) * math.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others * others).sum(1)))
    which, out = words >> 30, np.empty((len(words), 4))
    for k in range(4):
        before, after = others[:, min(k, 2)], others[:, max(k - 1, 0)]
        out[:, k] = np.where(which == k, largest, np.where(which > k, before, after))
    return (out / np.linalg.norm(out, axis=1, keepdims=True)).astype(np.float32)


def _harmonics(file: PlyFile) -> NDArray[np.float32]:
    """(n, 3, K - 1) coefficients above degree 0."""
    element = file.elements.get("sh")
    if element is None:
        return np.zeros((file.count, 3, 0), np.float32)
    number = len(element.dtypes)
    if number not in (9, 24, 45) or element.count != file.count:
        raise file.fault(
            f"its element 'sh' has {element.count} rows of {number} numbers, expected {file.count} of 9, 24 or 45"
        )
    names = tuple(f"f_rest_{k}" for k in range(number))
    _expect(file, "sh", names, "u1")
    table = file.read("sh")
    codes = np.stack([table[name] for name in names], axis=1).reshape(file.count, 3, number // 3)
    middles = (np.arange(256) + 0.5) / 256
    middles[[0, 255]] = 0, 1
    return ((middles - 0.5) * (2 * LARGEST_HARMONIC)).astype(np.float32)[codes]
