"""Compact storage of an octree's vertex values: quantised, decorrelated, predicted, deflated.

Per vertex there is one raw density and 3 x K SH coefficients. Each becomes a 16-bit integer code per channel:

- density r: round(asinh(r / s) / step), fine near r = 0 and relative for large |r|, since sigma is exponential in r
  below 1 and linear above;
- colour: an orthonormal rotation of (R, G, B) to (grey, red-blue, green-magenta), then round(coefficient / step). All
  SH functions have the same mean square 1 / (4 pi), so one step for all bands spreads the error as evenly as it can.

Where it saves bytes a channel stores differences to the previous vertex (vertices are stored along a Morton curve, so the
previous one is mostly a neighbour). Codes are zigzag-mapped (0, -1, 1, -2, ... to 0, 1, 2, 3, ...) and split into a
low and a high byte plane, each deflated on its own: the high planes are nearly all zero and cost next to nothing.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import shown

DENSITY_STEP = 0.03
DENSITY_SOFTNESS = 2.0
COLOUR_STEP = 1.0 / 64.0
"""Step of 1/2 + c Y_00 for the grey coefficient, in units of colour."""

_Y00 = 0.28209479177387814
_LIMIT = 16383  # the zigzag code of a difference of two codes still fits 16 bits
TO_GREY = np.array(
    [[3**-0.5, 3**-0.5, 3**-0.5], [2**-0.5, 0.0, -(2**-0.5)], [6**-0.5, -2 * 6**-0.5, 6**-0.5]], dtype=np.float32
)
_PLANES = ("low", "high")

Float = NDArray[np.float32]
Bytes = NDArray[np.uint8]


def encode(density: Float, sh: Float, quality: float = 1.0) -> tuple[dict[str, Bytes], dict[str, Any]]:
    """Byte planes by name, and the JSON-able parameters that :func:`decode` needs.

    density (n,), sh (n, 3, K), both finite. ``quality`` divides every step: 2 halves the error for about 15 % more
    bytes. Values beyond the codes' range (raw density about 1e200, colour beyond 250) are clipped.
    """
    parameters: dict[str, Any] = {
        "density_step": DENSITY_STEP / quality,
        "density_softness": DENSITY_SOFTNESS,
        "sh_step": COLOUR_STEP / _Y00 / quality,
        "differences": [],
    }
    basis_dim = sh.shape[2]

    def channel(index: int) -> tuple[bool, list[bytes]]:
        if index == 0:
            curve = np.arcsinh(density / np.float32(DENSITY_SOFTNESS))
            codes = round_codes(curve / np.float32(parameters["density_step"]))
        else:
            axis, k = divmod(index - 1, basis_dim)
            codes = round_codes(sh[:, :, k] @ (TO_GREY[axis] / np.float32(parameters["sh_step"])))
        return pack_codes(codes)

    # zlib and numpy release the interpreter lock; the result does not depend on the number of threads. No more of them
    # than cores: each holds some 30 bytes a vertex.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        packed = list(pool.map(channel, range(1 + 3 * basis_dim)))
    parameters["differences"] = [int(differences) for differences, _ in packed]
    planes = {
        plane_name(index, plane): np.frombuffer(data, np.uint8)
        for index, (_, pair) in enumerate(packed)
        for plane, data in zip(_PLANES, pair, strict=True)
    }
    return planes, parameters


def decode(
    n_vertices: int, basis_dim: int, read: Callable[[str], Bytes], parameters: Mapping[str, Any]
) -> tuple[Float, Float]:
    """density (n_vertices,) and sh (n_vertices, 3, basis_dim); ``read`` gives a byte plane by name.

    Raises:
        ValueError: the parameters or a plane are not what :func:`encode` writes (the message says which).
    """
    density_step = _number(parameters, "density_step")
    softness = _number(parameters, "density_softness")
    sh_step = _number(parameters, "sh_step")
    differences = parameters.get("differences")
    n_channels = 1 + 3 * basis_dim
    if not isinstance(differences, list) or len(differences) != n_channels:
        raise ValueError(f"its codec parameter 'differences' is not a list of {n_channels}")
    density = np.empty(n_vertices, np.float32)
    rotated = np.empty((3 * basis_dim, n_vertices), np.float32)
    compressed = [[read(plane_name(index, plane)) for plane in _PLANES] for index in range(n_channels)]

    def channel(index: int) -> None:
        codes = unpack_codes(index, compressed[index], n_vertices, bool(differences[index]))
        if index == 0:
            curve = np.clip(codes * np.float32(density_step), -80.0, 80.0)  # sinh stays within float32
            np.multiply(np.sinh(curve, dtype=np.float32), np.float32(softness), out=density)
        else:
            np.multiply(codes, np.float32(sh_step), out=rotated[index - 1])

    def turn_back(k: int) -> None:  # in place: this is most of the memory that loading takes
        rotated[k::basis_dim] = (rotated[k::basis_dim].T @ TO_GREY).T

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(channel, range(n_channels)))
        list(pool.map(turn_back, range(basis_dim)))
    return density, rotated.reshape(3, basis_dim, n_vertices).transpose(2, 0, 1)


def plane_name(index: int, plane: str) -> str:
    """Name in the file of a channel's byte plane: channel 0 is density, 1 + axis * K + k are colours."""
    return f"code{index:03d}.{plane}"


