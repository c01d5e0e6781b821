"""The bar that shows how far a phase is."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from typing import Any

MakeBar = Callable[[str, float], Any]
"""A phase's name and what is done of it, 0 to 1 -> a bar with tqdm's ``update`` and ``set_postfix_str``."""


def progress_bar(name: str, done: float) -> Any:
    """A bar from 0 to 1 with an estimate of the time left; nothing where the output is no terminal."""
    if sys.stderr is None or not sys.stderr.isatty():
        return _NoBar()
    from tqdm import tqdm  # what it imports takes as long as a tenth of the training of a few seconds

    shape = "{desc} {percentage:3.0f}% |{bar:20}| {elapsed}<{remaining} {postfix}"
    return tqdm(total=1.0, initial=done, desc=name, bar_format=shape, smoothing=0.05, disable=None)


class _NoBar(contextlib.AbstractContextManager["_NoBar"]):
    """What training.train.optimise asks of a bar, without one."""

    def __exit__(self, *failure: object) -> None:
        pass

    def set_postfix_str(self, text: str, refresh: bool = True) -> None:
        """Nothing."""

    def update(self, more: float) -> None:
        """Nothing."""
