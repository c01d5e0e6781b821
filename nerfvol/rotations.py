"""Rotations: quaternions (w, x, y, z), matrices, and the way from one direction to another. numpy, float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]


def rotations(quats: ArrayLike) -> Float:
    """Matrices (n, 3, 3) of quaternions (n, 4) of any length but zero."""
    q = np.asarray(quats, np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def rotation_of(vector: ArrayLike) -> Float:
    """The rotation (3, 3) about the axis ``vector`` (3,) by its length in radians (Rodrigues' formula)."""
    w = np.asarray(vector, np.float64)
    k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    angle = float(np.linalg.norm(w))
    if angle < 1e-6:  # sines and cosines of less cancel; the series' next terms are below rounding
        return np.eye(3) + k + k @ k / 2
    return np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * (k @ k)


def quaternion(rotation: ArrayLike) -> Float:
    """The unit quaternion (4,) of a rotation matrix (3, 3), through the largest of its four numbers (Shepperd 1978)."""
    m = np.asarray(rotation, np.float64)
    squares = [
        1 + m[0, 0] + m[1, 1] + m[2, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2],
        1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2],
    ]  # fmt: skip
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = [[squares[0], x, y, z], [x, squares[1], xy, xz], [y, xy, squares[2], yz], [z, xz, yz, squares[3]]]
    q = np.array(rows[int(np.argmax(squares))])
    return q / np.linalg.norm(q)


def product(a: ArrayLike, b: ArrayLike) -> Float:
    """Quaternions (..., 4) of the rotations ``b`` and after them ``a``."""
    (w, v), (x, u) = ((np.asarray(q, np.float64)[..., :1], np.asarray(q, np.float64)[..., 1:]) for q in (a, b))
    return np.concatenate([w * x - (v * u).sum(-1, keepdims=True), w * u + x * v + np.cross(v, u)], axis=-1)


def between(source: ArrayLike, target: ArrayLike) -> Float:
    """The rotation (3, 3) by the smallest angle that takes the unit vector ``source`` to ``target`` (Rodrigues' formula)."""
    a, b = np.asarray(source, np.float64), np.asarray(target, np.float64)
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-12:  # half a turn about an axis across: the one nearest to x, or to y where that is along
        across = np.eye(3)[0] - a[0] * a if abs(a[0]) < 0.9 else np.eye(3)[1] - a[1] * a
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def turning_z_to(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (n, 4), w first, of rotations that turn the z axis to unit vectors (n, 3).

    Half the sum of z and the normal is the axis of the half turn; for normals that point down another one serves as well,
    since a disc has two sides.
    """
    n = np.where(normals[:, 2:] < 0, -normals, normals)
    q = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], axis=1)
    return q / np.linalg.norm(q, axis=1, keepdims=True)
