"""How data_synth compiles and runs its scalar code.

Every kernel is plain scalar Python that reads like its equation. Numba compiles it once and keeps the machine code in
``__pycache__``. Numba's cache watches only the file a kernel stands in: after editing a function that a kernel in
*another* file calls, delete ``data_synth/__pycache__/*.nb*``.

Kernels release the interpreter lock, so plain threads share the rows of an image between the cores. This compiles
several times faster than numba's own parallel loops and does not care which threading library torch has loaded.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numba

# error_model="numpy": x/0 is inf as in IEEE 754, no exception branch behind every division.
jit = numba.njit(cache=True, nogil=True, error_model="numpy")


def core_count() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_bands(work: Callable[[int, int], None], n: int, band: int = 8) -> None:
    """Call ``work(start, stop)`` over [0, n) in bands of ``band``, on all cores; raises what it raises."""
    in_parallel(work, ((start, min(start + band, n)) for start in range(0, n, band)))


def in_parallel(work: Callable[..., None], jobs: Iterable[tuple]) -> None:
    """Call ``work(*job)`` for every job, on all cores. The first exception is raised again."""
    with ThreadPoolExecutor(core_count()) as pool:
        for future in [pool.submit(work, *job) for job in jobs]:
            future.result()
