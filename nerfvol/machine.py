"""What machine this is, for records that state figures."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerfvol.errors import InputError
from nerfvol.native import native


def cpu_model() -> str:
    """The processor's name as the system tells it, else its architecture."""
    try:
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            if line.startswith(("model name", "Model")):
                return line.split(":", 1)[1].strip()
    except OSError:  # no such file outside Linux
        pass
    return platform.processor() or platform.machine()


def total_memory() -> int | None:
    """Bytes of main memory, or the control group's limit where that is lower; None where nobody tells."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            text = Path(path).read_text().strip()
        except OSError:  # not in such a group
            continue
        if text.isdigit():
            total = min(total, int(text))
    return total


def available_memory() -> int | None:
    """Bytes that a new allocation can take without swapping, and within the process's own limit (``ulimit -v``); None where
    nobody tells."""
    found = [amount for amount in (_free_memory(), _address_space_left()) if amount is not None]
    return min(found, default=None)


def _address_space_left() -> int | None:
    """Of a limit on this process's address space; None: there is none."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, AttributeError, OSError, ValueError, IndexError):  # outside Linux
        return None
    return max(0, limit - used)


def _free_memory() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                free = int(line.split()[1]) * 1024
                total = total_memory()
                return free if total is None else min(free, total)
    except (OSError, ValueError, IndexError):  # outside Linux
        pass
    return total_memory()


def require_memory(need: int, what: str) -> None:
    """An InputError where ``need`` bytes for ``what`` are more than there are now."""
    have = available_memory()
    if have is not None and need > have:
        raise InputError(
            f"{what} would take {need / 2**30:.1f} GiB of memory, and {have / 2**30:.1f} GiB are free: it is damaged, or made "
            "for a larger machine"
        )


def peak_memory() -> int | None:
    """Largest resident size of this process so far, in bytes."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def return_free_memory() -> None:
    """Give the system back what was freed, where the C library (glibc) holds on to it otherwise.

    Once arrays of a few megabytes have come and gone, glibc keeps such memory for the next ones; the images that a run
    releases would stay in its resident size to the end.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


LARGE_ARRAY = 8 << 20
"""Bytes; more than any array of a training step has."""


def keep_large_arrays_apart() -> None:
    """Larger arrays than LARGE_ARRAY get memory of their own, which goes back to the system with them (glibc).

    As they come and go glibc moves that bound up to 32 MiB, so that arrays of some megabytes leave holes between each other:
    a tenth of what a run takes. What every step takes again is better off as it is, for the system clears new memory.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(-3, LARGE_ARRAY)  # M_MMAP_THRESHOLD


_imported = time.perf_counter()


def process_seconds() -> float:
    """Seconds since this process started; where the system does not tell, since this module was imported."""
    try:
        # Field 22 of stat(5): start in clock ticks after boot. The name before it may hold spaces, but ends with ")".
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):  # outside Linux
        return time.perf_counter() - _imported


def describe_hardware() -> dict[str, Any]:
    """cpu, the clock it runs at now in GHz (None without compiled kernels), usable cores, memory in GiB, platform and the
    kernels' build in use, JSON-able."""
    total, compiled = total_memory(), native()
    return {
        "cpu": cpu_model(),
        "clock_ghz": None if compiled is None else round(compiled.clock_ghz(), 2),
        "cores": usable_cores(),
        "memory_gib": None if total is None else round(total / 2**30, 1),
        "platform": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "kernel_path": "reference" if compiled is None else compiled.isa(),
    }


def processor(hardware: Mapping[str, Any]) -> str:
    """The processor of a ``describe_hardware`` for a heading: its name and clock (records before 2026-11-30 have none)."""
    clock = hardware.get("clock_ghz")
    return hardware["cpu"] + (f" at {clock:.1f} GHz" if clock else "")


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
