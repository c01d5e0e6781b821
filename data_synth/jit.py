"""How data_synth compiles and runs its scalar code.

Everything is plain scalar Python that reads like its equation. ``jit`` marks a function that other compiled code
calls; ``kernel`` marks an entry point, whose machine code numba keeps in ``__pycache__``.

Kernels release the interpreter lock, so plain threads share the rows of an image between the cores. This compiles
several times faster than numba's own parallel loops and does not care which threading library torch has loaded.
"""

from __future__ import annotations

import ast
import hashlib
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TextIO

from data_synth.errors import InputError

try:
    import numba
    from numba.core import event
except ImportError as error:
    raise InputError(f"simulated scenes are compiled by numba ({error}): pip install 'nerfvol[synth]'") from error

try:
    from data_synth.linking import Compiler, InnerCompiler
except (ImportError, AttributeError):  # another numba's insides: it compiles in its own way, which takes longer
    from numba.core.compiler import Compiler

    InnerCompiler = Compiler

# error_model="numpy": x/0 is inf as in IEEE 754, no exception branch behind every division.
# _nrt=False: no array is ever made inside compiled code, so none needs its references counted. Counting them, with
# atomic operations at every call that passes a scene along, took most of the time.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
# No wrappers: compiled code alone calls these functions, and wrapping each of them for Python took a third of the time that
# compiling takes. To call one from Python say function.py_func(...).
INNER: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
jit = numba.njit(pipeline_class=InnerCompiler, **INNER)
# For what is called at every step: a call that is not inlined hands over every number and array of a medium, one by one.
inlined = numba.njit(pipeline_class=InnerCompiler, forceinline=True, **INNER)


def plain(function: Callable) -> Callable:
    """The Python function that a compiled one is made of; itself where nothing is compiled."""
    return getattr(function, "py_func", function)


MARKS = (b"@jit", b"@inlined", b"@kernel")


@cache
def _source(path: Path) -> tuple[frozenset[Path], bytes]:
    """(the files of this package that a source file imports from, what of it machine code depends on: all of it where functions
    are compiled or the compiler is told how, of others the constants)."""
    text, root, found = path.read_bytes(), Path(__file__).parent, set()
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == root.name:
            place = root.parent.joinpath(*str(node.module).split("."))
            found |= {place.with_suffix(".py"), *(place / f"{name.name}.py" for name in node.names)}
    if path == Path(__file__) or not (path.name == "linking.py" or any(mark in text for mark in MARKS)):
        text = "\n".join(ast.unparse(n) for n in tree.body if isinstance(n, (ast.Assign, ast.AnnAssign))).encode()
    return frozenset(each for each in found if each.is_file()), text


def _stamp(source: str) -> str:
    """A digest of the compiled sources that a file depends on."""
    files, todo = set(), {Path(source)}
    while todo:
        files |= todo
        todo = {each for path in todo for each in _source(path)[0]} - files
    return hashlib.sha256(b"\0".join(_source(path)[1] for path in sorted(files))).hexdigest()


def kernel(function: Callable) -> Callable:
    """Compile an entry point and cache its machine code for as long as no compiled source that it depends on changes.

    Numba itself compares only the file the function stands in, and would go on using code into which it has inlined
    a function of another, since edited file.
    """
    compiled = numba.njit(cache=True, pipeline_class=Compiler, **OPTIONS)(function)
    index = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if index is not None and hasattr(index, "_source_stamp"):
        index._source_stamp = _stamp(function.__code__.co_filename)
    return compiled


SAY_EVERY = 10.0
"""Seconds between two words about compiling."""


class _Teller(event.Listener):
    """Tells of compiling as it goes on: that it begins, every ``SAY_EVERY`` seconds how far it is, and how long it took."""

    def __init__(self, out: TextIO) -> None:
        self.out, self.started, self.ended, self.said, self.functions = out, 0.0, 0.0, 0.0, 0

    def say(self, words: str) -> None:
        print(words, file=self.out, flush=True)

    def on_start(self, event: event.Event) -> None:
        if not self.started:
            self.started = self.said = time.perf_counter()
            self.say("compiling for this machine, once: up to a minute ...")

    def on_end(self, event: event.Event) -> None:
        self.ended = time.perf_counter()
        self.functions += 1
        if self.ended - self.said >= SAY_EVERY:
            self.said = self.ended
            self.say(f"... {self.functions} functions after {self.ended - self.started:.0f} s")

    def close(self) -> None:
        if self.ended:
            self.say(f"... ready after {self.ended - self.started:.0f} s; the next run finds it done")


@contextmanager
def say_when_compiling(stream: TextIO | None = None) -> Iterator[None]:
    """Say on ``stream`` (stderr) that code is being compiled, how far that is, and how long it took.

    Nothing is said where the machine code is found in the cache.
    """
    teller = _Teller(stream or sys.stderr)
    with event.install_listener("numba:compile", teller):
        yield
    teller.close()


_threads = 0


def use_threads(n: int) -> None:
    """Kernels use ``n`` threads from now on; 0: one a core. What they compute is the same."""
    global _threads
    _threads = n


def core_count() -> int:
    """Cores this process may use, or as many as :func:`use_threads` said."""
    if _threads:
        return _threads
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
