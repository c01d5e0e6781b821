"""PLY files: one header of text, then the rows of its elements; nothing is believed before it is checked.

The header ends within 64 kB; the number of rows is held against the file's size before memory is taken for them.
Format: G. Turk, "The PLY polygon file format", 1994. Rows are read as they lie where all their properties are numbers;
lists in the vertices themselves are refused, in other elements only if these come before what is read.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, explain_os_error

MAX_HEADER = 1 << 16
MOST_PROPERTIES = 512
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_RUN = 1 << 24  # bytes that are read at a time


@dataclass
class Element:
    """Rows of one kind: how many, and the numpy dtype of each property by its name, in the file's order.

    fault: what of its properties cannot be read, such as a list; "": nothing.
    """

    count: int
    dtypes: dict[str, np.dtype] = field(default_factory=dict)
    fault: str = ""


class PlyFile:
    """An open PLY file whose header is known; rows are read when :meth:`read` asks for them.

    ``elements``: by name, in the file's order; ``count``, ``dtypes``: of the vertices; ``comments``: without the word itself;
    ``format``: binary_little_endian, binary_big_endian or ascii.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            if self.path.is_dir():
                raise InputError(f"{path} is a folder, expected a PLY file")
            self._file = self.path.open("rb")
        except FileNotFoundError as error:
            raise InputError(f"no such PLY file: {path}") from error
        except OSError as error:
            raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._parse(self._header())
        except OSError as error:
            self._file.close()
            raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error
        except InputError:
            self._file.close()
            raise

    def fault(self, reason: str) -> InputError:
        """The error that says this file cannot be used because of ``reason``."""
        return InputError(f"{self.path} is not a usable PLY file: {reason}")

    def __enter__(self) -> PlyFile:
        return self

    def __exit__(self, *exc: object) -> None:
        self._file.close()

    def _header(self) -> list[list[str]]:
        """The header's lines, split into words, without the first and the last."""
        start = self._file.read(MAX_HEADER)
        if start[:4] not in (b"ply\n", b"ply\r"):
            raise self.fault("it does not start with the line 'ply'")
        end = start.find(b"\nend_header")
        if end < 0:
            raise self.fault(f"its header has no end within {MAX_HEADER} bytes")
        stop = start.find(b"\n", end + 1)
        if stop < 0 or start[end + 11 : stop].strip():
            raise self.fault("its line 'end_header' does not end")
        self._rows_at = stop + 1
        try:
            text = start[:end].decode("ascii")
        except UnicodeDecodeError:
            text = start[:end].decode("latin-1")  # comments may hold anything
        return [words for line in text.splitlines()[1:] if (words := line.split())]

    def _parse(self, lines: list[list[str]]) -> None:
        self.comments = [" ".join(words[1:]) for words in lines if words[0] in ("comment", "obj_info")]
        self.elements: dict[str, Element] = {}
        self.format, element = "", None
        for words in lines:
            if words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format" and len(words) == 3 and words[1] in _FORMATS:
                self.format = words[1]
            elif words[0] == "element" and len(words) == 3:
                if words[1] in self.elements:
                    raise self.fault(f"its header declares the element {words[1][:40]!r} twice")
                element = self.elements[words[1]] = Element(self._number(words[2]))
            elif words[0] == "property" and len(words) >= 3:
                if element is not None:
                    self._property(element, words)
            else:
                raise self.fault(f"its header has a line that is not understood: {' '.join(words)[:60]!r}")
        if not self.format:
            raise self.fault("its header states no format that is known (binary or ascii, version 1.0)")
        vertices = self.elements.get("vertex")
        if vertices is None or not vertices.dtypes:
            raise self.fault("its header declares no vertices")
        self.count, self.dtypes = vertices.count, vertices.dtypes
        self._place("vertex")

    def _number(self, word: str) -> int:
        if not (word.isascii() and word.isdigit()) or len(word) > 18:
            raise self.fault(f"a count should be a whole number, it is {word[:40]!r}")
        return int(word)

    def _property(self, element: Element, words: Sequence[str]) -> None:
        if not self.format:
            raise self.fault("its header lists properties before it states the format")
        fault, is_vertex = "", element is self.elements.get("vertex")
        if words[1] == "list":
            fault = f"its vertices have a list ({' '.join(words)[:60]!r}), expected numbers only"
        elif len(words) != 3 or words[1] not in _TYPES:
            fault = f"a property should be a type and a name, it is {' '.join(words[1:])[:60]!r}"
        elif words[2] in element.dtypes or len(element.dtypes) == MOST_PROPERTIES:
            what = "vertices have" if is_vertex else "rows have"
            fault = f"its {what} the property {words[2][:40]!r} twice, or more than {MOST_PROPERTIES}"
        if fault and is_vertex:
            raise self.fault(fault)
        if fault:
            element.fault = fault
        else:
            element.dtypes[words[2]] = np.dtype(_FORMATS[self.format] + _TYPES[words[1]])

    def _place(self, name: str) -> int:
        """Where the rows of an element begin: the byte or, in ascii, the line after the header; refuses counts that the file
        cannot hold."""
        have, need, at = self._size - self._rows_at + (self.format == "ascii"), 0, 0
        for other, element in self.elements.items():
            if element.fault and element.count and other == name:
                raise self.fault(
                    f"its element {name!r} has a list, or a property that is twice there or of no known type"
                )
            if element.fault and element.count:
                before = "its vertices" if name == "vertex" else f"its element {name!r}"
                raise self.fault(f"the element {other[:40]!r}, whose rows differ in length, comes before {before}")
            at = need if self.format != "ascii" else at
            row = sum(t.itemsize for t in element.dtypes.values())
            if self.format == "ascii":
                row = max(1, 2 * len(element.dtypes))  # a digit and a space or the line's end
            need += element.count * row
            if need > have:
                rows = "vertices" if other == "vertex" else f"rows of {other[:40]!r}"
                raise self.fault(
                    f"it declares {element.count} {rows}, which need {element.count * row} bytes, and holds {have}"
                )
            if other == name:
                break
            if self.format == "ascii":
                at += element.count
        return at

    def read(self, name: str = "vertex") -> dict[str, NDArray]:
        """The properties of an element's rows by name, each an array (count,) of native byte order.

        Raises:
            InputError: the file cannot be read, is shorter than its header says, or holds other things than its numbers.
        """
        try:
            at = self._place(name)
            if self.format == "ascii":
                self._file.seek(self._rows_at)
                for _ in range(at):
                    self._file.readline(_RUN)
                return self._read_text(name)
            self._file.seek(self._rows_at + at)
            return self._read_binary(self.elements[name])
        except OSError as error:
            raise InputError(f"cannot read {self.path}: {explain_os_error(error)}") from error

    def _read_binary(self, element: Element) -> dict[str, NDArray]:
        row = np.dtype(list(element.dtypes.items()))
        out = {name: np.empty(element.count, dtype.newbyteorder("=")) for name, dtype in element.dtypes.items()}
        run = max(1, _RUN // max(1, row.itemsize))
        for at in range(0, element.count, run):
            n = min(run, element.count - at)
            data = self._file.read(n * row.itemsize)
            if len(data) != n * row.itemsize:
                raise self.fault("it became shorter while it was read")
            rows = np.frombuffer(data, row)
            for name, column in out.items():
                column[at : at + n] = rows[name]
        return out

    def _read_text(self, name: str) -> dict[str, NDArray]:
        """Numbers as text, by columns of float64: enough for every type that PLY has."""
        element = self.elements[name]
        values = np.empty((element.count, len(element.dtypes)))
        for i in range(element.count):
            words = self._file.readline(_RUN).split()
            try:
                values[i] = [float(word) for word in words]
            except ValueError:
                line = b" ".join(words)[:60].decode("latin-1")
                raise self.fault(f"{name[:40]} {i} should be {len(element.dtypes)} numbers, it is {line!r}") from None
        out = {}
        for k, (column_name, dtype) in enumerate(element.dtypes.items()):
            column = values[:, k]
            if dtype.kind in "iu":
                limits = np.iinfo(dtype)
                if not ((column >= limits.min) & (column <= limits.max)).all():
                    raise self.fault(f"a value of {column_name!r} is outside its type, {limits.min} to {limits.max}")
            with np.errstate(over="ignore"):  # a number too large for float32 is infinite, which its reader refuses
                out[column_name] = column.astype(dtype)
        return out


def write_ply(
    path: str | os.PathLike[str], comments: Sequence[str], columns: Mapping[str, NDArray], faces: NDArray | None = None
) -> int:
    """Write ``columns`` (n,), bytes and float64 as they are, all others as float32, as vertices of a binary little-endian PLY,
    and triangles ``faces`` (m, 3), numbers of vertices, atomically; returns its bytes."""
    n = len(next(iter(columns.values())))
    types = {name: {"u1": "u1", "f8": "<f8"}.get(c.dtype.str[1:], "<f4") for name, c in columns.items()}
    row = np.dtype(list(types.items()))
    kinds = {name: {"u1": "uchar", "<f8": "double", "<f4": "float"}[t] for name, t in types.items()}
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines += [f"element vertex {n}", *(f"property {kind} {name}" for name, kind in kinds.items())]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    run = max(1, _RUN // row.itemsize)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(header)
        for at in range(0, n, run):
            rows = np.empty(min(run, n - at), row)
            for name, column in columns.items():
                rows[name] = column[at : at + run]
            file.write(rows.tobytes())
        for at in range(0, 0 if faces is None else len(faces), run):
            assert faces is not None
            triangles = np.empty(min(run, len(faces) - at), [("n", "u1"), ("v", "<i4", 3)])
            triangles["n"], triangles["v"] = 3, faces[at : at + run]
            file.write(triangles.tobytes())
        return file.tell()
