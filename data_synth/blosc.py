"""Frames of Blosc 1 with LZ4, zlib or no compression inside, as OpenVDB writes them (c-blosc, README_CHUNK_FORMAT.rst).

A frame is a header of 16 bytes, the starts of its blocks, and the blocks. A block is one stream, or one for each byte of
an element; its bytes are shuffled: all first bytes of the elements, then all second ones, and so on. Every length is
checked against the data, so that a damaged or hostile frame is a ``ValueError``.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from data_synth.jit import kernel

SHUFFLED, COPIED, BIT_SHUFFLED, WHOLE = 1, 2, 4, 16  # bits of the flags; 5-7 are the compressor
LZ4, ZLIB = 1, 3
NAMES = {0: "blosclz", 2: "snappy", 4: "zstd"}


@kernel
def lz4_block(source, out):
    """Decode one LZ4 block (lz4_Block_format.md) into ``out``; the number of bytes written, -1 if it is damaged."""
    i, o, n, room = 0, 0, source.size, out.size
    while i < n:
        token = int(source[i])
        i += 1
        length = token >> 4
        if length == 15:
            more = 255
            while more == 255:
                if i >= n:
                    return -1
                more = int(source[i])
                length += more
                i += 1
        if i + length > n or o + length > room:
            return -1
        for k in range(length):
            out[o + k] = source[i + k]
        i, o = i + length, o + length
        if i >= n:  # the last sequence is literals alone
            return o
        if i + 2 > n:
            return -1
        offset = int(source[i]) | int(source[i + 1]) << 8
        i += 2
        length = token & 15
        if length == 15:
            more = 255
            while more == 255:
                if i >= n:
                    return -1
                more = int(source[i])
                length += more
                i += 1
        length += 4
        if offset == 0 or offset > o or o + length > room:
            return -1
        for k in range(length):
            out[o + k] = out[o + k - offset]
        o += length
    return o


def decompress(frame: bytes, size: int) -> np.ndarray:
    """The ``size`` bytes of a frame as uint8. ValueError where it is damaged, of another size or of another compressor."""
    if len(frame) < 16:
        raise ValueError("a blosc frame is shorter than its header")
    flags, width = frame[2], frame[3] or 1
    total, block, _ = struct.unpack_from("<III", frame, 4)
    if total != size:
        raise ValueError(f"a blosc frame holds {total} bytes, not {size}")
    data = np.frombuffer(frame, np.uint8)
    if flags & COPIED:
        if len(frame) < 16 + size:
            raise ValueError("a blosc frame ends too early")
        return data[16 : 16 + size].copy()
    compressor = flags >> 5
    if compressor not in (LZ4, ZLIB) or flags & BIT_SHUFFLED:
        kind = "bit shuffling" if flags & BIT_SHUFFLED else NAMES.get(compressor, f"compressor {compressor}")
        raise ValueError(f"its blosc frames use {kind}, expected LZ4 or zlib with byte shuffling")
    blocks = -(-size // block) if block else 0
    if blocks == 0 or 16 + 4 * blocks > len(frame):
        raise ValueError("a blosc frame has no blocks")
    out = np.empty(size, np.uint8)
    for k, start in enumerate(struct.unpack_from(f"<{blocks}I", frame, 16)):
        part = out[k * block : (k + 1) * block]
        split = not flags & WHOLE and width <= 16 and block // width >= 128 and len(part) == block
        plain = _streams(frame, data, start, len(part), width if split else 1, compressor)
        part[:] = _unshuffled(plain, width) if flags & SHUFFLED and width > 1 else plain
    return out


def _streams(frame: bytes, data: np.ndarray, at: int, size: int, count: int, compressor: int) -> np.ndarray:
    """One block: ``count`` streams of equal size, one behind the other."""
    out, each = np.empty(size, np.uint8), size // count
    for k in range(count):
        if at + 4 > len(frame):
            raise ValueError("a blosc frame ends too early")
        (length,) = struct.unpack_from("<i", frame, at)
        at += 4
        if length < 0 or at + length > len(frame):
            raise ValueError("a blosc frame ends too early")
        part = out[k * each : (k + 1) * each]
        if length == each:
            part[:] = data[at : at + length]
        elif compressor == LZ4:
            if lz4_block(data[at : at + length], part) != each:
                raise ValueError("its LZ4 data are damaged")
        else:
            plain = zlib.decompressobj().decompress(frame[at : at + length], each)
            if len(plain) != each:
                raise ValueError("its zlib data are damaged")
            part[:] = np.frombuffer(plain, np.uint8)
        at += length
    return out


def _unshuffled(plain: np.ndarray, width: int) -> np.ndarray:
    whole = len(plain) // width * width
    return np.concatenate([plain[:whole].reshape(width, -1).T.ravel(), plain[whole:]])
