"""Files that tasks need, known by their SHA-256: looked for at their path first, sent once to a machine that lacks them.

A task names hash, size and path. A worker looks in its cache, then at the path (a shared file system; the hash decides), else
says that it lacks the file; the client sends the parts, and the task is given out again. The scheduler keeps nothing.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error

if TYPE_CHECKING:
    from distributed import Client

PART = 8 << 20
CACHE_VARIABLE = "NERFVOL_CACHE"


@dataclass(frozen=True)
class Shipped:
    """A file by its content; suffix: the end of its name, by which readers tell formats."""

    sha256: str
    size: int
    path: str
    suffix: str


def describe(path: str | Path) -> Shipped:
    """The file at ``path`` as a task names it; InputError where it cannot be read."""
    try:
        here = Path(path).resolve()
        now = here.stat()
        # A copy of this process knows the hash as well.
        known = _hash_of_state(here, now.st_size, now.st_mtime_ns, now.st_ino)
        return Shipped(known, now.st_size, str(here), Path(path).suffix)
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error


def cache_folder() -> Path:
    """Where sent files lie on this machine: $NERFVOL_CACHE, else a folder of this user among the temporary ones."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    folder = Path(os.environ.get(CACHE_VARIABLE) or Path(tempfile.gettempdir()) / f"nerfvol-{user}")
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    return folder


def find(file: Shipped) -> Path | None:
    """Where the content of ``file`` is on this machine, if it is."""
    cached = cache_folder() / f"{file.sha256}{file.suffix}"
    if cached.is_file() and cached.stat().st_size == file.size:
        return cached
    here = Path(file.path)
    with contextlib.suppress(OSError):
        now = here.stat()
        if now.st_size == file.size and _hash_of_state(here, now.st_size, now.st_mtime_ns, now.st_ino) == file.sha256:
            return here
    return None


@functools.lru_cache(maxsize=16)
def _hash_of_state(path: Path, size: int, modified_ns: int, inode: int) -> str:
    """The hash of a file, read again when it was written again: every task asks."""
    return _hash(path)


def send(client: Client, file: Shipped, worker: str) -> None:
    """Brings ``file``, which lies here, to ``worker`` in parts of 8 MiB.

    Raises:
        OSError: its disk took it not.
    """
    with Path(file.path).open("rb") as source:
        offset = 0
        while offset < file.size:
            part = source.read(PART)
            client.run(receive, file, offset, part, workers=[worker])
            offset += len(part)


def receive(file: Shipped, offset: int, part: bytes) -> None:
    """Runs on the worker: writes a part of ``file``; after the last the content is checked and gets its name.

    Raises:
        OSError: the disk is full, or the content is another than the hash says.
    """
    folder = cache_folder()
    partial = folder / f"{file.sha256}.{os.getpid()}.part"
    try:
        with partial.open("r+b" if offset else "wb") as target:
            target.seek(offset)
            target.write(part)
        if offset + len(part) < file.size:
            return
        if _hash(partial) != file.sha256:
            raise OSError(f"{file.path} changed while it was sent")
        os.replace(partial, folder / f"{file.sha256}{file.suffix}")
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while part := file.read(PART):
            digest.update(part)
    return digest.hexdigest()
