"""Compiling is no silence: it is told that it begins, how far it is, and that it is over."""

import io

import numba
import numpy as np
from numba.core import registry

from data_synth import jit, linking


def test_compiling_is_told(monkeypatch):
    monkeypatch.setattr(jit, "SAY_EVERY", 0.0)
    out = io.StringIO()
    with jit.say_when_compiling(out):
        assert numba.njit(lambda x: x + 1)(1) == 2
    first, middle, last = out.getvalue().splitlines()
    assert first.startswith("compiling for this machine, once")
    assert middle.startswith("... 1 functions after ") and last.startswith("... ready after ")


def test_nothing_is_told_where_nothing_is_compiled():
    out = io.StringIO()
    with jit.say_when_compiling(out):
        pass
    assert out.getvalue() == ""


def test_kernels_alone_are_translated_and_with_all_they_call():
    """What two functions share is linked once and has no machine code of its own; the machine code is that of plain Python."""

    @jit.jit
    def shared(x, y):
        return x * y + 1.0

    @jit.jit
    def first(pair):
        return shared(pair[0], 3.0) - shared(pair[1], 0.5)

    @jit.inlined
    def second(pair, far):
        return first(pair) if far else shared(pair[1], pair[0])

    @jit.kernel
    def entry(out):
        for k in range(out.shape[0]):
            pair = (float(k), 0.25 * k)
            out[k] = shared(second(pair, k % 2 == 0), first(pair))

    out = np.empty(5)
    entry(out)

    def plainly(x, y):
        return x * y + 1.0

    for k in range(5):
        a, b = float(k), 0.25 * k
        difference = plainly(a, 3.0) - plainly(b, 0.5)
        assert out[k] == plainly(difference if k % 2 == 0 else plainly(b, a), difference)
    for inner in (shared, first, second):
        (made,) = inner.overloads.values()
        assert not made.library.codegen._engine.is_symbol_defined(made.fndesc.mangled_name)


def test_code_is_linked_behind_all_that_ask_for_it():
    """LLVM leaves out what nothing asked for so far."""
    context = registry.cpu_target.target_context.codegen()  # pyright: ignore[reportAttributeAccessIssue]
    kernel, left, right, shared = (linking._Inner(context, name) for name in ("kernel", "left", "right", "shared"))
    kernel._linking_libraries = [shared, left, right]
    left._linking_libraries, right._linking_libraries = [shared], [left, shared]
    order = linking._callers_first(kernel)
    assert order == [kernel, right, left, shared]
