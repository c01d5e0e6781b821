"""Pictures and videos on disk: 8- and 16-bit PNG, float EXR, MP4, MOV, WebM, GIF. Every file is whole or absent.

Colours of a radiance field live in the encoding of its training images (sRGB). A PNG holds them as they are; an EXR
is linear by convention, so they are decoded with the sRGB curve on the way.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, write_bytes

Float = NDArray[np.float32]


def to_uint8(image: Float) -> NDArray[np.uint8]:
    """Values in [0, 1] (clipped) rounded to 0...255. Any shape."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def encode_png(image: NDArray[Any]) -> bytes:
    """A PNG of (H, W), (H, W, 3) or (H, W, 4) values in [0, 1] with 8 bits, or of uint8/uint16 arrays as they are."""
    from PIL import Image

    pixels = image if image.dtype in (np.uint8, np.uint16) else to_uint8(image)
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()


def write_png(path: str | os.PathLike[str], image: NDArray[Any]) -> None:
    """Write :func:`encode_png` of ``image`` to ``path``."""
    write_bytes(path, encode_png(image))


def srgb_to_linear(image: Float) -> Float:
    """The sRGB decoding curve (IEC 61966-2-1); negative values keep their sign, values above 1 go on along it. Any shape."""
    magnitude = np.abs(image)
    curve = np.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)
    return (np.sign(image) * curve).astype(np.float32)


def encode_exr(channels: Mapping[str, Float]) -> bytes:
    """An EXR of float32 ``channels``; "RGB" and "N" are (H, W, 3), the others (H, W), for example "A" and "Z".

    "N" becomes N.X, N.Y, N.Z. Uncompressed scan lines, the plainest kind of file that the OpenEXR format has
    (openexr.com, "OpenEXR File Layout"): no library is needed for it, and every reader takes it.
    """
    planes: dict[str, Float] = {}
    for name, array in channels.items():
        if array.ndim == 3:
            suffixes = ("R", "G", "B") if name == "RGB" else tuple(f"{name}.{axis}" for axis in "XYZ")
            planes.update({suffix: array[..., i] for i, suffix in enumerate(suffixes)})
        else:
            planes[name] = array
    names = sorted(planes)  # the format wants channels in this order
    rows = np.stack([planes[name] for name in names], axis=1).astype("<f4")  # (H, channel, W), as they lie in the file
    header = _exr_header(names, width=rows.shape[2], height=rows.shape[0])
    row_bytes = rows[0].nbytes
    first = len(header) + 8 * len(rows)
    offsets = first + (8 + row_bytes) * np.arange(len(rows), dtype="<u8")
    lines = (struct.pack("<ii", number, row_bytes) + row.tobytes() for number, row in enumerate(rows))
    return b"".join([header, offsets.tobytes(), *lines])


def write_exr(path: str | os.PathLike[str], channels: Mapping[str, Float]) -> None:
    """Write :func:`encode_exr` of ``channels`` to ``path``."""
    write_bytes(path, encode_exr(channels))


def _exr_header(names: list[str], width: int, height: int) -> bytes:
    """Magic number, version 2 and the eight attributes that every EXR must have."""
    full_float, all_pixels = 2, (1, 1)
    listed = b"".join(name.encode() + struct.pack("<xiB3xii", full_float, 0, *all_pixels) for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        ("channels", "chlist", listed),
        ("compression", "compression", b"\0"),  # none
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),  # top to bottom
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ]
    packed = [
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    ]
    return struct.pack("<ii", 20000630, 2) + b"".join(packed) + b"\0"


