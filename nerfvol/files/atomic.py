"""Files that are either whole or absent: written under a temporary name in the same folder, synced, then renamed.

``kill -9`` or a full disk at any moment leaves the previous file untouched. What the operating system refuses comes
back as one :class:`~nerfvol.errors.InputError` that names the path.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import functools
import json
import os
import re
import secrets
import shutil
import socket
import stat
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nerfvol.errors import InputError, shown

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
    if error.errno is None and re.fullmatch(r"\d+ requested and \d+ written", lines[0]):  # numpy's tofile
        return _REASONS[errno.ENOSPC]
    return _REASONS.get(error.errno or 0, lines[0])


def is_special(path: str | os.PathLike[str]) -> bool:
    """Whether ``path`` is a pipe, a device or a process's own stream (/dev/stdout): what cannot be renamed over."""
    text = os.path.abspath(os.fspath(path))
    try:
        kind = os.stat(text).st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)) or text.startswith(("/dev/fd/", "/dev/std", "/proc/"))


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path next to ``path``; on success sync it and rename it to ``path``, on failure remove it.

    The temporary name keeps the suffix of ``path``, since image and video writers choose their format by it. Where ``path``
    is a link, the file that it names is written. Into a pipe or a device, which no rename may replace, the finished file is
    copied.

    Raises:
        InputError: the disk is full, the folder is missing or not writable (the message names ``path``).
    """
    if is_special(path):
        with _through(Path(path)) as temporary:
            yield temporary
        return
    named = Path(path)
    target = Path(os.path.realpath(named)) if named.is_symlink() else named
    writer = f"{os.getpid()}.{_machine()}{secrets.token_hex(4)}"
    temporary = target.with_name(f".{target.stem[:80]}.{writer}.tmp{target.suffix[:40]}")
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
        raise InputError(f"cannot write {named}: {explain_os_error(error)}") from error
    finally:
        with contextlib.suppress(OSError):  # gone after the rename, or never made
            temporary.unlink()


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Removes the temporary files in ``folder`` of writers of this machine that were killed: of processes that are gone."""
    for path in Path(folder).glob(".*.tmp*"):
        made_by = _TEMPORARY.fullmatch(path.name)
        if made_by and made_by["machine"] == _machine() and not _is_running(int(made_by["process"])):
            with contextlib.suppress(OSError):
                path.unlink()


_TEMPORARY = re.compile(r"\..*\.(?P<process>[0-9]{1,10})\.(?P<machine>[0-9a-f]{8})[0-9a-f]{8}\.tmp(\..*)?")


@functools.cache
def _machine() -> str:
    """This machine among those that may share a folder, eight hexadecimal digits."""
    return f"{zlib.crc32(socket.gethostname().encode()):08x}"


def _is_running(process: int) -> bool:
    """Whether there is such a process on this machine; where the system does not tell, yes."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's; a number that no process has
        return True
    return True


@contextlib.contextmanager
def _through(target: Path) -> Iterator[Path]:
    """A temporary file whose content goes into the pipe or device ``target`` once it is whole."""
    if stat.S_ISBLK(target.stat().st_mode) or stat.S_ISSOCK(target.stat().st_mode):
        raise InputError(f"cannot write {target}: it is neither a file nor a pipe")
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / f"whole{target.suffix}"
        yield temporary
        try:
            with temporary.open("rb") as whole, target.open("wb") as out:
                shutil.copyfileobj(whole, out)
        except OSError as error:
            raise InputError(f"cannot write {target}: {explain_os_error(error)}") from error


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


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of the file ``path``: UTF-8, or UTF-16 where its byte order mark says so; the mark itself is left out.

    Raises:
        InputError: it cannot be read.
        UnicodeDecodeError: it is no text.
    """
    data = read_bytes(path)
    wide = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return data.decode("utf-16" if wide else "utf-8-sig")


def read_json(path: str | os.PathLike[str]) -> Any:
    """The JSON document in ``path``; anything else is an :class:`InputError` that names the file and the place.

    A key that an object states twice is refused: which of the two was meant is not known.
    """
    try:
        return json.loads(read_text(path), object_pairs_hook=_once)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not JSON: it is not UTF-8 text") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
    except RecursionError as error:
        raise InputError(f"{path} is not usable JSON: it is nested too deeply") from error
    except _Twice as error:
        raise InputError(f"{path} is not usable JSON: an object states {shown(error.key)} twice") from error
    except ValueError as error:  # a number of more digits than Python converts
        raise InputError(f"{path} is not usable JSON: it holds a number of thousands of digits") from error


class _Twice(ValueError):
    def __init__(self, key: str) -> None:
        super().__init__(key)
        self.key = key


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of these pairs; _Twice where two have one key."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise _Twice(key)
        found[key] = value
    return found


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
