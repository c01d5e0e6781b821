"""Compiling is no silence: it is told that it begins, how far it is, and that it is over."""

import io
import subprocess
import sys

import numba
import numpy as np
from numba.core import registry
from numba.core.codegen import JITCodeLibrary

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


@jit.jit
def squared(x):
    return x * x


@jit.jit
def plus_square(x):
    return squared(x) + squared(x + 1.0) * 0.5


def test_code_that_numba_compiles_in_its_own_way_has_all_that_it_calls():
    """A density function, or anybody's kernel, that calls functions of this package, which call others."""

    @numba.njit
    def own(x):
        return plus_square(x) - plus_square(2.0 * x)

    @numba.cfunc("float64(float64, float64, float64)", error_model="numpy")
    def density(x, y, z):
        return plus_square(x) + y * z

    def plainly(x):
        return x * x + (x + 1.0) ** 2 * 0.5

    assert own(3.0) == plainly(3.0) - plainly(6.0)
    assert density.ctypes(2.0, 3.0, 4.0) == plainly(2.0) + 12.0


def test_another_numba_compiles_in_its_own_way(monkeypatch):
    """Where it lacks what is used of its insides; at import, and in what it made."""
    monkeypatch.setattr(linking, "OF_LIBRARY", (*linking.OF_LIBRARY, "_moved_away"))
    linking._fits.cache_clear()

    @jit.jit
    def inner(x):
        return 3.0 * x

    @jit.kernel
    def entry(out):
        out[0] = inner(out[0])

    out = np.array([2.0])
    entry(out)
    linking._fits.cache_clear()
    assert out[0] == 6.0 and type(next(iter(inner.overloads.values())).library) is JITCodeLibrary
    said = (
        "import sys; sys.modules['data_synth.linking'] = None\n"
        "from data_synth import jit\n"
        "print(jit.Compiler.__module__, jit.jit(lambda x: x).targetoptions['nogil'])"
    )
    done = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, timeout=600)
    assert done.stdout.split() == ["numba.core.compiler", "True"], done.stderr[-500:]


def test_machine_code_is_kept_until_a_source_that_counts_is_changed(tmp_path, monkeypatch):
    """Inner functions two files away, constants where nothing is compiled, how it is compiled; not what is said of them."""
    home = tmp_path / "data_synth"
    home.mkdir()
    texts = {
        "jit": "from data_synth.linking import Compiler\nOPTIONS = {'nogil': True}\n# @jit, @kernel\n",
        "linking": "passes = 3\ndef link():\n    return 1\n",
        "entry": "from data_synth.jit import kernel\nfrom data_synth.inner import f\n@kernel\ndef k(): f()\n",
        "inner": "from data_synth.jit import jit\nfrom data_synth import sizes\n@jit\ndef f(): return sizes.SIDE\n",
        "sizes": "SIDE: int = 9\ndef unpacked():\n    return 1\n",
    }
    monkeypatch.setattr(jit, "__file__", str(home / "jit.py"))

    def stamp(**changed):
        for name, text in (texts | changed).items():
            (home / f"{name}.py").write_text(text)
        jit._source.cache_clear()
        return jit._stamp(str(home / "entry.py"))

    kept = stamp()
    for name, old, new in (
        ("inner", "return", "return 2 *"), ("sizes", "9", "8"), ("linking", "return 1", "return 2"),
        ("jit", "True", "False"), ("entry", "f()", "f(), f()"),
    ):  # fmt: skip
        assert stamp(**{name: texts[name].replace(old, new)}) != kept, name
    for name, old, new in (("sizes", "return 1", "return 2"), ("jit", "# @jit", "# the @jit")):
        assert stamp(**{name: texts[name].replace(old, new)}) == kept, name
    jit._source.cache_clear()
