"""Red, green, blue and white that a file states by their places in CIE xy: what linear light of theirs is in sRGB's; and what a
PNG states so (W3C PNG, third edition: cICP by code points of ITU-T H.273, or cHRM)."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Matrix = tuple[tuple[float, float, float], ...]
Places = tuple[float, ...]
"""x and y of white, red, green and blue, as cHRM has them."""

_D65, _DCI = (0.3127, 0.3290), (0.314, 0.351)
SRGB: Places = (*_D65, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
BY_CODE: dict[int, tuple[str, Places]] = {
    1: ("BT.709", SRGB), 5: ("BT.601", (*_D65, 0.64, 0.33, 0.29, 0.60, 0.15, 0.06)),
    6: ("BT.601", (*_D65, 0.630, 0.340, 0.310, 0.595, 0.155, 0.070)),
    7: ("SMPTE 240M", (*_D65, 0.630, 0.340, 0.310, 0.595, 0.155, 0.070)),
    9: ("BT.2020", (*_D65, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046)),
    11: ("DCI-P3", (*_DCI, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060)),
    12: ("Display P3", (*_D65, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060)),
}  # fmt: skip
"""Table 2 of H.273, what is in use."""
CURVES: dict[int, float | None] = {1: None, 4: 2.2, 5: 2.8, 6: None, 8: 1.0, 13: None, 14: None, 15: None}
"""Table 3: the power that makes light of values, None: as sRGB's, which is how cameras' curves are watched."""
_HDR = {16: "PQ", 18: "HLG"}
UNSPECIFIED = 2
_SAME = 0.003
"""In x and y: files round to 0.001, and some state D65 with fewer digits."""
_LEAST_AREA = 1e-3
"""Of the triangle in x and y (sRGB's has 0.11): what is smaller is no primaries."""
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_MOST_CHUNKS = 100


def is_srgb(places: Places) -> bool:
    """Whether these are sRGB's primaries and white, to what files round."""
    return bool(np.abs(np.subtract(places, SRGB)).max() <= _SAME)


@functools.lru_cache(maxsize=16)
def to_srgb(places: Places) -> Matrix | None:
    """The matrix (3, 3) from linear light of these primaries to sRGB's, white to white (Bradford); None: they are none."""
    corners = np.array(places).reshape(4, 2)
    (ax, ay), (bx, by), (cx, cy) = corners[1:]
    area = abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay)) / 2
    if not np.isfinite(corners).all() or (corners <= 0).any() or (corners >= 1).any() or area < _LEAST_AREA:
        return None
    own, (white, target) = _to_xyz(corners), (_xyz(corners[0]), _xyz(np.array(_D65)))
    if (np.linalg.solve(_columns(corners), white) <= 0).any():  # white lies outside of the triangle
        return None
    adapted = np.linalg.solve(_BRADFORD, np.diag(_BRADFORD @ target / (_BRADFORD @ white)) @ _BRADFORD)
    found = np.linalg.solve(_to_xyz(np.array(SRGB).reshape(4, 2)), adapted @ own)
    return tuple((float(a), float(b), float(c)) for a, b, c in found)


def _xyz(place: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([place[0], place[1], 1 - place.sum()]) / place[1]


def _columns(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([_xyz(place) for place in corners[1:]], axis=1)


def _to_xyz(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns: X, Y, Z of the primaries, so bright that together they are the white of luminance 1."""
    columns = _columns(corners)
    return columns * np.linalg.solve(columns, _xyz(corners[0]))


def code_points(image: Image.Image) -> tuple[int, int, int, int] | None:
    """What a PNG's cICP says: primaries, curve, matrix and whether values span 0 to 255; None where it has none. Decoders pass
    it over, so its chunks are gone through once more, up to the pixels."""
    file: Any = getattr(image, "fp", None)
    if image.format != "PNG" or file is None:
        return None
    before = file.tell()
    try:
        file.seek(8)
        for _ in range(_MOST_CHUNKS):
            head = file.read(8)
            if len(head) < 8 or head[4:] == b"IDAT":
                return None
            if head == b"\0\0\0\4cICP":
                a, b, c, d = file.read(4)
                return a, b, c, d
            file.seek(int.from_bytes(head[:4], "big") + 4, 1)
        return None
    finally:
        file.seek(before)


def named(codes: tuple[int, int, int, int]) -> tuple[str, float | None, Matrix | None] | None:
    """(name, power, matrix to sRGB) of code points, power None: sRGB's curve; None where they are sRGB's or say nothing.

    Both are None where no conversion to sRGB is known.
    """
    primaries, curve, matrix, full = codes
    if primaries == UNSPECIFIED and curve == UNSPECIFIED:
        return None
    name, places = BY_CODE.get(primaries, BY_CODE[1] if primaries == UNSPECIFIED else ("", SRGB))
    if not name or (curve not in CURVES and curve != UNSPECIFIED) or matrix or full != 1:
        said = name or f"primaries {primaries}"
        return f"{said} with {_HDR.get(curve, f'curve {curve}')}, by cICP", None, None
    power = CURVES.get(curve)
    if is_srgb(places):
        return None if power is None else (f"a power of {power:g}, by cICP", power, None)
    return f"{name}, by cICP", power, to_srgb(places)