def plane_names(basis_dim: int) -> list[str]:
    """All of them."""
    return [plane_name(index, plane) for index in range(1 + 3 * basis_dim) for plane in _PLANES]


def round_codes(values: NDArray[np.floating]) -> NDArray[np.int32]:
    """The nearest codes, any shape; what lies beyond their range is clipped."""
    return np.clip(np.rint(values), -_LIMIT, _LIMIT).astype(np.int32)


def pack_codes(codes: NDArray[np.int32]) -> tuple[bool, list[bytes]]:
    """Of codes (n,): whether differences were stored, and the two deflated planes."""
    stepped = np.diff(codes, prepend=np.int32(0))
    differences = _entropy(stepped) < _entropy(codes)
    signed = stepped if differences else codes
    zigzag = ((signed << 1) ^ (signed >> 31)).astype(np.uint16)
    return differences, [_deflate((zigzag & 255).astype(np.uint8)), _deflate((zigzag >> 8).astype(np.uint8))]


def unpack_codes(index: int, planes: list[Bytes], count: int, differences: bool) -> NDArray[np.int32]:
    """The ``count`` codes in a channel's two planes; ValueError where they hold others."""
    low, high = (_inflate(index, plane, count) for plane in planes)
    zigzag = low.astype(np.int32) | (high.astype(np.int32) << 8)
    codes = (zigzag >> 1) ^ -(zigzag & 1)
    if differences:
        np.cumsum(codes, out=codes, dtype=np.int32)
        if count and max(-int(codes.min()), int(codes.max())) > _LIMIT:
            raise ValueError(f"channel {index} holds codes out of range")
    return codes


def _deflate(plane: Bytes) -> bytes:
    # There are no repeated strings to find in noise: runs and Huffman codes alone are as small and far quicker.
    packer = zlib.compressobj(level=6, method=zlib.DEFLATED, wbits=15, memLevel=9, strategy=zlib.Z_RLE)
    return packer.compress(plane.data) + packer.flush()


def _inflate(index: int, data: Bytes, count: int) -> Bytes:
    """Exactly ``count`` bytes: a stream that would give more stops there, whatever it claims."""
    unpacker = zlib.decompressobj()
    try:
        plane = unpacker.decompress(np.ascontiguousarray(data).data, count + 1)
    except zlib.error as error:
        raise ValueError(f"channel {index} is damaged ({error})") from error
    if len(plane) != count or not unpacker.eof:
        raise ValueError(f"channel {index} does not hold one code for each of {count} vertices")
    return np.frombuffer(plane, np.uint8)


def _entropy(codes: NDArray[np.int32]) -> float:
    """Bits per code of the codes' histogram (their range is at most 4 x _LIMIT)."""
    if not len(codes):
        return 0.0
    counts = np.bincount(codes - codes.min())
    shares = counts[counts > 0] / len(codes)
    return float(-(shares * np.log2(shares)).sum())


def _number(parameters: Mapping[str, Any], name: str) -> float:
    value = parameters.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 1e-9 < value < 1e3:
        raise ValueError(f"its codec parameter {name!r} is {shown(value)}, expected a positive number")
    return float(value)
