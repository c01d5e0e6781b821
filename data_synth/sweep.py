"""The thickness between every sample of a density grid and a distant light, plane by plane (PHYSICS 8).

Light falls along the grid axis that it is most parallel to. A sample's thickness is that of the point where its light
comes through the plane before, plus the thickness of the one cell in between:
    thickness(x) = thickness(x + l w) + integral of rho from x to x + l w,   w the direction towards the light.
The point between the samples of that plane is interpolated by cubics: from plane to plane linear interpolation would
spread a shadow sideways. The integral is Simpson's rule. Whole planes are added up at a time.
"""

from __future__ import annotations

import math

import numpy as np

PAD = 3  # a light that runs along a diagonal looks up to three samples beyond the edge


def thickness(rho: np.ndarray, cell, towards) -> np.ndarray:
    """(nx, ny, nz) float32 integrals of rho (same shape) from every sample along unit ``towards``. cell: edges in u."""
    d = np.array(towards) / np.array(cell)
    axis = int(np.argmax(np.abs(d)))
    slope = np.delete(d, axis) / abs(d[axis])  # cells sideways per plane
    length = cell[axis] / abs(towards[axis])
    planes = np.moveaxis(rho, axis, 0)
    if d[axis] > 0:  # the first plane is the one nearest to the light
        planes = planes[::-1]
    planes = np.pad(planes, ((0, 0), (PAD, PAD), (PAD, PAD)))
    out = np.zeros(rho.shape, np.float32)
    swept = np.moveaxis(out, axis, 0)[:: -1 if d[axis] > 0 else 1]
    for a in range(1, len(planes)):
        before = np.maximum(shifted(np.pad(swept[a - 1], PAD, mode="reflect", reflect_type="odd"), slope, cubic), 0.0)
        ends = planes[a, PAD:-PAD, PAD:-PAD] + shifted(planes[a - 1], slope, linear)
        middle = 0.5 * shifted(planes[a] + planes[a - 1], 0.5 * slope, linear)
        swept[a] = before + np.float32(length / 6.0) * (ends + 4.0 * middle)
        # samples on a side that light comes in through have nothing before them
        if slope[0] != 0.0:
            swept[a][0 if slope[0] < 0.0 else -1] = 0.0
        if slope[1] != 0.0:
            swept[a][:, 0 if slope[1] < 0.0 else -1] = 0.0
    return out


def linear(f: float) -> tuple[int, tuple]:
    """(offset of the first sample, weights) to interpolate at a fraction f between samples 0 and 1."""
    return 0, (1.0 - f, f)


def cubic(f: float) -> tuple[int, tuple]:
    """The same by the cubic through samples -1, 0, 1, 2 (Lagrange)."""
    return -1, (
        -f * (f - 1) * (f - 2) / 6,
        (f + 1) * (f - 1) * (f - 2) / 2,
        -(f + 1) * f * (f - 2) / 2,
        (f + 1) * f * (f - 1) / 6,
    )


def shifted(plane: np.ndarray, by, kernel) -> np.ndarray:
    """A padded plane interpolated ``by`` (cells along its two axes) away from each sample, without its padding."""
    for axis in (0, 1):
        whole = math.floor(by[axis])
        first, weights = kernel(by[axis] - whole)
        n, start, total = plane.shape[axis] - 2 * PAD, PAD + whole + first, None
        for q, weight in enumerate(weights):
            window = plane[start + q : start + q + n] if axis == 0 else plane[:, start + q : start + q + n]
            term = np.float32(weight) * window
            total = term if total is None else np.add(total, term, out=total)
        plane = total
    return plane
