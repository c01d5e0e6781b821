"""Volumes as scanners and their tools write them: MetaImage (.mhd, .mha), NRRD (.nrrd) and NIfTI-1 (.nii, .nii.gz).

Scalar samples in three dimensions, raw or compressed by gzip or zlib. Their order is kept as it lies in the file, x fastest:
directions and origins in the header are not applied, spacings are. Every size is checked before anything is read.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np

from data_synth.errors import InputError

LIMIT = 1 << 30  # samples; more is refused
MET = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
NRRD = {
    "int8": "i1", "signed char": "i1", "uint8": "u1", "uchar": "u1", "unsigned char": "u1", "int16": "i2", "short": "i2",
    "uint16": "u2", "ushort": "u2", "unsigned short": "u2", "int32": "i4", "int": "i4", "uint32": "u4", "uint": "u4",
    "unsigned int": "u4", "float": "f4", "double": "f8",
}  # fmt: skip
NIFTI = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4"}
SUFFIXES = (".mhd", ".mha", ".nrrd", ".nii", ".nii.gz")


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(samples (nx, ny, nz) float32, spacing (3,)). InputError, one sentence, for what cannot be used."""
    try:
        if path.name.endswith((".nii", ".nii.gz")):
            return _nifti(path)
        return _nrrd(path) if path.suffix == ".nrrd" else _metaimage(path)
    except (OSError, EOFError, zlib.error, struct.error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: expected a volume of scalar samples, its header has a wrong or missing {error}"
        ) from error


def _samples(path: Path, data: bytes, kind: str, shape: list[int], packed: str = "") -> np.ndarray:
    """(nx, ny, nz) samples from raw or compressed bytes."""
    if len(shape) != 3 or min(shape) < 1 or np.prod(np.array(shape, float)) > LIMIT:
        raise InputError(f"{path}: expected 3 dimensions of at most {LIMIT} samples, got {shape}")
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    if packed:
        data = zlib.decompressobj(31 if packed == "gzip" else 15).decompress(data, size)
    if len(data) < size:
        raise InputError(f"{path}: expected {size} bytes of samples, got {len(data)}")
    return np.frombuffer(data, kind, count=size // np.dtype(kind).itemsize).reshape(shape[::-1]).transpose(2, 1, 0)


def _beside(path: Path, name: str) -> Path:
    """A data file that a header names: in the same folder, whatever folder it says."""
    return path.parent / Path(name.replace("\\", "/")).name


def _fields(text: str, mark: str) -> dict[str, str]:
    pairs = (line.split(mark, 1) for line in text.splitlines() if mark in line and not line.startswith("#"))
    return {key.strip().lower(): value.strip(" =\t\r") for key, value in pairs}


def _metaimage(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = path.read_bytes()
    end = data.index(b"ElementDataFile")
    end = data.index(b"\n", end) + 1 if b"\n" in data[end:] else len(data)
    f = _fields(data[:end].decode("ascii"), "=")
    kind = (">" if f.get("elementbyteordermsb", f.get("binarydatabyteordermsb", "False")) == "True" else "<") + MET[
        f["elementtype"]
    ]
    body = data[end:] if f["elementdatafile"] == "LOCAL" else _beside(path, f["elementdatafile"]).read_bytes()
    packed = "zlib" if f.get("compresseddata", "False") == "True" else ""
    spacing = np.array(f.get("elementspacing", f.get("elementsize", "1 1 1")).split(), float)
    return _samples(path, body, kind, [int(n) for n in f["dimsize"].split()], packed), spacing


def _nrrd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = path.read_bytes()
    if not data.startswith(b"NRRD"):
        raise InputError(f"{path}: expected a file that begins with NRRD")
    end = data.find(b"\n\n") + 2 if b"\n\n" in data else len(data)
    f = _fields(data[:end].decode("ascii"), ":")
    shape = [int(n) for n in f["sizes"].split()]
    detached = f.get("data file", f.get("datafile"))
    body = _beside(path, detached).read_bytes() if detached else data[end:]
    encoding = f["encoding"].lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise InputError(f"{path}: expected the encoding raw or gzip, got {encoding}")
    kind = (">" if f.get("endian", "little") == "big" else "<") + NRRD[f["type"]]
    if "space directions" in f:
        rows = [row.strip("() ") for row in f["space directions"].split(")") if row.strip("() ")]
        spacing = np.array([np.linalg.norm([float(x) for x in row.split(",")]) for row in rows])
    else:
        spacing = np.array(f.get("spacings", "1 1 1").split(), float)
    return _samples(path, body, kind, shape, "" if encoding == "raw" else "gzip"), spacing


def _nifti(path: Path) -> tuple[np.ndarray, np.ndarray]:
    most = 8 * LIMIT + (1 << 20)
    if path.suffix == ".gz":
        with gzip.open(path, "rb") as file:
            data = file.read(most)
    else:
        data = path.read_bytes()
    order = "<" if data[:4] == struct.pack("<i", 348) else ">"
    if len(data) < 352 or struct.unpack_from(order + "i", data)[0] != 348 or data[344:347] != b"n+1":
        raise InputError(f"{path}: expected a NIfTI-1 file with its data (n+1)")
    dims = struct.unpack_from(order + "8h", data, 40)
    (code,) = struct.unpack_from(order + "h", data, 70)
    pixels = struct.unpack_from(order + "8f", data, 76)
    start, slope, shift = struct.unpack_from(order + "3f", data, 108)
    shape = [int(n) for n in dims[1 : dims[0] + 1]]
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    values = _samples(path, data[max(int(start), 352) :], order + NIFTI[code], shape)
    return (values * slope + shift if slope not in (0.0, 1.0) or shift != 0.0 else values), np.abs(pixels[1:4]).astype(
        float
    )
