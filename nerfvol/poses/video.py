"""Which frames of a video to take: the sharpest of each part of its time, none where nothing moves.

Two passes through ffmpeg: small grey frames to judge, then the chosen ones at full size.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.measure.sharpness import sharpness

JUDGED_SIZE = 320
"""Pixels along the longer side of the frames that are judged."""
STILL = 0.02
"""Of the mean brightness: a root mean square difference of thumbnails below which nothing has moved."""
_THUMBNAIL = 8  # times smaller than the frames that are judged


@dataclass(frozen=True, eq=False)
class Judged:
    """All frames of a video: ``sharpness`` (n,) and ``thumbnails`` (n, h, w) uint8."""

    sharpness: NDArray[np.float32]
    thumbnails: NDArray[np.uint8]


def judge_video(path: Path, on_frame: Callable[[int], object] = lambda n: None) -> Judged:
    """Sharpness and thumbnail of every frame; ``on_frame`` gets the number of frames so far.

    Raises:
        InputError: the video cannot be decoded, or has no frames.
    """
    values, thumbnails = [], []
    for frame in _grey_frames(path):
        values.append(sharpness(frame))
        h, w = (side // _THUMBNAIL for side in frame.shape)
        blocks = frame[: h * _THUMBNAIL, : w * _THUMBNAIL].reshape(h, _THUMBNAIL, w, _THUMBNAIL)
        thumbnails.append(blocks.mean((1, 3)).astype(np.uint8))
        on_frame(len(values))
    if not values:
        raise InputError(f"{path}: the video holds no frames that can be decoded")
    return Judged(np.array(values, np.float32), np.stack(thumbnails))


def choose_frames(judged: Judged, most: int) -> list[int]:
    """At most ``most`` frames: of as many equal parts of the time the sharpest one, none of a part in which nothing moved."""
    n = len(judged.sharpness)
    edges = np.linspace(0, n, min(most, n) + 1).round().astype(int)
    chosen: list[int] = []
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        best = int(first + np.argmax(judged.sharpness[first:last]))
        if chosen and _moved(judged.thumbnails[chosen[-1]], judged.thumbnails[best]) < STILL:
            continue
        chosen.append(best)
    return chosen


def _moved(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    difference = a.astype(np.float32) - b
    return float(np.sqrt((difference * difference).mean()) / max(1.0, a.mean()))


def write_frames(path: Path, chosen: list[int], folder: Path, size: int) -> list[str]:
    """Writes the frames as ``frame_NNNNN.jpg`` (NNNNN: its number in the video), at most ``size`` pixels along the longer
    side, and returns the names. Pictures appear in ``folder`` only once all are there.

    Raises:
        InputError: the video cannot be decoded, or the frames not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"frame_{number:05d}.jpg" for number in chosen]
    with tempfile.TemporaryDirectory(dir=folder, prefix=".frames") as temporary:
        select = _any_of(chosen)
        colours = ":out_color_matrix=bt601"  # which is JPEG's matrix
        if converts_high_range() and (stated := _high_range(path)):
            colours = (_AS_BT2020 if "unknown" in stated else "") + _TO_ORDINARY_RANGE
        fit = f"scale='min({size},iw)':'min({size},ih)':force_original_aspect_ratio=decrease:flags=lanczos"
        out = ["-fps_mode", "passthrough", "-q:v", "2", "-f", "image2", str(Path(temporary) / "%05d.jpg")]
        result = subprocess.run(
            [*_ffmpeg(path), "-vf", f"select='{select}',{fit}{colours}", *out],
            capture_output=True,
            stdin=subprocess.DEVNULL,
        )
        made = sorted(Path(temporary).glob("*.jpg"))
        if result.returncode or len(made) != len(chosen):
            raise _failure(path, result.stderr)
        for file, name in zip(made, names, strict=True):
            os.replace(file, folder / name)
    return names


