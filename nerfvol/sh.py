"""Real spherical harmonics of degree 0 to 4 as polynomials of a unit direction.

Convention (docs/mathematics.md, section 3): coefficient k = l*l + l + m with m = -l..l, and the signs used by
PlenOctrees, Plenoxels and 3D Gaussian splatting files: Y_00 = 0.282..., Y_1 = 0.4886... * (-y, +z, -x). The basis is
orthonormal over the sphere: the integral of Y_j * Y_k is 1 if j = k and else 0.
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

MAX_DEGREE = 4
Values = TypeVar("Values", "np.ndarray", "Tensor")
"""numpy arrays or torch tensors: what comes out is of the kind that went in."""


def _norm(numerator: float, denominator: float) -> float:
    return math.sqrt(numerator / (denominator * math.pi))


Y00 = _norm(1, 4)
_C1 = _norm(3, 4)
_C2 = (_norm(15, 4), _norm(5, 16), _norm(15, 16))
_C3 = (_norm(35, 32), _norm(105, 4), _norm(21, 32), _norm(7, 16), _norm(105, 16))
_C4 = (_norm(315, 16), _norm(315, 32), _norm(45, 16), _norm(45, 32), _norm(9, 256), _norm(45, 64), _norm(315, 256))


def basis_dim(degree: int) -> int:
    """Number of coefficients of all bands up to ``degree``: (degree + 1)**2; ValueError unless it is 0 to 4."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"sh degree must be 0 to {MAX_DEGREE}, got {degree}")
    return (degree + 1) ** 2


def eval_basis(degree: int, dirs: Values) -> Values:
    """Values of the basis functions.

    Args:
        degree: highest band, 0 to 4.
        dirs: unit directions, (..., 3), any floating type.

    Returns:
        (..., (degree + 1)**2) in the type of ``dirs``. Differentiable in torch. Directions are taken as they are: these are
        the harmonics only on the unit sphere.

    Raises:
        ValueError: another degree, or dirs that are not floating point of shape (..., 3).
    """
    basis_dim(degree)
    in_numpy = isinstance(dirs, np.ndarray)
    is_floating = dirs.dtype.kind == "f" if in_numpy else dirs.is_floating_point()
    if dirs.shape[-1:] != (3,) or not is_floating:
        raise ValueError(f"dirs must be floating point of shape (..., 3), got {dirs.dtype} {tuple(dirs.shape)}")
    library = np if in_numpy else sys.modules["torch"]  # whoever has a tensor has loaded it
    x, y, z = dirs[..., 0], dirs[..., 1], dirs[..., 2]
    values = [library.full_like(x, Y00)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree < 2:
        return cast("Values", library.stack(values, -1))
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    values += [_C2[0] * xy, -_C2[0] * yz, _C2[1] * (2 * zz - xx - yy), -_C2[0] * xz, _C2[2] * (xx - yy)]
    if degree >= 3:
        values += [
            -_C3[0] * y * (3 * xx - yy),
            _C3[1] * xy * z,
            -_C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -_C3[2] * x * (4 * zz - xx - yy),
            _C3[4] * z * (xx - yy),
            -_C3[0] * x * (xx - 3 * yy),
        ]
    if degree >= 4:
        values += [
            _C4[0] * xy * (xx - yy),
            -_C4[1] * yz * (3 * xx - yy),
            _C4[2] * xy * (7 * zz - 1),
            -_C4[3] * yz * (7 * zz - 3),
            _C4[4] * (zz * (35 * zz - 30) + 3),
            -_C4[3] * xz * (7 * zz - 3),
            _C4[5] * (xx - yy) * (7 * zz - 1),
            -_C4[1] * xz * (xx - 3 * yy),
            _C4[6] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return cast("Values", library.stack(values, -1))


def eval_colour(sh: Values, dirs: Values) -> Values:
    """Colour 1/2 + sum_k sh_k Y_k(d), without a clamp.

    Args:
        sh: coefficients (..., 3, (degree + 1)**2).
        dirs: unit directions (..., 3).

    Returns:
        (..., 3).

    Raises:
        ValueError: sh of another shape, a degree above 4, or dirs as in :func:`eval_basis`.
    """
    degree = math.isqrt(sh.shape[-1]) - 1
    if sh.ndim < 2 or sh.shape[-2] != 3 or (degree + 1) ** 2 != sh.shape[-1]:
        raise ValueError(f"sh must have shape (..., 3, (degree + 1)**2), got {tuple(sh.shape)}")
    return cast("Values", 0.5 + (sh * eval_basis(degree, dirs)[..., None, :]).sum(-1))
