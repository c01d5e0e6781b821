"""One writer a folder: a lock that ends with the process that holds it, however that ends."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error

LOCK = ".lock"


@contextlib.contextmanager
def only_writer(folder: Path, what: str) -> Iterator[None]:
    """Nobody else who asks so writes into ``folder`` in this block. Where the system has no such locks, nothing is locked.

    Raises:
        InputError: another process holds it; ``what`` it does is said.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    path = folder / LOCK
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise InputError(f"cannot write into {folder}: {explain_os_error(error)}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise InputError(f"{folder}: another process {what} there; let it end, or choose another folder") from None
        except OSError:  # a file system without locks
            os.close(descriptor)
            yield
            return
        if _is_same(descriptor, path):  # else the holder before has just removed it
            break
        os.close(descriptor)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.fstat(descriptor).st_ino == os.stat(path).st_ino
    except OSError:
        return False