_TO_ORDINARY_RANGE = (
    ",zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,tonemap=mobius:desat=0,zscale=t=bt709:m=smpte170m:r=full,"
    "format=yuvj444p"
)
"""Filters from HLG or PQ in BT.2020 to BT.709 and JPEG's numbers: white at 203 candela per square metre as BT.2408 has it, what
is brighter compressed."""


_AS_BT2020 = ",setparams=color_primaries=bt2020:colorspace=bt2020nc"
"""For videos that say their curve and leave the rest open, which zscale refuses: HLG and PQ are BT.2100's, of these colours."""


def is_high_range(path: Path) -> bool:
    """Whether a video has the high dynamic range that phones record (HLG, PQ), whose numbers taken as they are look pale."""
    return bool(_high_range(path))


def _high_range(path: Path) -> str:
    """What a video of a high dynamic range states, matrix/primaries/curve; empty where it is an ordinary one."""
    header = subprocess.run([*_ffmpeg(path)[:-4], "-loglevel", "info", *_ffmpeg(path)[-4:]], capture_output=True,
                            stdin=subprocess.DEVNULL).stderr  # fmt: skip
    found = re.search(rb"Stream #0:\d+.*Video:.*?([\w-]+/[\w-]+/(?:arib-std-b67|smpte2084))", header)
    return "" if found is None else found[1].decode()


@functools.cache
def converts_high_range() -> bool:
    """Whether this ffmpeg has the filter that converts a high range: some are built without the zimg library."""
    import imageio_ffmpeg

    asked = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-filters"], capture_output=True,
                           stdin=subprocess.DEVNULL)  # fmt: skip
    return b" zscale " in asked.stdout


def _any_of(numbers: Sequence[int]) -> str:
    """ffmpeg's expression for "the frame is one of ``numbers``": in halves, since it refuses more than 100 terms in a row."""
    if len(numbers) == 1:
        return f"eq(n\\,{numbers[0]})"
    half = len(numbers) // 2
    return f"({_any_of(numbers[:half])}+{_any_of(numbers[half:])})"


def _ffmpeg(path: Path) -> list[str]:
    import imageio_ffmpeg

    return [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-loglevel", "error", "-i", str(path), "-map", "0:v:0"]


def _grey_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Small grey frames (h, w); yuv4mpeg states their size, which a video's turn would leave to be guessed."""
    fit = f"scale={JUDGED_SIZE}:{JUDGED_SIZE}:force_original_aspect_ratio=decrease:flags=area,format=gray"
    out = ["-vf", fit, "-fps_mode", "passthrough", "-strict", "-1", "-f", "yuv4mpegpipe", "-"]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            [*_ffmpeg(path), *out], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints
        )
        stream = process.stdout
        assert stream is not None
        frames = 0
        try:
            fields = {word[:1]: word[1:] for word in stream.readline().split()[1:]}
            if b"W" in fields and b"H" in fields:
                width, height = int(fields[b"W"]), int(fields[b"H"])
                while stream.readline():  # FRAME
                    data = stream.read(width * height)
                    if len(data) < width * height:
                        break
                    frames += 1
                    yield np.frombuffer(data, np.uint8).reshape(height, width)
            failed = process.wait()
        finally:
            process.kill()
            process.wait()
            stream.close()
        if failed and not frames:
            complaints.seek(0)
            raise _failure(path, complaints.read())


def _failure(path: Path, complaint: bytes) -> InputError:
    """What ffmpeg said last, without the path that it repeats."""
    lines = [line for line in complaint.decode(errors="replace").splitlines() if line.strip()]
    said = lines[-1].replace(str(path), "").strip(" :") if lines else "ffmpeg gives no reason"
    return InputError(f"{path}: expected a video, but it does not decode ({said:.120})")


def video_frames(path: Path) -> int | None:
    """About how many frames there are, as the header says; None where it does not."""
    import imageio_ffmpeg

    with contextlib.suppress(Exception):  # an estimate for a bar: what cannot be decoded is said by judge_video
        reader = imageio_ffmpeg.read_frames(str(path))
        meta = next(reader)
        reader.close()
        return max(1, round(meta["fps"] * meta["duration"]))
    return None