_BT709 = ["-vf", "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p,setparams=range=tv:colorspace=bt709:"
          "color_primaries=bt709:color_trc=iec61966-2-1",
          "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "iec61966-2-1"]  # fmt: skip
"""sRGB as players take it: of a video that states nothing they take the matrix by its size, and ffmpeg's is then the other."""
_H264 = [*_BT709, "-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
_PALETTE = "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer:bayer_scale=4"
VIDEOS = {
    ".mp4": _H264,
    ".mov": _H264,
    ".webm": [*_BT709, "-c:v", "libvpx-vp9", "-crf", "24", "-b:v", "0", "-row-mt", "1", "-pix_fmt", "yuv420p"],
    ".gif": ["-vf", _PALETTE, "-loop", "0"],
}
"""Ends of videos' names, and how ffmpeg encodes them."""


class VideoWriter:
    """Frames to a video, as the end of its name says: H.264 in an MP4 that every browser plays or in a MOV, VP9 in a WebM
    (yuv420p; odd sizes lose their last row or column), or a GIF of 256 colours for all frames, which plays for ever.

    Speaks to the ffmpeg program itself: it must say that it wrote everything, which imageio's writer does not ask.
    """

    def __init__(self, path: Path, fps: float):
        self._path, self._fps = path, fps
        self._process: subprocess.Popen[bytes] | None = None
        self._size = (0, 0)

    def add(self, image: NDArray[Any]) -> None:
        """Append an (H, W, 3) frame of values in [0, 1] or uint8, all of one size, at least 2x2.

        Raises:
            OSError: ffmpeg has given up (disk full, for one).
        """
        pixels = image if image.dtype == np.uint8 else to_uint8(image)
        height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
        if self._process is None:
            if min(height, width) < 2:
                size = f"{pixels.shape[1]}x{pixels.shape[0]}"
                raise InputError(f"a video needs frames of at least 2x2 pixels, got {size}")
            self._size = (height, width)
            self._process = self._start(width, height)
        if (height, width) != self._size:
            raise ValueError(f"frames of one video must have one size, got {(height, width)} after {self._size}")
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(pixels[:height, :width]).tobytes())
        except BrokenPipeError as error:
            raise self._failure() from error

    def close(self) -> None:
        """Finish the file; OSError where ffmpeg could not."""
        if self._process is None:
            return
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # its exit code tells
            self._process.stdin.close()
        if self._process.wait() != 0:
            raise self._failure()
        self._release()

    def abandon(self) -> None:
        """Stop without finishing."""
        if self._process is not None:
            self._process.kill()
            self._release()

    def _start(self, width: int, height: int) -> subprocess.Popen[bytes]:
        import imageio_ffmpeg

        frames = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(self._fps), "-i", "-"]
        video = [*VIDEOS[self._path.suffix.lower()], str(self._path)]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *frames, *video]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    def _failure(self) -> OSError:
        """What ffmpeg said last, as an error about the file."""
        assert self._process is not None and self._process.stderr is not None
        self._process.wait()
        lines = self._process.stderr.read().decode(errors="replace").strip().splitlines()
        self._release()
        return OSError(None, f"ffmpeg stopped ({lines[-1] if lines else 'without a word'})", str(self._path))

    def _release(self) -> None:
        if self._process is None:
            return
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stderr):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):  # what it did not take is lost with it
                    pipe.close()
        self._process = None


@contextlib.contextmanager
def open_video(path: str | os.PathLike[str], fps: float) -> Iterator[VideoWriter]:
    """A :class:`VideoWriter` whose file appears at ``path`` when the block ends without an exception."""
    with atomic_write(path) as temporary:
        writer = VideoWriter(temporary, fps)
        try:
            yield writer
            writer.close()
        finally:
            writer.abandon()


def depth_to_grey(depth: Float, opacity: Float, near: float, far: float) -> Float:
    """Distances (H, W) as light (H, W): 1 at ``near``, 0.1 at ``far``, 0 where nothing was hit.

    ``opacity`` (H, W): below one half nothing was hit; near, far: in the unit of ``depth``.
    """
    nearness = 1.0 - 0.9 * np.clip((depth - near) / max(far - near, 1e-12), 0.0, 1.0)
    return np.where(opacity >= 0.5, nearness, 0.0).astype(np.float32)


def normal_to_rgb(normal: Float, opacity: Float) -> Float:
    """World-space unit normals (H, W, 3) as the usual colours (n + 1) / 2; grey where there is none."""
    return np.where(opacity[..., None] >= 0.5, 0.5 * normal + 0.5, 0.5).astype(np.float32)


def error_map(truth: Float, render: Float, largest: float = 0.25) -> Float:
    """|truth - render| (H, W, 3), the mean over channels: black 0, through red and yellow, white at ``largest``."""
    level = np.clip(np.abs(truth - render).mean(axis=-1) / largest, 0.0, 1.0)
    return np.stack([np.clip(3.0 * level - shift, 0.0, 1.0) for shift in (0.0, 1.0, 2.0)], axis=-1).astype(np.float32)


def side_by_side(panels: list[Float], gap: int = 8) -> Float:
    """Pictures (H, w) or (H, w, 3) of one height next to each other on white, ``gap`` pixels apart: (H, W, 3).

    Values in [0, 1]; grey pictures become RGB.
    """
    coloured = [np.repeat(p[..., None], 3, axis=-1) if p.ndim == 2 else p for p in panels]
    white = np.ones((coloured[0].shape[0], gap, 3), np.float32)
    pieces = [piece for panel in coloured for piece in (panel, white)]
    return np.concatenate(pieces[:-1], axis=1)


def stacked(strips: list[NDArray[np.uint8]], gap: int = 8) -> NDArray[np.uint8]:
    """Pictures (h, W) or (h, W, c) of one width below each other, with ``gap`` rows of white between them."""
    white = np.full((gap, *strips[0].shape[1:]), 255, np.uint8)
    return np.concatenate([piece for strip in strips for piece in (strip, white)][:-1])


def read_png(path: str | os.PathLike[str]) -> NDArray[np.uint8]:
    """An RGB picture (H, W, 3) that this program wrote."""
    from PIL import Image

    with Image.open(path, formats=("PNG",)) as image:
        return np.asarray(image.convert("RGB"))
