"""Named arrays and a JSON document in one safetensors file: written piece by piece, read only after every check.

safetensors is raw arrays behind a JSON header, so reading one can run no code. The header's ``__metadata__`` maps
strings to strings; nerfvol keeps its own document as JSON text under one key. Writing streams each array from its own
memory (no second copy of a large run) to a temporary name that is renamed when whole.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from nerfvol.errors import InputError, shown
from nerfvol.files.atomic import atomic_write, explain_os_error

_NAMES = {
    "float64": "F64", "float32": "F32", "float16": "F16", "int64": "I64", "int32": "I32", "int16": "I16",
    "int8": "I8", "uint64": "U64", "uint32": "U32", "uint16": "U16", "uint8": "U8", "bool": "BOOL",
}  # fmt: skip
_DTYPES = {code: name for name, code in _NAMES.items()}
# The safetensors format's own bound on the header.
_MAX_HEADER = 100_000_000
_DOCUMENT_KEY = "nerfvol"
CACHE_LINE = 64


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], document: Mapping[str, Any]) -> int:
    """Write ``arrays`` and the JSON-able ``document`` to the safetensors file ``path`` atomically; returns its bytes.

    Arrays may have any shape; they are written in C order.

    Raises:
        InputError: the disk is full or the path not writable.
        ValueError: an array's dtype is not one of safetensors', or ``document`` holds NaN.
    """
    header: dict[str, Any] = {"__metadata__": {_DOCUMENT_KEY: json.dumps(document, allow_nan=False)}}
    ordered = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    # Widest elements first keeps every array aligned to its own element size; widest rows first among them, and data that
    # begin on a cache line, keep the rows of vertices on cache lines where the file is mapped.
    names = sorted(ordered, key=lambda name: (-ordered[name].itemsize, -_row_bytes(ordered[name]), name))
    offset = 0
    for name in names:
        array = ordered[name]
        if array.dtype.name not in _NAMES or not array.dtype.isnative:
            raise ValueError(f"array {name!r} has dtype {array.dtype}, which a safetensors file cannot hold")
        end = offset + array.nbytes
        header[name] = {"dtype": _NAMES[array.dtype.name], "shape": list(array.shape), "data_offsets": [offset, end]}
        offset = end
    text = json.dumps(header, separators=(",", ":")).encode("utf-8")
    text += b" " * (-(8 + len(text)) % CACHE_LINE)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(len(text).to_bytes(8, "little"))
        file.write(text)
        for name in names:
            file.write(ordered[name].reshape(-1).view(np.uint8).data)
    return 8 + len(text) + offset


class ArrayFile:
    """An open safetensors file: shapes and dtypes are known, and no array is read until :meth:`read` asks for it."""

    def __init__(self, path: str | os.PathLike[str], kind: str):
        """Open ``path``; ``kind`` ("octree file", "checkpoint") names it in messages.

        Raises:
            InputError: missing, truncated, not safetensors, or its document is not the JSON object nerfvol writes.
        """
        self.path = Path(path)
        self.kind = kind
        _check_frame(self.path, kind)
        try:
            self._file = safe_open(self.path, framework="numpy")
            self._file.__enter__()
            metadata = self._file.metadata() or {}
            self.shapes = {name: tuple(self._file.get_slice(name).get_shape()) for name in self._file.keys()}  # noqa: SIM118
            self._codes = {name: self._file.get_slice(name).get_dtype() for name in self.shapes}
        except (SafetensorError, OSError, ValueError) as error:
            raise InputError(f"{path} is not a usable {kind}: {_first_line(error)}") from error
        try:
            document = json.loads(metadata[_DOCUMENT_KEY])
        except KeyError as error:
            raise self.fault("it was not written by nerfvol (its header holds no nerfvol document)") from error
        except (ValueError, RecursionError) as error:  # ValueError: also a number of thousands of digits
            raise self.fault("the document in its header is not JSON") from error
        if not isinstance(document, dict):
            raise self.fault("the document in its header is not a JSON object")
        self.document: dict[str, Any] = document

    def fault(self, reason: str) -> InputError:
        """The error that says this file cannot be used because of ``reason``."""
        return InputError(f"{self.path} is not a usable {self.kind}: {reason}")

    def dtype(self, name: str) -> np.dtype:
        """The numpy dtype of the array ``name``."""
        code = self._codes[name]
        if code not in _DTYPES:
            raise self.fault(f"array {shown(name)} has dtype {code}, which nerfvol does not use")
        return np.dtype(_DTYPES[code])

    def expect(self, name: str, dtype: str, shape: tuple[int | None, ...]) -> tuple[int, ...]:
        """Check the array's declared dtype and shape (None = any length) without reading it; returns the shape."""
        if name not in self.shapes:
            raise self.fault(f"array {shown(name)} is missing")
        found = self.shapes[name]
        fits = len(found) == len(shape) and all(
            want is None or want == have for want, have in zip(shape, found, strict=True)
        )
        if not fits or self.dtype(name) != np.dtype(dtype):
            wanted = "×".join("n" if n is None else str(n) for n in shape)
            came = "×".join(map(str, found)) or "scalar"
            raise self.fault(
                f"array {shown(name)} should be {dtype} of shape {wanted}, it is {self.dtype(name)} of {came}"
            )
        return found

    def read(self, name: str) -> np.ndarray:
        """The array ``name`` in the shape and dtype it was written with: writable memory of its own that outlives the file.

        Raises:
            InputError: there is no such array, its dtype is not one of numpy's, or it cannot be read.
        """
        if name not in self.shapes:
            raise self.fault(f"array {shown(name)} is missing")
        self.dtype(name)
        try:
            return self._file.get_tensor(name)
        except (SafetensorError, OSError) as error:
            raise self.fault(_first_line(error)) from error

    def map(self, name: str) -> np.ndarray:
        """The array ``name`` where it lies in the file: pages that are read when they are touched and shared by processes.

        Writing to it changes this process's copy of a page, never the file.

        Raises:
            InputError: there is no such array, its dtype is not one of numpy's, or it cannot be mapped.
        """
        if name not in self.shapes:
            raise self.fault(f"array {shown(name)} is missing")
        dtype, shape = self.dtype(name), self.shapes[name]
        if not np.prod(shape):
            return np.empty(shape, dtype)
        try:
            with self.path.open("rb") as file:
                length = int.from_bytes(file.read(8), "little")
                start = json.loads(file.read(length))[name]["data_offsets"][
                    0
                ]  # checked by the reader that opened the file
            # As a plain array: a memmap's own class slows down every view of it.
            return np.asarray(np.memmap(self.path, dtype, "c", 8 + length + start, shape))
        except (OSError, ValueError) as error:
            raise self.fault(_first_line(error)) from error

    def close(self) -> None:
        """Let go of the file."""
        self._file.__exit__(None, None, None)

    def __enter__(self) -> ArrayFile:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _row_bytes(array: np.ndarray) -> int:
    return array.nbytes // max(len(array), 1) if array.ndim else 0


def _check_frame(path: Path, kind: str) -> None:
    """Refuse what is no safetensors file by its first bytes and its length, before the reader maps it."""
    try:
        size = path.stat().st_size
        if path.is_dir():
            raise InputError(f"{path} is a folder, expected a {kind}")
        with path.open("rb") as file:
            start = file.read(9)
    except FileNotFoundError as error:
        raise InputError(f"no such {kind}: {path}") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error
    length = int.from_bytes(start[:8], "little")
    if len(start) < 9 or start[8:] != b"{" or length > _MAX_HEADER:
        raise InputError(f"{path} is not a usable {kind}: it does not start like a safetensors file")
    if 8 + length > size:
        raise InputError(f"{path} is not a usable {kind}: its header needs {8 + length} bytes, it has {size}")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
