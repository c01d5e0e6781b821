"""Phase functions, all normalised to integrate to 1 over the sphere (PHYSICS 6).

wo and wi point outward from the scattering point: light arrives along -wi and leaves along wo, or the other way round.
The angle theta is between the *propagation* directions before and after, so cos(theta) = -wo.wi and g > 0 is forward.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth import microflakes as flakes
from data_synth import sggx
from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.rng import uniform
from data_synth.vec import dot, neg, sphere_direction

ISOTROPIC, RAYLEIGH, HG, SGGX_SPECULAR, SGGX_DIFFUSE, FLAKES = range(6)  # from SGGX_SPECULAR on, microflakes
NO_OWN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Phase(NamedTuple):
    """A phase function. Make it with the functions below.

    g1, g2: mean cosines of the two Henyey-Greenstein lobes; mix: weight of the first. S: (K, 6) SGGX matrices, one per
    value of the medium's attribute. Of other microflakes (FLAKES): micro, roughness, ior: what a flake does with light
    (``microflakes.py``); table: their distributions, none for SGGX. own: the SGGX matrix of the place instead of S, of media
    that have a grid (``lookups.phase_at``).
    """

    kind: int
    g1: float
    g2: float
    mix: float
    S: np.ndarray
    micro: int
    roughness: float
    ior: float
    table: flakes.Table
    own: tuple[float, float, float, float, float, float] = NO_OWN


_NO_FLAKES = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]])


def _of_angle(kind: int, g1: float = 0.0, g2: float = 0.0, mix: float = 1.0) -> Phase:
    return Phase(kind, g1, g2, mix, _NO_FLAKES, flakes.SPECULAR, 0.0, 1.0, flakes.EMPTY)


def isotropic() -> Phase:
    """1 / 4 pi."""
    return _of_angle(ISOTROPIC)


def rayleigh() -> Phase:
    """3/(16 pi) (1 + cos^2 theta): particles much smaller than the wavelength."""
    return _of_angle(RAYLEIGH)


def henyey_greenstein(g: float) -> Phase:
    """[HG] (1 - g^2) / (4 pi (1 + g^2 - 2 g cos theta)^(3/2)), mean cosine g in (-1, 1)."""
    return two_lobes(g, g, 1.0)


def two_lobes(g1: float, g2: float, mix: float) -> Phase:
    """mix HG(g1) + (1 - mix) HG(g2): clouds are near g1 = 0.8, g2 = -0.3, mix = 0.7."""
    for name, g in (("g1", g1), ("g2", g2)):
        if not (math.isfinite(g) and abs(g) < 1):
            raise InputError(f"phase: {name} must be in (-1, 1), got {g}")
    if not 0 <= mix <= 1:
        raise InputError(f"phase: mix must be in [0, 1], got {mix}")
    return _of_angle(HG, float(g1), float(g2), float(mix))


def microflakes(
    *S: ArrayLike | flakes.Table, diffuse: bool = False, micro: str | None = None, roughness: float = 0.3, ior: float = 1.5
) -> Phase:  # fmt: skip
    """Microflakes of one distribution per value of the attribute, specular by default.

    S: of SGGX, 3x3 matrices or rows of six numbers (``sggx.fibre``); or tables (``microflakes.beckmann``, ``tabulated``).
    micro: specular, diffuse, glossy (roughness) or refractive (roughness, ior); diffuse=True is short for that.
    """
    micro = micro or ("diffuse" if diffuse else "specular")
    if micro not in flakes.MICRO:
        raise InputError(f"microflakes: micro must be one of {', '.join(flakes.MICRO)}, got {micro}")
    if not 0 < roughness <= 1:
        raise InputError(f"microflakes: roughness must be in (0, 1], got {roughness}")
    if not 1 <= ior <= 10:
        raise InputError(f"microflakes: ior must be from 1 to 10, got {ior}")
    tables = [s for s in S if isinstance(s, flakes.Table)]
    if tables and len(tables) < len(S):
        raise InputError("microflakes: expected either SGGX matrices or tables, got both")
    rows = []
    for s in (np.asarray(s, dtype=np.float64) for s in S if not isinstance(s, flakes.Table)):
        rows.append(sggx.check_sggx(s if s.shape == (3, 3) else sggx.matrices(s)))
    kind = FLAKES
    if not tables and micro in ("specular", "diffuse"):
        kind = SGGX_DIFFUSE if micro == "diffuse" else SGGX_SPECULAR
    S_rows = np.stack(rows) if rows else _NO_FLAKES
    table = flakes.together(tables)
    return Phase(kind, 0.0, 0.0, 1.0, S_rows, flakes.MICRO[micro], float(roughness), float(ior), table)


def largest_area(phase: Phase) -> float:
    """The largest projected area of the flakes, 1 without: a factor of majorants."""
    if phase.table.kinds:
        return float(phase.table.sigma.max())
    return math.sqrt(np.linalg.eigvalsh(sggx.matrices(phase.S))[:, -1].max())


@jit
def with_g(phase, g):
    """The phase function with another g1."""
    f = phase
    return Phase(f.kind, g, f.g2, f.mix, f.S, f.micro, f.roughness, f.ior, f.table, f.own)


@jit
def with_S(phase, S):
    """The phase function with an SGGX matrix of the place, six numbers."""
    f = phase
    return Phase(f.kind, f.g1, f.g2, f.mix, f.S, f.micro, f.roughness, f.ior, f.table, S)


@jit
def flakes_at(phase, attribute):
    """The six numbers of S: of the place, else of the nearest row for an attribute in [0, 1]."""
    if phase.own[0] > 0.0:
        return phase.own
    n = phase.S.shape[0]
    k = min(max(int(attribute * (n - 1) + 0.5), 0), n - 1)
    S = phase.S
    return (S[k, 0], S[k, 1], S[k, 2], S[k, 3], S[k, 4], S[k, 5])


@jit
def normals_at(phase, attribute):
    """The distribution of flakes for an attribute in [0, 1]: the nearest one."""
    rows = phase.table.kinds
    row = min(max(int(attribute * (rows - 1) + 0.5), 0), rows - 1) if rows > 0 else -1
    return flakes.Normals(flakes_at(phase, attribute), phase.table, row)


@jit
def projected_area(phase, attribute, w):
    """sigma(w) of the flakes."""
    return flakes.projected_area(normals_at(phase, attribute), w)


@jit
def has_density(phase):
    """Whether ``evaluate`` is the density itself, not a random number with it as its mean."""
    return phase.kind < SGGX_SPECULAR or phase.micro == flakes.SPECULAR


@jit
def hg(g, cosine):
    q = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) / (4.0 * math.pi * q * math.sqrt(q))


@jit
def hg_cosine(g, u):
    """cos(theta) distributed as HG for u uniform.

    The inverse CDF (1 + g^2 - s^2) / 2g with s = (1 - g^2) / (1 - g + 2 g u), multiplied out in v = 2u - 1 so that
    nothing is divided by g: exact down to g = 0, where it is v.
    """
    v = 2.0 * u - 1.0
    q = 1.0 + g * v
    return (2.0 * v * (1.0 + g * g) + g * (3.0 - g * g) + g * (1.0 + g * g) * v * v) / (2.0 * q * q)


@jit
def of_cosine(phase, cosine):
    """f_p of the phase functions that know the angle alone, for its cosine."""
    if phase.kind == HG:
        f = phase.mix * hg(phase.g1, cosine)
        return f + (1.0 - phase.mix) * hg(phase.g2, cosine) if phase.mix < 1.0 else f
    if phase.kind == RAYLEIGH:
        return 3.0 / (16.0 * math.pi) * (1.0 + cosine * cosine)
    return 0.25 / math.pi


@jit
def evaluate(phase, attribute, wo, wi, rng):
    """f_p(wo, wi) in 1/sr. Flakes that are not specular alone need random numbers; their value is right on average."""
    if phase.kind >= SGGX_SPECULAR:
        n = normals_at(phase, attribute)
        if phase.micro == flakes.SPECULAR:
            return flakes.specular_density(n, wo, wi)
        m = flakes.sample_visible_normal(n, wo, rng)
        return flakes.micro_density(phase.micro, phase.roughness, phase.ior, m, wo, wi)
    return of_cosine(phase, -dot(wo, wi))


@jit
def sample(phase, attribute, wo, rng):
    """wi with density f_p(wo, .): every phase function here is sampled exactly."""
    if phase.kind >= SGGX_SPECULAR:
        n = normals_at(phase, attribute)
        if phase.micro == flakes.SPECULAR:
            return flakes.sample_specular(n, wo, rng)
        m = flakes.sample_visible_normal(n, wo, rng)
        return flakes.micro_sample(phase.micro, phase.roughness, phase.ior, m, wo, rng)
    u = uniform(rng)
    if phase.kind == HG:
        cosine = hg_cosine(phase.g1 if uniform(rng) < phase.mix else phase.g2, u)
    elif phase.kind == RAYLEIGH:  # Cardano's root of (cosine^3 + 3 cosine + 4) / 8 = u
        a = 4.0 * u - 2.0
        b = math.sqrt(a * a + 1.0)
        root = (a + b) ** (1.0 / 3.0)
        cosine = root - 1.0 / root
    else:
        cosine = 2.0 * u - 1.0
    return sphere_direction(neg(wo), cosine, 2.0 * math.pi * uniform(rng))
