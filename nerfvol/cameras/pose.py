"""Poses: camera-to-world matrices in OpenGL axes (x right, y up, looking down -z), made exactly rigid or refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.errors import InputError

Float = NDArray[np.float64]

RIGID_TOLERANCE = 5e-3
"""Of R^T R from the identity: three decimals in a file leave up to 2e-3, and 4e-3 where they were scaled by a third first."""
FARTHEST = 1e15
"""Positions beyond it overflow in float32 squares, and float32 rays from there see nothing."""


class ShearedPose(InputError):
    """A pose whose axes have several lengths, or are not at right angles.

    That is a convention we misread, or a file somebody edited, and no odd frame among good ones: nothing is left out for it.
    """


def rigid_pose(c2w: ArrayLike) -> Float:
    """The (4, 4) float64 pose, with the nearest exact rotation, of a camera-to-world matrix (4, 4) or (3, 4).

    The rotation nearest to a matrix U S V^T, in least squares, is U V^T (the orthogonal Procrustes problem, Schönemann
    1966).

    Raises:
        InputError: the matrix is no rigid pose to within 5e-3, is not finite or lies beyond 1e15 units.
    """
    matrix = np.asarray(c2w, dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"a camera pose must be a 4x4 (or 3x4) matrix, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InputError("a camera pose must hold finite numbers only, got NaN or infinity")
    if not np.abs(matrix[:3, 3]).max() < FARTHEST:
        raise InputError(f"a camera must be within {FARTHEST:g} units of the origin, got {_numbers(matrix[:3, 3])}")
    if matrix.shape == (4, 4) and np.abs(matrix[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        turned = np.abs(matrix[:3, 3]).max() <= RIGID_TOLERANCE
        hint = ": is the matrix transposed, with the position in its last row?" if turned else ""
        raise InputError(f"the last row of a camera pose must be 0 0 0 1, got {_numbers(matrix[3])}{hint}")
    r = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(r.T @ r - np.eye(3)).max()
        lengths = np.linalg.norm(r, axis=0)
    if not error <= RIGID_TOLERANCE:
        raise ShearedPose(
            "a camera pose must be rigid (an orthonormal rotation and a translation), got a 3x3 part with columns of "
            f"lengths {_numbers(lengths)} that is orthonormal only to {error:.2g}"
        )
    if np.linalg.det(r) < 0:
        raise InputError("a camera pose must be rigid and right-handed, got a mirrored rotation (determinant -1)")
    u, _, vt = np.linalg.svd(r)
    out = np.eye(4)
    out[:3, :3] = u @ vt
    out[:3, 3] = matrix[:3, 3]
    return out


def unscaled_pose(c2w: ArrayLike) -> tuple[Float, float]:
    """The rigid pose (4, 4) of a camera-to-world matrix whose axes may be too long or short, and by what factor they were.

    Rays are unit vectors, so that the lengths of a camera's axes say nothing of the scene: each column of the 3x3 part is
    divided by its own. Axes of different lengths give their geometric mean as the factor; 1 where the matrix was rigid.

    Raises:
        InputError: see rigid_pose; axes that are not perpendicular, left-handed, or shorter than 1e-9.
    """
    matrix = np.array(c2w, dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        return rigid_pose(matrix), 1.0
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if np.abs(lengths**2 - 1).max() <= RIGID_TOLERANCE or not 1e-9 < lengths.min() <= lengths.max() < 1e9:
        return rigid_pose(matrix), 1.0
    whole = matrix.copy()
    whole[:3, :3] /= lengths
    try:
        return rigid_pose(whole), float(np.prod(lengths)) ** (1 / 3)
    except InputError:
        return rigid_pose(matrix), 1.0  # its sentence names the lengths as they are in the file


def _numbers(values: ArrayLike) -> str:
    return " ".join(f"{v:.4g}" for v in np.ravel(values))


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Float:
    """The pose (4, 4) at ``eye`` (3,) that looks at ``target`` (3,) with ``up`` (3,) upwards in the image.

    Raises:
        InputError: ``up`` is along the line of sight, or the two points are one.
    """
    eye, target, up = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
    back = eye - target
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(up) * np.linalg.norm(back):
        raise InputError(f"cannot look from {_numbers(eye)} at {_numbers(target)} with {_numbers(up)} upwards")
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return pose


def orbit_axes(up: ArrayLike) -> tuple[Float, Float, Float]:
    """Unit vectors (3,) of an orbit about ``up`` (3,), of any length: the axis, azimuth 0 and azimuth 90 degrees."""
    axis: Float = np.asarray(up, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    start: Float = np.eye(3)[int(np.argmin(np.abs(axis)))]
    start = start - axis * float(start @ axis)
    start = start / np.linalg.norm(start)
    side: Float = np.cross(axis, start)
    return axis, start, side
