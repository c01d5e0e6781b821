"""Densities that are functions, evaluated where a ray asks for them and not sampled to a grid (procedural volumes).

    def puffs(x, y, z):
        return math.exp(-4.0 * (x * x + y * y + z * z)) * (1.0 + math.sin(9.0 * x))

    media.procedural(puffs, lo, hi, majorant=2.0)

The function is compiled by numba, once, to machine code that kernels call through its address, so that they need not be
compiled again for each function. What tracking relies on is its stated majorant. Each value is compared with it: what is
above counts as the majorant, what is negative or no number as 0, in every integrator alike, and how often that was so is said.
"""

from __future__ import annotations

import inspect
import textwrap
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from data_synth.errors import InputError, RenderWarning
from data_synth.jit import jit, plain

SIGNATURE = "float64(float64, float64, float64)"
ABOVE, LARGEST, WRONG = range(3)  # what ``Medium.faults`` counts


class Compiled(NamedTuple):
    """A function and what keeps its machine code alive. source: its text where it can be found, else ''."""

    name: str
    source: str
    call: Callable
    code: Any


COMPILED: dict[int, Compiled] = {}
"""By address."""


def address_of(function: Callable) -> int:
    """Where the machine code of ``function(x, y, z)`` is. InputError for what numba cannot compile to it."""
    own = plain(function)
    name = getattr(own, "__qualname__", repr(own))
    for address, known in COMPILED.items():
        if known.call is own:
            return address
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        address, code = len(COMPILED) + 1, None
    else:
        try:
            code = numba.cfunc(SIGNATURE, error_model="numpy")(own)
        except Exception as error:  # numba raises whatever its passes do
            why = (str(error).splitlines() or [""])[0][:200]
            raise InputError(
                f"density {name}: expected a function (x, y, z) -> number that numba compiles: {why}"
            ) from error
        address = int(cast(int, code.address))
    try:
        source = textwrap.dedent(inspect.getsource(own))
    except (OSError, TypeError):
        source = ""
    COMPILED[address] = Compiled(name, source, own, code)
    return address


def call(address: int, x: float, y: float, z: float) -> float:
    """The function at an address, of a point."""
    return COMPILED[address].call(x, y, z)


@intrinsic
def _machine_code(typing: Any, address: Any, x: Any, y: Any, z: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = ir.DoubleType()
        kind = ir.FunctionType(number, (number, number, number))
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])

    return types.float64(types.int64, types.float64, types.float64, types.float64), generate


@overload(call)
def _compiled_call(address, x, y, z):
    return lambda address, x, y, z: _machine_code(address, x, y, z)  # pyright: ignore[reportCallIssue]


@jit
def bounded(m, p):
    """The density at a point, in [0, majorant of its brick]; what was outside is counted."""
    rho = call(m.function, p[0], p[1], p[2])
    n = m.bricks
    i = min(max(int((p[0] - m.lo[0]) / (m.hi[0] - m.lo[0]) * n[0]), 0), n[0] - 1)
    j = min(max(int((p[1] - m.lo[1]) / (m.hi[1] - m.lo[1]) * n[1]), 0), n[1] - 1)
    k = min(max(int((p[2] - m.lo[2]) / (m.hi[2] - m.lo[2]) * n[2]), 0), n[2] - 1)
    most = m.brick_max[(i * n[1] + j) * n[2] + k]
    if rho > most:
        m.faults[ABOVE] += 1.0
        m.faults[LARGEST] = max(m.faults[LARGEST], rho / most)
        return most
    if not rho >= 0.0:
        m.faults[WRONG] += 1.0
        return 0.0
    return rho


def say_faults(faults: np.ndarray) -> None:
    """Warn of what ``bounded`` counted in (n, 3) and count anew. Threads may lose counts: it is a lower bound."""
    for row in faults.reshape(-1, 3):
        if row[ABOVE]:
            warnings.warn(
                f"a density function was above its majorant in {row[ABOVE]:.0f} look-ups or more, up to {row[LARGEST]:.3g} "
                "times; it counts as the majorant there: state a larger one", RenderWarning, stacklevel=4,
            )  # fmt: skip
        if row[WRONG]:
            warnings.warn(
                f"a density function was negative or no number in {row[WRONG]:.0f} look-ups or more; it counts as 0 there",
                RenderWarning, stacklevel=4,
            )  # fmt: skip
        row[:] = 0.0
