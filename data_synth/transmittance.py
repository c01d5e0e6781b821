"""Estimates of transmittance and free flights for people: those of ``trackers.py`` one by one."""

from __future__ import annotations

import math

import numpy as np

from data_synth.channels import Channels
from data_synth.errors import InputError
from data_synth.functions import say_faults
from data_synth.jit import kernel
from data_synth.media import EXPONENTIAL, FUNCTION, HOMOGENEOUS, Medium, Point, triple
from data_synth.rng import new_rng
from data_synth.trackers import CLOSED, DELTA, MARCH, RATIO, REGULAR, RESIDUAL, free_flight, transmittance

METHODS = {"closed": CLOSED, "regular": REGULAR, "march": MARCH, "delta": DELTA, "ratio": RATIO, "residual": RESIDUAL}
DISTANCE_METHODS = {"closed": CLOSED, "regular": REGULAR, "march": MARCH, "woodcock": DELTA}


@kernel
def _transmittances(m, ray, t1, method, local, rng, out):
    for k in range(out.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = transmittance(m, ray, 0.0, t1, method, local, rng)


@kernel
def _flights(m, ray, t1, method, local, rng, out):
    for k in range(out.shape[0]):
        out[k] = free_flight(m, ray, 0.0, t1, method, local, rng)


def sample_transmittance(
    m: Medium | Channels,
    o: Point,
    d: Point,
    t1: float = np.inf,
    method: str = "ratio",
    local: bool = True,
    n: int = 1,
    seed: int = 0,
) -> np.ndarray:
    """(n, 3) independent estimates of the RGB transmittance from o over a distance t1 along unit d; of a medium in channels
    each has random numbers of its own.

    method: a row of the table in ``trackers.py``. local: one majorant per brick instead of one for all.
    """
    if isinstance(m, Channels):
        return np.stack(
            [sample_transmittance(one, o, d, t1, method, local, n, 3 * seed + c)[:, c] for c, one in enumerate(m)], 1
        )
    out = np.empty((n, 3))
    _transmittances(m, _ray(o, d), float(t1), _method(m, method, METHODS), bool(local), new_rng(seed, 0), out)
    say_faults(m.faults)
    return out


def sample_flights(
    m: Medium,
    o: Point,
    d: Point,
    t1: float = np.inf,
    method: str = "woodcock",
    local: bool = True,
    n: int = 1,
    seed: int = 0,
) -> np.ndarray:
    """(n,) independent free-flight distances from o along unit d, inf for those that leave or reach t1."""
    out = np.empty(n)
    _flights(m, _ray(o, d), float(t1), _method(m, method, DISTANCE_METHODS), bool(local), new_rng(seed, 0), out)
    say_faults(m.faults)
    return out


def _ray(o: Point, d: Point) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    if abs(math.hypot(*d) - 1.0) > 1e-9:
        raise InputError(f"ray: direction must have unit length, got length {math.hypot(*d):.6g}")
    return triple(o), triple(d)


def _method(m: Medium, name: str, methods: dict) -> int:
    if name not in methods:
        raise InputError(f"method: expected one of {', '.join(methods)}, got '{name}'")
    if name == "closed" and (m.kind not in (HOMOGENEOUS, EXPONENTIAL) or methods is DISTANCE_METHODS and m.kind):
        raise InputError("method: this medium has no closed form, expected another method than 'closed'")
    if name == "regular" and (m.kind == FUNCTION or m.detail.octaves):
        kind = "density function" if m.kind == FUNCTION else "density with detail"
        raise InputError(
            f"method: regular tracking is exact cell by cell and a {kind} is no polynomial there, expected another"
        )
    return methods[name]
