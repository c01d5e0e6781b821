"""Pictures: the result of a render, and how it is written to disk.

Inside data_synth colour is linear, float64 and premultiplied by alpha. PNG files are 8-bit sRGB with straight alpha,
as in NeRF-synthetic; EXR files are 32-bit float, linear and premultiplied, as EXR expects.
"""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image as PillowImage

from data_synth.errors import InputError
from data_synth.files import replacing


@dataclass
class Picture:
    """A rendered view.

    rgb: (H, W, 3) float64, linear, premultiplied. alpha: (H, W) in [0, 1]. distance: (H, W), expected distance along
    the ray in scene units, premultiplied by alpha as well. variance: (H, W, 3), the variance *of the pixel mean* where
    the integrator is a Monte Carlo one, else None. samples: samples per pixel.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    distance: np.ndarray
    variance: np.ndarray | None = None
    samples: int = 1

    def over(self, background: ArrayLike) -> np.ndarray:
        """(H, W, 3) linear colour over a constant linear background."""
        return self.rgb + (1.0 - self.alpha[..., None]) * np.asarray(background, dtype=np.float64)

    def rgba8(self, exposure: float = 1.0) -> np.ndarray:
        """(H, W, 4) uint8, sRGB with straight alpha. The colour is un-premultiplied in linear light."""
        straight = self.rgb / np.maximum(self.alpha, 1e-12)[..., None]
        straight = np.where(self.alpha[..., None] > 0, straight, 0.0) * exposure
        rgba = np.concatenate([linear_to_srgb(straight), np.clip(self.alpha, 0, 1)[..., None]], axis=-1)
        return np.rint(255.0 * rgba).astype(np.uint8)


def linear_to_srgb(x: np.ndarray) -> np.ndarray:
    """The sRGB transfer curve (IEC 61966-2-1) of values clipped to [0, 1]."""
    x = np.clip(x, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def srgb_to_linear(x: np.ndarray) -> np.ndarray:
    """The inverse of ``linear_to_srgb`` on [0, 1]."""
    x = np.clip(x, 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.04045) + 0.055) / 1.055) ** 2.4)


def write_png(path: str | os.PathLike, pixels: np.ndarray) -> None:
    """Write (H, W), (H, W, 3) or (H, W, 4) uint8 pixels; the suffix chooses PNG or JPEG."""
    if pixels.dtype != np.uint8:
        raise InputError(f"write_png: pixels must be uint8, got {pixels.dtype}")
    with replacing(path) as temporary:
        options: dict[str, Any] = {} if Path(path).suffix == ".png" else {"quality": 88}
        PillowImage.fromarray(pixels).save(temporary, **options)


def encode_png(pixels: np.ndarray) -> bytes:
    """(H, W), (H, W, 3) or (H, W, 4) uint8 pixels as a PNG."""
    buffer = io.BytesIO()
    PillowImage.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def encode_exr(channels: dict[str, np.ndarray]) -> bytes:
    """Named (H, W) channels as an uncompressed 32-bit float scan-line OpenEXR file (openexr.com, file layout)."""
    names = sorted(channels)
    planes = np.stack([np.asarray(channels[name], dtype="<f4") for name in names], axis=1)  # (H, channel, W)
    height, _, width = planes.shape

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    pixel_type = struct.pack("<iBxxxii", 2, 0, 1, 1)
    channel_list = b"".join(name.encode() + b"\0" + pixel_type for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = struct.pack("<ii", 20000630, 2)
    header += attribute("channels", "chlist", channel_list)
    header += attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", window) + attribute("displayWindow", "box2i", window)
    header += attribute("lineOrder", "lineOrder", b"\0") + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    row_bytes = 4 * len(names) * width
    first = len(header) + 8 * height
    offsets = first + (row_bytes + 8) * np.arange(height, dtype="<u8")
    lines = (struct.pack("<ii", y, row_bytes) + planes[y].tobytes() for y in range(height))
    return b"".join([header, offsets.tobytes(), *lines])


def write_exr(path: str | os.PathLike, channels: dict[str, np.ndarray]) -> None:
    """Write :func:`encode_exr` of ``channels`` to ``path``."""
    with replacing(path) as temporary:
        temporary.write_bytes(encode_exr(channels))


def read_exr(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read back what ``write_exr`` writes: (H, W) float32 channels by name."""
    data = Path(path).read_bytes()
    if data[:8] != struct.pack("<ii", 20000630, 2):
        raise InputError(f"{path}: expected an OpenEXR scan-line file")
    attributes, at = {}, 8
    while data[at] != 0:
        name, kind, rest = data[at : at + 512].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name.decode()] = data[at + 4 : at + 4 + size]
        at += 4 + size
    x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"])
    if attributes["compression"] != b"\0":
        raise InputError(f"{path}: expected an uncompressed OpenEXR file")
    names, rest = [], attributes["channels"]
    while rest[0] != 0:
        name, rest = rest.split(b"\0", 1)
        names.append(name.decode())
        rest = rest[16:]
    width, height = x1 - x0 + 1, y1 - y0 + 1
    start = at + 1 + 8 * height
    rows = np.frombuffer(data, dtype=np.uint8, offset=start).reshape(height, -1)[:, 8:]
    planes = np.ascontiguousarray(rows).view("<f4").reshape(height, len(names), width)
    return {name: planes[:, c] for c, name in enumerate(names)}
