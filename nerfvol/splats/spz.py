"""``.spz``: Gaussians quantised and compressed to about a fifth of a PLY, through the library gsply (an optional extra).

Format: Niantic's spz, a header (magic, version, count, degree, bits, flags) and sections, gzip up to version 3, zstd in 4.
Flag 1 says that footprints are "mip"; the library leaves it alone, so it is set and read here. The format's axes are right,
up, backwards, where programs take those of a PLY for right, down, forwards: what converts between the two makes half a turn
about x, and so does this module, so that the .ply and the .spz of one scene open alike.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np

from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, explain_os_error
from nerfvol.machine import total_memory
from nerfvol.splats.near import relative
from nerfvol.splats.splats import MAX_DEGREE, Splats

VERSIONS = (3, 4)
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved
_MAGIC = b"NGSP"
_FLAGS_AT = 14
_MIP = 1
_HEADER_4 = struct.Struct("<4sIIBBBBI")  # the same, then the number of streams and where their table begins; unpacked
_SMALLEST_ROW = 19  # bytes of a Gaussian of degree 0 once unpacked, version 2
_EXTENSIONS = 1 << 20  # bytes that may follow the Gaussians
_RUN = 1 << 20  # bytes that are unpacked at a time
_LARGEST_RATIO = 1032  # of deflate
_FINEST_BITS, _COARSEST = 20, 4.0
"""Of fractions, the most that files have; and the width of splats that their rounding may be."""
_POSITION_BITS = 23  # besides the sign
_SHORTEST = 1e-12


def _library() -> ModuleType:
    """gsply; InputError where it is not installed."""
    try:
        import gsply
    except ImportError as error:
        raise InputError(
            "files of the kind .spz need the library gsply: install it with 'pip install gsply', or write a .ply"
        ) from error
    return gsply


def save_spz(path: str | os.PathLike[str], splats: Splats, version: int = 3) -> int:
    """Write ``splats`` to the file ``path`` atomically and return its size in bytes.

    Positions are rounded to 2^-k scene units, k as large as 24 bits allow, and relative to a point near them where map
    coordinates would lose their digits (near.relative: the format has no place for it); colours, scales, opacities and
    rotations to 8 to 10 bits. ``version`` 3 is read everywhere, 4 is smaller and read by few.

    Raises:
        InputError: gsply is missing, the path cannot be written, or a value is not finite or too large.
    """
    if version not in VERSIONS:
        raise InputError(f"the version of an .spz file must be 3 or 4, got {version!r}")
    gsply = _library()
    try:
        splats.validate()
    except InputError as error:
        raise InputError(f"cannot write {path}: {error}") from error
    splats = _half_a_turn(splats)
    means, _ = relative(splats)
    largest = float(np.abs(means).max(initial=0.0))
    bits = _POSITION_BITS if largest <= 1 else _POSITION_BITS - int(np.ceil(np.log2(largest * (1 + 1e-6))))
    if bits < 0:
        raise InputError(
            f"cannot write {path}: positions reach {largest:g}, an .spz file holds up to {2**_POSITION_BITS}"
        )
    bits = min(bits, _FINEST_BITS)
    width = float(np.exp(np.median(splats.log_scales))) if splats.n else 1.0
    if 2.0**-bits > _COARSEST * width:
        raise InputError(
            f"cannot write {path}: an .spz file would round positions to {2.0**-bits:.2g} units, and half of the splats are "
            f"narrower than {width:.2g}; a .ply keeps them"
        )
    lengths = np.linalg.norm(splats.quats.astype(np.float64), axis=1, keepdims=True)
    data = gsply.GSData(
        means=means, scales=splats.log_scales,
        quats=(splats.quats / np.maximum(lengths, _SHORTEST)).astype(np.float32),
        opacities=splats.logits, sh0=np.ascontiguousarray(splats.sh[:, :, 0]),
        shN=np.ascontiguousarray(splats.sh[:, :, 1:].transpose(0, 2, 1)),
        _format=gsply.create_ply_format(sh_degree=splats.sh_degree),
    )  # fmt: skip
    with atomic_write(path) as temporary:
        try:
            gsply.write_spz(temporary, data, version=version, fractional_bits=bits)
        except (ValueError, ImportError) as error:
            raise InputError(f"cannot write {path}: {_first_line(error)}") from error
        if splats.mode == "mip":
            temporary.write_bytes(_with_flag(temporary.read_bytes()))
    return Path(path).stat().st_size


def load_spz(path: str | os.PathLike[str]) -> Splats:
    """The Gaussians of an ``.spz`` file, versions 1 to 4, in the mode that its flag states. The origin is 0.

    Raises:
        InputError: gsply is missing, or one sentence that names the file and what is wrong with it.
    """
    gsply = _library()
    mode = "mip" if _checked_flags(Path(path)) & _MIP else "plain"
    try:
        data = gsply.read_spz(Path(path))
        sh = np.reshape(data.sh0, (-1, 3, 1))
        if data.shN is not None and np.size(data.shN):  # None for degree 0
            sh = np.concatenate([sh, np.reshape(data.shN, (len(sh), -1, 3)).transpose(0, 2, 1)], axis=2)
        splats = Splats(
            means=data.means, log_scales=data.scales, quats=data.quats, logits=np.reshape(data.opacities, -1), sh=sh,
            origin=np.zeros(3), mode=mode,
        )  # fmt: skip
        splats.validate()
    except InputError as error:
        raise _fault(path, str(error)) from error
    except Exception as error:  # whatever a damaged file makes the library do is the file's fault
        raise _fault(path, _first_line(error)) from error
    return _half_a_turn(splats)


def _half_a_turn(splats: Splats) -> Splats:
    """The splats turned by 180 degrees about the x axis: y and z change signs, and harmonics odd in the two together."""
    turn = np.array([1.0, -1.0, -1.0])
    # Of y, z, x; xy, yz, zz, xz, xx - yy; y(..), xyz, y(..), z(..), x(..), z(..), x(..).
    signs = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
    return replace(
        splats, means=(splats.means * turn).astype(np.float32), origin=splats.origin * turn,
        quats=splats.quats * np.array([1, 1, -1, -1], np.float32), sh=splats.sh * signs[: splats.sh.shape[2]],
    )  # fmt: skip


def _checked_flags(path: Path) -> int:
    """The header's flags; refuses what is no such file, and what the library would spend memory on in vain."""
    try:
        with path.open("rb") as file:
            start = file.read(_HEADER_4.size)
            size = os.fstat(file.fileno()).st_size
            packed = start[:2] == b"\x1f\x8b"
            if packed:
                start = zlib.decompressobj(31).decompress(start + file.read(1 << 16), _HEADER.size)
            if len(start) < _HEADER.size:
                raise _fault(path, "it has no header")
            magic, version, count, degree, _, flags, _ = _HEADER.unpack_from(start)
            if magic != _MAGIC or version < 1:
                raise _fault(path, f"it does not start like an .spz file of version 1 to {max(VERSIONS)}")
            if version > max(VERSIONS):
                raise _fault(path, f"it is of version {version}, versions 1 to {max(VERSIONS)} are known")
            if degree > MAX_DEGREE:
                raise _fault(path, f"its harmonics are of degree {degree}, expected 0 to {MAX_DEGREE}")
            if count * _SMALLEST_ROW > _LARGEST_RATIO * size:
                raise _fault(path, f"it declares {count} Gaussians, which its {size} bytes cannot hold")
            _require_memory(path, count, degree)
            row = _SMALLEST_ROW + (version >= 3) + 3 * ((degree + 1) ** 2 - 1)
            if packed:
                _check_gzip(path, file, _HEADER.size + count * row)
            else:
                _check_streams(path, file, size)
    except FileNotFoundError as error:
        raise InputError(f"no such .spz file: {path}") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error
    except zlib.error as error:
        raise _fault(path, _first_line(error)) from error
    return flags


