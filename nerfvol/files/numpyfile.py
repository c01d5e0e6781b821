"""Numpy's own files, read without running code: whatever the bytes, arrays or one InputError that names the file."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error
from nerfvol.machine import require_memory


def read_npy(path: str | os.PathLike[str], what: str) -> NDArray:
    """The one array of a .npy file; ``what`` it should be is said where it is something else."""
    found = _read(path, what, ())
    if not isinstance(found, np.ndarray):
        raise InputError(f"{path}: expected {what}, but it is an archive of several arrays")
    return found


def read_npz(path: str | os.PathLike[str], names: Sequence[str], what: str) -> dict[str, NDArray]:
    """The arrays ``names`` of a .npz archive; ``what`` it should be is said where it is something else."""
    found = _read(path, what, names)
    if not isinstance(found, dict):
        raise InputError(f"{path}: expected {what}, but it is a single array")
    return found


def _read(path: str | os.PathLike[str], what: str, names: Sequence[str]) -> NDArray | dict[str, NDArray]:
    try:
        if names and zipfile.is_zipfile(path):  # an archive may declare a thousand times its size
            with zipfile.ZipFile(path) as archive:
                wanted = {f"{name}.npy" for name in names}
                require_memory(sum(i.file_size for i in archive.infolist() if i.filename in wanted), str(path))
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            missing = [name for name in names if name not in loaded.files]
            if missing:
                raise InputError(f"{path}: expected {what}, but it holds no array {missing[0]!r}")
            found = {name: loaded[name] for name in names}
            for name, array in found.items():
                if not isinstance(array, np.ndarray):  # a member that does not begin as arrays do comes as bytes
                    raise InputError(f"{path}: expected {what}, but its {name!r} is no array")
            return found
    except InputError:
        raise
    except OSError as error:
        if error.errno is None:
            raise InputError(f"{path}: expected {what}, but it cannot be read ({_line(error)})") from error
        raise InputError(f"{path}: expected {what}, but it cannot be read ({explain_os_error(error)})") from error
    except Exception as error:  # numpy parses headers as Python literals: damage raises whatever parsers and zlib do
        raise InputError(f"{path}: expected {what}, but it cannot be read ({_line(error)})") from error


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:100] or type(error).__name__
