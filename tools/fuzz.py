"""Damages files of every kind where their structure is, and looks for anything but a result or one sentence.

    python tools/fuzz.py [--seconds 60] [--seed 0] [--only NAME] [--keep DIR]      (make fuzz)

Documents are changed value by value (another type, huge, negative, empty, nested, gone), binary files byte by byte and cut.
What readers raise besides InputError is a find, and so is what ends the interpreter, takes longer than ten seconds or, at any
moment, 2 GB: it is printed with the kind and the number that make it again (SEED KIND NUMBER), and its file is kept in --keep.
All kinds get the same time, so that the quick ones are tried more often. The exit code is 1 where there are finds. --counts
says how often each kind was tried. Files lie in memory (/dev/shm) where the system has such a place: a disk's would cost most
of the time.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fuzz_kinds import targets

from nerfvol.errors import InputError
from nerfvol.machine import peak_memory

SECONDS_EACH, BYTES, ADDRESSES = 10, 2 << 30, 6 << 30
NOTE = 200
"""Letters of the note on what is tried."""
IN_MEMORY = "/dev/shm"


class TooLong(Exception):
    """A reader takes longer than it may."""


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    def stop(number: int, frame: Any) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS_EACH)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


class Tries:
    """What was tried so far of each kind, and what was found; kept on disk, since a reader may end the process."""

    def __init__(self, names: list[str], seed: int) -> None:
        self.seed, self.names = seed, names
        self.count, self.seconds = dict.fromkeys(names, 0), dict.fromkeys(names, 0.0)
        self.refused = 0
        self.finds: dict[str, str] = {}

    def one(
        self, name: str, change: Callable[[random.Random], None], read: Callable[[], object], note: BinaryIO
    ) -> None:
        """Damages a file and reads it; ``note``: an open file that keeps what is tried."""
        key, began = f"{self.seed} {name} {self.count[name]}", time.monotonic()
        note.seek(0)
        note.write(key.ljust(NOTE).encode())
        try:
            change(random.Random(key))
            with bounded(), np.errstate(all="ignore"):
                read()
        except InputError as error:
            self.refused += 1
            if "\n" in str(error) or len(str(error)) > 1000:
                self.find(f"{name}: no short sentence: {str(error)[:300]!r}", key)
        except (Exception, TooLong) as error:  # a find
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            self.find(f"{name}: {type(error).__name__} at {place}: {str(error)[:90]!r}", key)
        if peak_bytes() > BYTES:
            self.find(f"{name}: {peak_bytes() / 1e9:.1f} GB", key)
        self.count[name] += 1
        self.seconds[name] += time.monotonic() - began

    def find(self, text: str, key: str) -> None:
        """Prints it, once a kind."""
        kind = text.split(": '")[0]
        if kind not in self.finds:
            self.finds[kind] = key
            print(f"{text}   ({key})", flush=True)


def peak_bytes() -> int:
    """The most memory that this process had, bytes; 0 where the system does not tell."""
    return peak_memory() or 0


def work(folder: Path, tries: Tries, seconds: float, only: str | None) -> None:
    """Tries until the time is over."""
    known = {name: (change, read) for name, change, read in targets(folder) if only in (None, name)}
    until = time.monotonic() + seconds
    with (folder / "trying").open("wb", buffering=0) as note:
        while time.monotonic() < until:
            name = min(known, key=lambda name: tries.seconds[name])
            tries.one(name, *known[name], note)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one kind")
    parser.add_argument("--counts", action="store_true", help="say how often each kind was tried")
    parser.add_argument("--keep", type=Path, default=Path("build/fuzz"))
    given = parser.parse_args()
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    home = IN_MEMORY if os.access(IN_MEMORY, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=home) as temporary:
        tries = Tries([name for name, *_ in targets(Path(temporary))], given.seed)
    began = time.monotonic()
    while (left := given.seconds - (time.monotonic() - began)) > 0:
        with tempfile.TemporaryDirectory(dir=home) as temporary:
            folder = Path(temporary)
            part = functools.partial(work, folder, tries, left, given.only)
            result = _in_a_process_of_its_own(part, tries)
            if isinstance(result, Tries):
                tries = result
            else:
                key = (folder / "trying").read_text().rstrip()
                name = key.split(" ", 1)[1].rsplit(" ", 1)[0]
                tries.find(f"{name}: the interpreter ended with {result}", key)
                tries.count[name] = int(key.rsplit(" ", 1)[1]) + 1
                tries.seconds[name] += SECONDS_EACH
            if tries.finds:
                given.keep.mkdir(parents=True, exist_ok=True)
                shutil.copytree(folder, given.keep, dirs_exist_ok=True)
    n = sum(tries.count.values())
    print(f"{n} files of {len(tries.names)} kinds in {time.monotonic() - began:.0f} s: {tries.refused} refused, "
          f"{len(tries.finds)} kinds of finds")  # fmt: skip
    if given.counts:
        print("\n".join(f"{count:8} {name}" for name, count in tries.count.items()))
    return 1 if tries.finds else 0


def _in_a_process_of_its_own(work: Callable[[], None], tries: Tries) -> Tries | int:
    """What ``tries`` became; the exit status where the process ended before it could say. Here where there is no fork."""
    if not hasattr(os, "fork"):
        work()
        return tries
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        work()
        with os.fdopen(writing, "w") as out:
            json.dump(
                {"count": tries.count, "seconds": tries.seconds, "refused": tries.refused, "finds": tries.finds}, out
            )
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as said:
        text = said.read()
    _, status = os.waitpid(child, 0)
    if not text:
        return os.waitstatus_to_exitcode(status)
    for name, value in json.loads(text).items():
        setattr(tries, name, value)
    return tries


if __name__ == "__main__":
    sys.exit(main())
