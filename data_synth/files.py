"""Files that are whole or not there, also where their writer is killed. Written apart from nerfvol's, as all of data_synth;
temporary names are alike, so that either removes what the other left."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import secrets
import socket
import zlib
from collections.abc import Iterator
from pathlib import Path

_TEMPORARY = re.compile(r"\..*\.(?P<process>[0-9]{1,10})\.(?P<machine>[0-9a-f]{8})[0-9a-f]{8}\.tmp(\..*)?")


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """A temporary path next to ``path`` that takes its place on success: a reader never sees half a file."""
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.{_machine()}{secrets.token_hex(4)}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        if error.filename in (None, str(temporary)):  # a full disk names no file
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: str | os.PathLike) -> None:
    """Removes the temporary files in ``folder`` of writers of this machine that were killed: of processes that are gone."""
    for path in Path(folder).glob(".*.tmp*"):
        made_by = _TEMPORARY.fullmatch(path.name)
        if made_by and made_by["machine"] == _machine() and not _is_running(int(made_by["process"])):
            with contextlib.suppress(OSError):
                path.unlink()


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
