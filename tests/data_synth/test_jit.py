"""Compiling is no silence: it is told that it begins, how far it is, and that it is over."""

import io

import numba

from data_synth import jit


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
