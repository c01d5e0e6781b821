"""A job shared out: the one way in which commands have an engine work for them."""

from __future__ import annotations

import contextlib
import functools
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfvol.cluster.copies import Ahead, may_copy
from nerfvol.cluster.needs import Needs, fingerprint
from nerfvol.cluster.tasks import Job, named

if TYPE_CHECKING:
    from distributed import Client


def shared_out(
    where: str | Client, job: Job, needs: Needs, items: Sequence[Any], say: Callable[[str], object], repeat: bool = True
) -> Iterator[Any]:
    """The job's result for each of ``items``, in their order, from the workers of an engine that serves as long as that takes.

    where: what engine.connect takes, or a client of one. say: gets sentences on workers that take no part. repeat: any of them
    may be computed twice; not where two may not write one folder. With nothing to do no engine is asked for.

    On this machine alone (``local:N``) the first result is made here, and the next ones by a copy of this process until the
    engine has started: workers are copies as well, and have from the beginning what the first result took to open.

    Raises:
        InputError: the engine cannot be reached or is gone, no worker is fit, or a task fails wherever it is tried.
    """
    if not items:
        return
    head: list[Any] = []
    with contextlib.ExitStack() as stack:
        ahead = None
        if repeat and isinstance(where, str) and re.fullmatch(r"local:[1-9]\d*", where) and may_copy():
            make = functools.partial(_made, job)
            with contextlib.suppress(Exception):  # a worker's sentence says more
                head.append(make(items[0]))
            named(job.threads)(1)  # the threads of kernels end: a copy is better made without
            if len(items) > 1 and head and may_copy():
                ahead = Ahead(make, items[1:])
                stack.callback(ahead.close)
            fingerprint(needs)
        if len(items) > len(head):
            from nerfvol.cluster.window import Window

            if isinstance(where, str):
                from nerfvol.cluster.engine import connect

                where = stack.enter_context(connect(where))
            window = Window(where, job, needs, repeat)
            for message in window.messages:
                say(message)
            yield from head  # not before: what a caller starts with them, copies would have too
            yield from window.results(items[len(head) :], ahead)
        else:
            yield from head


def _made(job: Job, item: Any) -> Any:
    """The result of an item here, where the job's files are."""
    return named(job.function)(job.settings, {name: Path(file.path) for name, file in job.files.items()}, item)


_LENT: dict[tuple[str, tuple[int, ...] | None], Any] = {}


def lend(name: str, opened: Any, path: str | Path | None = None) -> None:
    """Hands on what this process has opened to the functions of jobs that run in it or in its copies (:func:`lent`).

    path: the file it was read from; once that is another, nothing is lent.
    """
    _LENT[name, _state(path)] = opened


def lent(name: str, path: str | Path | None = None) -> Any:
    """What was lent under that name, None where nothing was."""
    return _LENT.get((name, _state(path)))


def _state(path: str | Path | None) -> tuple[int, ...] | None:
    if path is None:
        return None
    now = os.stat(path)
    return now.st_dev, now.st_ino, now.st_size, now.st_mtime_ns
