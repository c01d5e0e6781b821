"""What a worker runs: one function of an importable module, so that only its name travels and its models stay open."""

from __future__ import annotations

import errno
import functools
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerfvol.cluster.ship import Shipped, find


@dataclass(frozen=True)
class Job:
    """A function for many items. function: "module:name", called as ``function(settings, files, item)`` for each item.

    settings: JSON-able, the same for all; files: by name, handed over as paths on the machine that runs it; threads:
    "module:name", told how many threads the function may use. Results must not depend on threads or on what was done before.
    """

    function: str
    settings: dict[str, Any]
    files: dict[str, Shipped] = field(default_factory=dict)
    threads: str = "nerfvol.kernels.ops:set_threads"


@dataclass(frozen=True)
class Done:
    """Results of some items, in their order, the seconds they took and where."""

    results: list[Any]
    seconds: float
    worker: str


@dataclass(frozen=True)
class Missing:
    """A worker lacks files."""

    worker: str
    files: tuple[Shipped, ...]


@functools.cache
def named(name: str) -> Callable[..., Any]:
    """The function "module:name"."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def run(job: Job, items: Sequence[Any], resource: str) -> Done | Missing:
    """The results of ``items``, or the files that are missing here.

    A disk that is full takes this worker out (its ``resource`` goes to 0) and the items go to another.
    """
    import time

    from distributed import Reschedule, get_worker

    worker = get_worker()
    # The resource lets one task in at a time, which may have all the threads of its worker.
    named(job.threads)(max(1, worker.state.nthreads))
    try:
        paths: dict[str, Path] = {}
        missing = []
        for name, file in job.files.items():
            path = find(file)
            if path is None:
                missing.append(file)
            else:
                paths[name] = path
        if missing:
            return Missing(worker.address, tuple(missing))
        started = time.perf_counter()
        function = named(job.function)
        results = [function(job.settings, paths, item) for item in items]
        return Done(results, time.perf_counter() - started, worker.address)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        reason = f"its disk is full ({error.filename or 'temporary folder'})"
        worker.log_event("nerfvol", {"resource": resource, "worker": worker.address, "reason": reason})
        worker.loop.add_callback(worker.set_resources, **{resource: 0})
        raise Reschedule from error
