"""``.spz``: Gaussians quantised and compressed to about a fifth of a PLY, through the library gsply (an optional extra).

Format: Niantic's spz, a header (magic, version, count, degree, bits, flags) and sections, gzip up to version 3, zstd in 4.
Flag 1 says that footprints are "mip"; the library leaves it alone, so it is set and read here. The format means right, up,
backwards by its axes while nothing in a scene says which way is up: values are written as they are, as in a PLY.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from pathlib import Path
from types import ModuleType

import numpy as np

from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, explain_os_error
from nerfvol.splats.splats import Splats

VERSIONS = (3, 4)
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved
_MAGIC = b"NGSP"
_FLAGS_AT = 14
_MIP = 1
_SMALLEST_ROW = 19  # bytes of a Gaussian of degree 0 once unpacked, version 2
_LARGEST_RATIO = 1032  # of deflate
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

    Positions are rounded to 2^-k scene units, k as large as 24 bits allow; colours, scales, opacities and rotations to 8
    to 10 bits. ``version`` 3 is read everywhere, 4 is smaller and read by few.

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
    means = splats.means.astype(np.float64) + splats.origin
    largest = float(np.abs(means).max(initial=0.0))
    bits = _POSITION_BITS if largest <= 1 else _POSITION_BITS - int(np.ceil(np.log2(largest * (1 + 1e-6))))
    if bits < 0:
        raise InputError(
            f"cannot write {path}: positions reach {largest:g}, an .spz file holds up to {2**_POSITION_BITS}"
        )
    lengths = np.linalg.norm(splats.quats.astype(np.float64), axis=1, keepdims=True)
    data = gsply.GSData(
        means=means.astype(np.float32), scales=splats.log_scales,
        quats=(splats.quats / np.maximum(lengths, _SHORTEST)).astype(np.float32),
        opacities=splats.logits, sh0=np.ascontiguousarray(splats.sh[:, :, 0]),
        shN=np.ascontiguousarray(splats.sh[:, :, 1:].transpose(0, 2, 1)),
        _format=gsply.create_ply_format(sh_degree=splats.sh_degree),
    )  # fmt: skip
    with atomic_write(path) as temporary:
        try:
            gsply.write_spz(temporary, data, version=version, fractional_bits=min(bits, 20))
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
    return splats


def _checked_flags(path: Path) -> int:
    """The header's flags; refuses what is no such file, and a count that the file cannot hold."""
    try:
        with path.open("rb") as file:
            start = file.read(1 << 16)
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise InputError(f"no such .spz file: {path}") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error
    if start[:2] == b"\x1f\x8b":
        try:
            start = zlib.decompressobj(31).decompress(start, _HEADER.size)
        except zlib.error as error:
            raise _fault(path, _first_line(error)) from error
    if len(start) < _HEADER.size:
        raise _fault(path, "it has no header")
    magic, version, count, _, _, flags, _ = _HEADER.unpack_from(start)
    if magic != _MAGIC or not 1 <= version <= max(VERSIONS):
        raise _fault(path, "it does not start like an .spz file of version 1 to 4")
    if count * _SMALLEST_ROW > _LARGEST_RATIO * size:
        raise _fault(path, f"it declares {count} Gaussians, which its {size} bytes cannot hold")
    return flags


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
