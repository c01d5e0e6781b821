"""The compiled PNG decoder against pixels that were never a file, and against Pillow on files that are damaged."""

from __future__ import annotations

import functools
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfvol.datasets import images
from nerfvol.errors import InputError
from nerfvol.native import native

kernels = native()
pytestmark = pytest.mark.skipif(kernels is None, reason="the decoder is one of the compiled kernels")

HEAD = b"\x89PNG\r\n\x1a\n"


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def filtered(pixels: np.ndarray, filters: np.ndarray) -> bytes:
    """Rows of ``pixels`` (h, w, c), each by its filter, as ISO/IEC 15948 writes them down: byte by byte."""
    height, width, c = pixels.shape
    rows = pixels.reshape(height, width * c).astype(int)
    out = bytearray()
    for y in range(height):
        above = rows[y - 1] if y else np.zeros(width * c, int)
        out.append(filters[y])
        for i, x in enumerate(rows[y]):
            a, b = (int(rows[y][i - c]) if i >= c else 0), int(above[i])
            d = int(above[i - c]) if i >= c else 0
            p = a + b - d
            paeth = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - d), 2, d))[2]
            out.append((int(x) - (0, a, b, (a + b) // 2, paeth)[filters[y]]) % 256)
    return bytes(out)


def png(pixels: np.ndarray, packed: bytes, pieces: int = 1, extra: bytes = b"") -> bytes:
    height, width, c = pixels.shape
    header = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[c], 0, 0, 0)
    cuts = [len(packed) * i // pieces for i in range(pieces + 1)]
    data = b"".join(chunk(b"IDAT", packed[a:b]) for a, b in zip(cuts, cuts[1:], strict=False))
    return HEAD + chunk(b"IHDR", header) + extra + data + chunk(b"IEND", b"")


def decode(file: bytes) -> np.ndarray | None:
    assert kernels is not None
    out = np.full(kernels.png_size(file), 77, np.uint8)
    return out if kernels.decode_png(file, out) else None


def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (h, w, c), np.uint8) for h, w, c in ((9, 13, 4), (7, 1, 3), (1, 17, 3), (6, 40, 4))]
    steps = np.add.outer(np.arange(40), np.arange(50))[..., None] // 7 + np.arange(4) * 3
    periods = [np.resize(np.arange(1, 1 + n, dtype=np.uint8), (5, 30, 3)) for n in range(1, 10)]  # repeats that overlap
    return [*noise, steps.astype(np.uint8), np.tile(noise[0], (6, 4, 1)), *periods]


@functools.cache
def rows_by_filter() -> list[tuple[np.ndarray, bytes]]:
    """The pictures with their rows by each filter, and mixed."""
    rng = np.random.default_rng(0)
    which = [lambda n, f=f: np.full(n, f) for f in range(5)] + [lambda n: rng.integers(0, 5, n)]
    return [(pixels, filtered(pixels, make(len(pixels)))) for pixels in pictures() for make in which]


@pytest.mark.parametrize("level", [0, 1, 6, 9])
@pytest.mark.parametrize("strategy", [zlib.Z_DEFAULT_STRATEGY, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE, zlib.Z_FIXED])
def test_every_filter_and_kind_of_block(level: int, strategy: int) -> None:
    for pixels, rows in rows_by_filter():
        packer = zlib.compressobj(level, zlib.DEFLATED, 15, 9, strategy)
        np.testing.assert_array_equal(decode(png(pixels, packer.compress(rows) + packer.flush(), pieces=3)), pixels)


def test_long_words_and_far_distances() -> None:
    """Bytes as rare as Fibonacci numbers get Huffman words of more than eleven bits; repeats from 32 kB back."""
    rng = np.random.default_rng(1)
    counts = [1, 1]
    while len(counts) < 22:
        counts.append(counts[-1] + counts[-2])
    skewed = rng.permutation(np.repeat(np.arange(22, dtype=np.uint8), counts))
    far = np.tile(rng.integers(0, 256, 32_000, np.uint8), 3)
    for values, strategy in ((skewed, zlib.Z_HUFFMAN_ONLY), (far, zlib.Z_DEFAULT_STRATEGY)):
        pixels = np.resize(values, (len(values) // 300, 100, 3)).astype(np.uint8)
        packer = zlib.compressobj(9, zlib.DEFLATED, 15, 9, strategy)
        rows = b"".join(b"\0" + row.tobytes() for row in pixels)
        np.testing.assert_array_equal(decode(png(pixels, packer.compress(rows) + packer.flush())), pixels)


def test_other_kinds_are_left_to_pillow(tmp_path: Path) -> None:
    pixels = pictures()[0]
    packed = zlib.compress(filtered(pixels[..., :3], np.zeros(len(pixels), int)))
    by_colour = png(pixels[..., :3], packed, extra=chunk(b"tRNS", b"\0\1\0\2\0\3"))
    assert decode(by_colour) is None
    (tmp_path / "colour.png").write_bytes(by_colour)
    assert images.read_image(tmp_path / "colour.png").shape == pixels.shape
    for mode in ("L", "P", "1", "LA", "I;16"):
        Image.new(mode, (5, 4)).save(tmp_path / "other.png")
        assert kernels is not None and kernels.png_size((tmp_path / "other.png").read_bytes()) == (0, 0, 0)
        assert images.read_image(tmp_path / "other.png").shape[:2] == (4, 5)


def test_damage_is_never_taken_for_pixels(tmp_path: Path) -> None:
    """One changed byte: the same answer as Pillow's, or a no; cut short or of another size: a no. Nothing is written beyond."""
    rng = np.random.default_rng(2)
    pixels = pictures()[4]
    good = png(pixels, zlib.compress(filtered(pixels, rng.integers(0, 5, len(pixels)))), pieces=2)
    size = struct.pack(">II", 50, 41)
    lies = good[:16] + size + good[24:]
    assert decode(lies) is None
    assert all(decode(good[:n]) is None for n in range(33, len(good), 7))
    for place in rng.permutation(np.arange(33, len(good)))[:400]:
        bad = bytearray(good)
        bad[place] ^= 1 << int(rng.integers(8))
        found = decode(bytes(bad))
        assert found is None or (found == pixels).all()  # a chunk's check sum, or the window a stream asks for
    file = tmp_path / "bad.png"
    file.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match="bad.png: the image is damaged or truncated"):
        images.read_image(file)


def test_a_bomb_takes_no_memory() -> None:
    """A few bytes that declare a third of a gigabyte: refused before any of it is taken."""
    pixels = pictures()[0]
    small = png(pixels, zlib.compress(b"\0" * 1000))
    bomb = small[:16] + struct.pack(">II", 9_000, 9_000) + small[24:]
    script = (
        "import resource, sys, numpy as np, _nerfvol_kernels as kernels\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "bomb, out, before = bytes.fromhex(sys.argv[1]), np.empty((9_000, 9_000, 4), np.uint8), peak()\n"
        "assert not kernels.decode_png(bomb, out)\n"
        "print((peak() - before) / before)\n"
    )
    found = subprocess.run([sys.executable, "-c", script, bomb.hex()], capture_output=True, text=True, check=True)
    assert float(found.stdout) < 0.5  # of Python's own; all of it would be eight times that
