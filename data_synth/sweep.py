"""The thickness between every sample of a density grid and a distant light, plane by plane (PHYSICS 8).

Light falls along the grid axis that it is most parallel to. A sample's thickness is that of the point where its light
comes through the plane before, plus the thickness of the one cell in between:
    thickness(x) = thickness(x + l w) + integral of rho from x to x + l w,   w the direction towards the light.
The integral is Simpson's rule, rho linear between the samples of a plane. It asks for the density alone: all cores share
the planes. The sum is a third of the work and goes from plane to plane: one core adds up. The point between the samples
of the plane before is interpolated by cubics, since linear interpolation would spread a shadow sideways on its way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from data_synth.jit import in_bands, jit, kernel

PAD = 3  # a light that runs along a diagonal looks up to three samples beyond the edge


class Shift(NamedTuple):
    """A way sideways. whole: (2,) samples along the axes of a plane; weights: (2, 4) float32 of samples whole - 1..2."""

    whole: np.ndarray
    weights: np.ndarray


def thickness(rho: np.ndarray, cell: Sequence[float], towards: Sequence[float]) -> np.ndarray:
    """(nx, ny, nz) float32 integrals of rho (same shape) from every sample along unit ``towards``. cell: edges in u.

    The same bits for any number of threads: each integral is made by one of them, and the sum has one order.
    """
    d = np.array(towards) / np.array(cell)
    axis = int(np.argmax(np.abs(d)))
    slope = np.delete(d, axis) / abs(d[axis])  # cells sideways per plane
    length = cell[axis] / abs(towards[axis])
    falling = slice(None, None, -1 if d[axis] > 0 else 1)  # the first plane is the one nearest to the light
    planes = np.moveaxis(rho, axis, 0)[falling]
    n, h, w = planes.shape
    swept, edge = np.zeros((n, h + 2 * PAD, w + 2 * PAD), np.float32), ((0, 0), (PAD, PAD), (PAD, PAD))

    def integrate(first: int, last: int) -> None:
        """The cells between planes first..last - 1 and the next of each."""
        part, room = np.pad(planes[first : last + 1], edge), np.empty((4, w + 2 * PAD), np.float32)
        _integrate(part, linear(slope), linear(0.5 * slope), np.float32(length / 6), room, swept[first : last + 1])

    in_bands(integrate, n - 1)
    _add_up(swept, cubic(slope), np.sign(slope), np.empty((2, w + 2 * PAD), np.float32))
    return np.moveaxis(swept[falling, PAD:-PAD, PAD:-PAD], 0, axis)


def linear(by: np.ndarray) -> Shift:
    """``by`` (2,) samples sideways, linear in between."""
    whole = np.floor(by)
    f = by - whole
    return Shift(whole.astype(np.int64), np.stack([0 * f, 1 - f, f, 0 * f], axis=1).astype(np.float32))


def cubic(by: np.ndarray) -> Shift:
    """The same by the cubics through four samples (Lagrange)."""
    whole = np.floor(by)
    f = by - whole
    a, b = f * (f + 1), (f - 1) * (f - 2)
    weights = np.stack([-f * b / 6, (f + 1) * b / 2, -a * (f - 2) / 2, a * (f - 1) / 6], axis=1)
    return Shift(whole.astype(np.int64), weights.astype(np.float32))


@jit
def mix(weights, a, b, c, d, out):
    """A plain loop over rows of numbers, which the compiler turns into vector instructions."""
    for k in range(out.size):
        out[k] = weights[0] * a[k] + weights[1] * b[k] + weights[2] * c[k] + weights[3] * d[k]


@jit
def shifted(plane, j, shift, row, out):
    """Row j of a padded plane as seen a shift away, to out (w,). row: (padded w,) room."""
    r, k, n = j + shift.whole[0], PAD + shift.whole[1], out.size
    mix(shift.weights[0], plane[r - 1], plane[r], plane[r + 1], plane[r + 2], row)
    mix(shift.weights[1], row[k - 1 : k - 1 + n], row[k : k + n], row[k + 1 : k + 1 + n], row[k + 2 : k + 2 + n], out)


@kernel
def _integrate(rho, far, half, sixth, room, out):
    """Integrals of rho from each sample of plane a > 0 to its end in plane a - 1, to out[a]; planes are padded.

    far, half: the shifts to the end and to the middle. sixth: a sixth of the length. room: (4, padded w).
    """
    h, w = rho.shape[1:]
    row, end, before, after = room[0], room[1, PAD : w - PAD], room[2, PAD : w - PAD], room[3, PAD : w - PAD]
    two = np.float32(2.0)  # so that the sum stays in float32
    for a in range(1, len(rho)):
        for j in range(PAD, h - PAD):
            shifted(rho[a - 1], j, far, row, end)
            shifted(rho[a - 1], j, half, row, before)
            shifted(rho[a], j, half, row, after)
            start, here = rho[a, j, PAD : w - PAD], out[a, j, PAD : w - PAD]
            for k in range(here.size):  # four times the middle is twice (before + after)
                here[k] = sixth * (start[k] + two * (before[k] + after[k]) + end[k])


@jit
def extend(plane):
    """Fill the padding of a plane: reflected in its edge samples, odd, so that a slope goes on."""
    h, w = plane.shape
    for i in range(1, PAD + 1):
        for k in range(PAD, w - PAD):
            for edge, out in ((PAD, -1), (h - PAD - 1, 1)):
                plane[edge + out * i, k] = plane[edge, k] + (plane[edge, k] - plane[edge - out * i, k])
    for i in range(1, PAD + 1):
        for j in range(h):
            for edge, out in ((PAD, -1), (w - PAD - 1, 1)):
                plane[j, edge + out * i] = plane[j, edge] + (plane[j, edge] - plane[j, edge - out * i])


@kernel
def _add_up(swept, shift, side, room):
    """Add to every plane of integrals what lies before it, from the second plane on. shift: to where light comes from.

    side: (2,) signs of the shift: samples on a side that light comes in through have nothing before them.
    """
    h, w = swept.shape[1:]
    row, before, zero = room[0], room[1, PAD : w - PAD], np.float32(0.0)
    for a in range(1, len(swept)):
        extend(swept[a - 1])
        for j in range(PAD, h - PAD):
            shifted(swept[a - 1], j, shift, row, before)
            here = swept[a, j, PAD : w - PAD]
            for k in range(here.size):
                here[k] += max(before[k], zero)
            if (side[0] < 0 and j == PAD) or (side[0] > 0 and j == h - PAD - 1):
                here[:] = zero
            if side[1] < 0:
                here[0] = zero
            if side[1] > 0:
                here[here.size - 1] = zero
