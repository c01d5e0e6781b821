"""What a command prints on: streams that are closed, narrow or gone, and text that must not steer a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TextIO, cast

from nerfvol.errors import printable


class Screen:
    """A text stream in front of another. Control characters and what the encoding lacks are written as escapes.

    ``goes_on``: whether a reader that has gone (``| head -n 1``) is no reason to stop; what is written then is lost.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream, self.goes_on = stream, False
        with contextlib.suppress(AttributeError, ValueError):  # a stream of a library caller's own
            cast(Any, stream).reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        """As of a text stream; the number of characters taken."""
        try:
            self._stream.write(printable(text))
        except BrokenPipeError:
            if not self.goes_on:
                raise
            self.silence()
        except UnicodeEncodeError:  # a stream that could not be told what to do
            encoding = getattr(self._stream, "encoding", None) or "ascii"
            self._stream.write(printable(text).encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """As of a text stream."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """As of a text stream."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            if not self.goes_on:
                raise
            self.silence()

    def silence(self) -> None:
        """Write into nothing from here on; else the interpreter's own flush complains at exit."""
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def screens() -> Iterator[None]:
    """sys.stdout and sys.stderr as Screens; where one is closed, into nothing."""
    before, opened = (sys.stdout, sys.stderr), []
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            stream = open(os.devnull, "w", encoding="utf-8")
            opened.append(stream)
        setattr(sys, name, stream if isinstance(stream, Screen) else Screen(stream))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        for stream in opened:
            stream.close()


def go_on_without_reader() -> None:
    """From here on a reader of the output that goes away ends nothing: for work of hours."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, Screen):
            stream.goes_on = True
