"""The SGGX distribution of microflakes [Heitz, Dupuy, Crassin & Dachsbacher 2015], PHYSICS 11.

S is a symmetric positive definite 3x3 matrix, stored as the tuple (xx, yy, zz, xy, xz, yz).
    projected area   sigma(w) = sqrt(w' S w)
    normals          D(m) = 1 / (pi sqrt|S| (m' S^-1 m)^2)
    visible normals  D_w(m) = max(w.m, 0) D(m) / sigma(w)
Phase functions of SGGX flakes, as of those of any distribution, are in ``microflakes.py`` and ``phase.py``.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from data_synth.errors import InputError
from data_synth.jit import jit
from data_synth.rng import uniform
from data_synth.vec import add, dot, frame, scale, unit


def fibre(axis: ArrayLike, roughness: float) -> np.ndarray:
    """S of fibres along ``axis``: R diag(1, 1, roughness^2) R' as six numbers."""
    return _about(axis, 1.0, roughness * roughness, roughness)


def surface(normal: ArrayLike, roughness: float) -> np.ndarray:
    """S of flakes that face ``normal``: R diag(roughness^2, roughness^2, 1) R' as six numbers."""
    return _about(normal, roughness * roughness, 1.0, roughness)


def _about(axis: ArrayLike, across: float, along: float, roughness: float) -> np.ndarray:
    if not 0.0 < roughness <= 1.0:
        raise InputError(f"SGGX: roughness must be in (0, 1], got {roughness}")
    a = np.asarray(axis, dtype=np.float64)
    a = a / np.linalg.norm(a)
    return check_sggx(across * np.eye(3) + (along - across) * np.outer(a, a))


def matrices(s: np.ndarray) -> np.ndarray:
    """(..., 6) as (..., 3, 3)."""
    return s[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(*s.shape[:-1], 3, 3)


def check_sggx(matrix: ArrayLike) -> np.ndarray:
    """The six numbers of a symmetric positive definite 3x3 matrix; anything else is an error."""
    s = np.asarray(matrix, dtype=np.float64)
    if s.shape != (3, 3) or not np.isfinite(s).all() or np.abs(s - s.T).max() > 1e-9:
        raise InputError("SGGX: S must be a finite symmetric 3x3 matrix")
    if np.linalg.eigvalsh(s)[0] <= 0:
        raise InputError(f"SGGX: S must be positive definite, got smallest eigenvalue {np.linalg.eigvalsh(s)[0]:.3g}")
    return np.array([s[0, 0], s[1, 1], s[2, 2], s[0, 1], s[0, 2], s[1, 2]])


@jit
def times(s, w):
    """S w."""
    return (
        s[0] * w[0] + s[3] * w[1] + s[4] * w[2],
        s[3] * w[0] + s[1] * w[1] + s[5] * w[2],
        s[4] * w[0] + s[5] * w[1] + s[2] * w[2],
    )


@jit
def projected_area(s, w):
    return math.sqrt(dot(w, times(s, w)))


@jit
def determinant(s):
    return s[0] * s[1] * s[2] + 2.0 * s[3] * s[4] * s[5] - s[0] * s[5] * s[5] - s[1] * s[4] * s[4] - s[2] * s[3] * s[3]


@jit
def normal_density(s, m):
    """D(m). m' S^-1 m is written with the adjugate of S."""
    adjugate = (
        s[1] * s[2] - s[5] * s[5],
        s[0] * s[2] - s[4] * s[4],
        s[0] * s[1] - s[3] * s[3],
        s[4] * s[5] - s[3] * s[2],
        s[3] * s[5] - s[4] * s[1],
        s[3] * s[4] - s[5] * s[0],
    )
    det = determinant(s)
    q = dot(m, times(adjugate, m)) / det
    return 1.0 / (math.pi * math.sqrt(det) * q * q)


@jit
def sample_visible_normal(s, w, rng):
    """A normal m distributed as D_w(m): the three-vector construction of the paper's section 4.3 in the frame of w."""
    k, j = frame(w)
    sk, sj, si = times(s, k), times(s, j), times(s, w)
    skk, sjj, sii = dot(k, sk), dot(j, sj), dot(w, si)
    skj, ski, sji = dot(k, sj), dot(k, si), dot(j, si)
    det = math.sqrt(abs(skk * (sjj * sii - sji * sji) - skj * (skj * sii - sji * ski) + ski * (skj * sji - sjj * ski)))
    inv_sii, tmp = 1.0 / math.sqrt(sii), math.sqrt(max(sjj * sii - sji * sji, 0.0))
    # a uniform point of the visible half of the unit sphere, seen from above
    r, a = math.sqrt(uniform(rng)), 2.0 * math.pi * uniform(rng)
    u, v = r * math.cos(a), r * math.sin(a)
    n = math.sqrt(max(1.0 - u * u - v * v, 0.0))
    # M_k u + M_j v + M_i n with the columns of the square root of S in the frame (k, j, w)
    mk = u * det / tmp - v * inv_sii * (ski * sji - skj * sii) / tmp + n * inv_sii * ski
    mj = v * inv_sii * tmp + n * inv_sii * sji
    mi = n * inv_sii * sii
    return unit(add(add(scale(mk, k), scale(mj, j)), scale(mi, w)))
