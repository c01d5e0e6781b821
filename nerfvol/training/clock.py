"""The clock of a training run, and its deafness to the first signal."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from nerfvol.machine import process_seconds


class Clock:
    """Seconds of wall clock that a run has used, over all its sessions."""

    def __init__(self, started: float | None, spent: float) -> None:
        now = time.perf_counter()
        self._zero = (now - process_seconds() if started is None else started) - spent

    def elapsed(self) -> float:
        """Seconds so far, those of earlier sessions included."""
        return time.perf_counter() - self._zero

    def exclude(self, seconds: float) -> None:
        """So many of the last seconds do not count: the run stood still."""
        self._zero += seconds


@contextlib.contextmanager
def first_signal_noted(note: Callable[[], bool]) -> Iterator[None]:
    """The first Ctrl-C, SIGTERM (``kill``, a batch system's end) or SIGHUP (a closed terminal) only calls ``note``, so that
    the step in progress is finished; a second one, for which ``note`` returns False, ends at once. What is ignored, as nohup
    does, stays so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def received(number: int, frame: Any) -> None:
        if not note():
            raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    caught = [n for n in numbers if n == signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN]
    before = [(number, signal.signal(number, received)) for number in caught]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)
