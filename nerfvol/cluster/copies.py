"""Copies of this process that work on this machine: what it has imported and opened, they have from their first moment.

A copy (``fork``) has none of the other threads of its process, and what they had locked stays locked in it. So only a process
that runs no other thread makes copies, on the one system where they are known to be sound; elsewhere the engine starts
processes anew (:func:`may_copy`), which import and open everything again.

What is pickled here goes through pipes between a process and its own copies, and is never read from a file.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future as Fetch
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NoReturn

from nerfvol.cluster.tasks import Done

FROZEN_SECONDS = 30.0
"""A worker that is stopped for so long is killed, and another takes its place."""
MOST_AHEAD = 256 << 20
"""Bytes of results that are kept before anyone asks for them."""


def may_copy() -> bool:
    """Whether copies of this process are sound."""
    return sys.platform == "linux" and threading.active_count() == 1


class Keeper:
    """A copy of this process that keeps ``processes`` copies of itself at work until it is closed, or this process is gone.

    Made before any thread is started; the workers begin with :meth:`start`.
    """

    def __init__(self, processes: int) -> None:
        orders, self._orders = os.pipe()

        def keep() -> None:
            os.close(self._orders)
            _keep(orders, processes)

        self._process = _copied(keep)
        os.close(orders)

    def start(self, work: Callable[[int], None]) -> None:
        """Every worker calls ``work(number)``, an importable function and its arguments (functools.partial)."""
        with contextlib.suppress(OSError):  # then it was killed, and nobody will be fit
            os.write(self._orders, pickle.dumps(work))

    def close(self) -> None:
        """Ends workers and keeper."""
        os.close(self._orders)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self._process, 0)


class Ahead:
    """The first results of a job, made by a copy of this process in the seconds that an engine takes to start.

    make: an item -> its result.
    """

    def __init__(self, make: Callable[[Any], Any], items: Sequence[Any]) -> None:
        self._shared = mmap.mmap(-1, 16)  # whether to stop, and how many items were begun: 8 bytes each
        here, there = os.pipe()

        def work() -> None:
            os.close(here)
            parent, done, size, started = os.getppid(), [], 0, time.perf_counter()
            for number, item in enumerate(items, 1):
                if self._shared[0] or size > MOST_AHEAD or os.getppid() != parent:
                    break
                self._shared[8:16] = number.to_bytes(8, "little")
                done.append(make(item))
                size += len(pickle.dumps(done[-1]))
            with os.fdopen(there, "wb") as out:
                pickle.dump((done, time.perf_counter() - started), out)

        self._process = _copied(work)
        os.close(there)
        self._results = os.fdopen(here, "rb")
        self._reader = ThreadPoolExecutor(1)

    def stop(self) -> tuple[int, Fetch[Any]]:
        """How many of the items are its own, and what brings their results in a list; EOFError there where it died."""
        self._shared[0] = 1
        return int.from_bytes(self._shared[8:16], "little"), self._reader.submit(self._read)

    def _read(self) -> list[Done]:
        with self._results as results:
            done, seconds = pickle.load(results)
        return [Done(done, seconds, "")]

    def close(self) -> None:
        """Ends the copy."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self._process, 0)
        self._reader.shutdown(wait=True)
        self._results.close()


def _copied(work: Callable[[], None]) -> int:
    """The process number of a copy that does ``work`` and ends; Ctrl-C is for the process that made it."""
    process = os.fork()
    if process:
        return process
    _end_with(work)


def _end_with(work: Callable[[], None]) -> NoReturn:
    """No way leads back: nothing of what the first process has still to write or to clean up is done twice."""
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        work()
        code = 0
    finally:
        os._exit(code)


def _keep(orders: int, processes: int) -> None:
    """Keeps workers at work until the other end of the pipe ``orders`` is closed."""
    order = os.read(orders, select.PIPE_BUF)  # what is no longer is written, and read, at once
    if not order:
        return
    work: Callable[[int], None] = pickle.loads(order)
    workers: dict[int, int] = {}
    frozen: dict[int, float] = {}
    born = [-1e9] * processes
    try:
        while True:
            for number in sorted(set(range(processes)) - set(workers.values())):
                if (
                    time.monotonic() - born[number] > 1.0
                ):  # one that dies at once is not begun a thousand times a second
                    born[number] = time.monotonic()
                    workers[_copied(lambda number=number: work(number))] = number
            if select.select([orders], [], [], 0.1)[0]:
                return
            _take_note(workers, frozen)
    finally:
        for process in workers:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        for process in workers:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(process, 0)


def _take_note(workers: dict[int, int], frozen: dict[int, float]) -> None:
    """Forgets ``workers`` that ended; ``frozen``: since when others are stopped. Kills those that were for too long."""
    while workers:
        process, status = os.waitpid(-1, os.WNOHANG | os.WUNTRACED | os.WCONTINUED)
        if process == 0:
            break
        frozen.pop(process, None)
        if os.WIFSTOPPED(status):
            frozen[process] = time.monotonic()
        elif not os.WIFCONTINUED(status):
            workers.pop(process, None)
    for process, since in frozen.items():
        if time.monotonic() - since > FROZEN_SECONDS:
            os.kill(process, signal.SIGKILL)
