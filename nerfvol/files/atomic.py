"""Files that are either whole or absent: written under a temporary name in the same folder, synced, then renamed.

``kill -9`` or a full disk at any moment leaves the previous file untouched. What the operating system refuses comes
back as one :class:`~nerfvol.errors.InputError` that names the path.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nerfvol.errors import InputError

_REASONS = {
    errno.ENOSPC: "no space is left on the device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EROFS: "the file system is read-only",
    errno.ENOENT: "its folder does not exist",
    errno.ENOTDIR: "a part of its path is a file, not a folder",
    errno.EISDIR: "it is a folder",
    errno.ENAMETOOLONG: "the name is too long",
    errno.EFBIG: "the file is larger than allowed",
}


def explain_os_error(error: OSError) -> str:
    """The cause of ``error`` in a few words, without numbers or class names."""
    lines = (error.strerror or str(error)).strip().splitlines() or [type(error).__name__]
    return _REASONS.get(error.errno or 0, lines[0])


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path next to ``path``; on success sync it and rename it to ``path``, on failure remove it.

    The temporary name keeps the suffix of ``path``, since image and video writers choose their format by it.

    Raises:
        InputError: the disk is full, the folder is missing or not writable (the message names ``path``).
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.{secrets.token_hex(4)}.tmp{target.suffix}")
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
        yield temporary
        _sync(temporary)
        os.replace(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        # A reader's error inside the block keeps its own name: only failures to write become "cannot write".
        if error.filename is not None and Path(os.fsdecode(error.filename)) not in (temporary, target):
            raise
        raise InputError(f"cannot write {target}: {explain_os_error(error)}") from error
    finally:
        with contextlib.suppress(OSError):  # gone after the rename, or never made
            temporary.unlink()


def write_bytes(path: str | os.PathLike[str], data: bytes | memoryview) -> None:
    """Write ``data`` to ``path`` atomically (see :func:`atomic_write`)."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: str | os.PathLike[str], value: Any, indent: int | None = 2) -> None:
    """Write ``value`` as JSON to ``path`` atomically; NaN and infinities raise ValueError: JSON has none."""
    write_bytes(path, (json.dumps(value, indent=indent, allow_nan=False) + "\n").encode("utf-8"))


def ensure_writable_folder(path: str | os.PathLike[str]) -> Path:
    """Make the folder ``path`` where it is missing and prove that a file can be written in it.

    Done before a long job starts, so that an hour of work is not lost at its first save.

    Raises:
        InputError: it is a file, cannot be made or not be written into.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise InputError(f"cannot write into {folder}: it is a file, not a folder") from error
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {explain_os_error(error)}") from error
    probe = folder / f".probe.{os.getpid()}.{secrets.token_hex(4)}"
    try:
        probe.write_bytes(b"\0")
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {explain_os_error(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return folder


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The content of the file ``path``; a missing or unreadable file is an :class:`InputError` that names it."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"no such file: {path}") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error


def read_json(path: str | os.PathLike[str]) -> Any:
    """The JSON document in ``path``; anything else is an :class:`InputError` that names the file and the place."""
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not JSON: it is not UTF-8 text") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
    except RecursionError as error:
        raise InputError(f"{path} is not usable JSON: it is nested too deeply") from error


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable, where the platform lets a folder be opened."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network file systems refuse fsync on a folder; the data are synced
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
