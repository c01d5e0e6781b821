"""What was read of a file is kept while the file stays as it is: every split of a folder asks for the same ones."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Read = TypeVar("Read")


def while_unchanged(most: int) -> Callable[[Callable[[Path], Read]], Callable[[Path], Read]]:
    """Decorates a function of a path: it is called once while the file's time and size stay; ``most`` results are kept.

    They are handed out again and again, so that nobody may change them. What it raises is not kept.
    """

    def decorate(read: Callable[[Path], Read]) -> Callable[[Path], Read]:
        @functools.lru_cache(maxsize=most)
        def kept(path: Path, changed: int, size: int) -> Read:
            return read(path)

        @functools.wraps(read)
        def ask(path: Path) -> Read:
            try:
                state = path.stat()
            except OSError:
                return read(path)  # whose sentence says what is wrong
            return kept(path, state.st_mtime_ns, state.st_size)

        ask.cache_clear = kept.cache_clear  # type: ignore[attr-defined]
        return ask

    return decorate
