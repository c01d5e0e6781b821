"""exp(-tau) and 1 - exp(-tau) of a single segment, to the last bits; u = 2**-24 is float32's unit roundoff.

The cell is [0, 1]^3, raw density 1 at every corner and colour 1: the segment's length, its density and so its optical
depth, the octree's density scale, are exact float32 numbers.
"""

import numpy as np
import pytest
import torch

from nerfvol.kernels import on_torch
from nerfvol.octree.tree import Octree
from tests.kernels.rounding import U


def seen_through(taus: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and colour over black of the cell at each optical depth."""
    octree = Octree.from_leaves([1], [[0, 0, 0]], (0, 0, 0), 2.0, 0)
    octree.density, octree.sh = 1.0, 0.5 / 0.28209479177387814
    ray = np.array([[-1, 0.5, 0.5]], np.float32), np.array([[1, 0, 0]], np.float32)
    values, found = torch.from_numpy(octree.values), []
    for octree.density_scale in taus.tolist():
        rgb, trans, _ = on_torch.render_values(octree, values, *ray, (0, 0, 0))
        found.append((float(trans), float(rgb[0, 1])))
    return np.array(found).T


def test_the_exponential_is_good_to_one_ulp(isa):
    """u for the last sum and half of it for the one before, a third for what is left of the argument, and the
    polynomial's own error: below 2 u, relative, for every optical depth whose exponential is a normal number."""
    taus = np.concatenate([np.geomspace(1e-6, 87, 400), np.linspace(0.3, 1.1, 400)]).astype(np.float32)
    exact = np.exp(-taus.astype(np.float64))
    trans, _ = seen_through(taus)
    assert np.abs(trans / exact - 1).max() < 2 * U


def test_what_is_absorbed_keeps_its_relative_precision(isa):
    """A polynomial below 1/4: 2.5 u, its last sum and product; above, 2 u of the exponential and u of the difference.
    The colour, a product and a sum of its own, and the product with it add 3 u."""
    taus = np.concatenate([np.geomspace(1e-7, 50, 400), np.linspace(0.2, 0.3, 400)]).astype(np.float32)
    exact = -np.expm1(-taus.astype(np.float64))
    _, colour = seen_through(taus)
    bound = np.where(taus < 0.25, 2.5 * U * exact, U * (2 * (1 - exact) + exact))
    assert (np.abs(colour - exact) < bound + 3 * U * exact).all()


@pytest.mark.parametrize("tau", [88.0, 1e3, 1e30])
def test_nothing_is_seen_behind_opaque_matter(isa, tau):
    trans, colour = seen_through(np.array([tau]))
    assert 0 <= trans < 1.3e-38 and colour == pytest.approx(1, abs=3 * U)