def _require_memory(path: Path, count: int, degree: int) -> None:
    """Refuses Gaussians that do not fit: the library's arrays, ours and a copy of them."""
    need, have = 3 * 4 * count * (11 + 3 * (degree + 1) ** 2), total_memory()
    if have is not None and need > 0.8 * have:
        raise _fault(
            path, f"its {count} Gaussians need {need / 2**30:.1f} GiB, and there are {have / 2**30:.1f} GiB of memory"
        )


def _check_gzip(path: Path, file: BinaryIO, wanted: int) -> None:
    """Refuses what unpacks to less than ``wanted`` bytes, or to so much more that it is no extension of the format."""
    file.seek(0)
    stream, found = zlib.decompressobj(31), 0
    while found <= wanted + _EXTENSIONS:
        data = stream.unused_data if stream.eof else stream.unconsumed_tail
        if not (data := data or file.read(_RUN)):
            break
        if stream.eof:  # gzip's members may follow each other
            stream = zlib.decompressobj(31)
        found += len(stream.decompress(data, _RUN))
    if found < wanted:
        raise _fault(path, f"it should unpack to {wanted} bytes, and ends after {found}")
    if found > wanted + _EXTENSIONS:
        raise _fault(path, f"it should unpack to {wanted} bytes, and goes on for {_EXTENSIONS} more")


def _check_streams(path: Path, file: BinaryIO, size: int) -> None:
    """Refuses streams of version 4 that say of themselves that they unpack to more than the table of contents does."""
    try:
        from zstandard import ZstdError, frame_content_size  # the library needs it for these files
    except ImportError as error:
        raise InputError(f"{path} is of version 4, which needs zstandard: pip install 'nerfvol[spz]'") from error
    file.seek(0)
    start = file.read(_HEADER_4.size)
    if len(start) < _HEADER_4.size:
        raise _fault(path, "it has no header")
    *_, streams, table_at = _HEADER_4.unpack(start)
    file.seek(table_at)
    table = file.read(16 * streams)
    if len(table) < 16 * streams:
        raise _fault(path, "it ends within its table of contents")
    at = table_at + 16 * streams
    for packed, unpacked in struct.iter_unpack("<QQ", table):
        if at + packed > size:
            raise _fault(path, "it ends within its streams")
        file.seek(at)
        try:
            stated = frame_content_size(file.read(18))  # the longest header of a frame
        except ZstdError as error:
            raise _fault(path, _first_line(error)) from error
        if stated > unpacked:
            raise _fault(path, f"a stream should unpack to {unpacked} bytes, it states {stated}")
        at += packed


def _with_flag(data: bytes) -> bytes:
    """The file with the flag "mip" set."""
    packed = data[:2] == b"\x1f\x8b"
    content = bytearray(gzip.decompress(data) if packed else data)
    content[_FLAGS_AT] |= _MIP
    return gzip.compress(bytes(content), mtime=0) if packed else bytes(content)


def _fault(path: str | os.PathLike[str], reason: str) -> InputError:
    return InputError(f"{path} is not a usable .spz file: {reason}")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
