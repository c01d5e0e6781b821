"""Media: sparse storage, lookup, majorants, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from data_synth import media, transmittance
from data_synth.errors import InputError

LO, HI = (-1.0, 0.0, 2.0), (1.0, 3.0, 3.0)


def sample_at(m, points):
    """Density at points, through the public estimator: a homogeneous limit of very short regular tracking."""
    h = 1e-6
    out = []
    for p in points:
        t = transmittance.sample_transmittance(m, np.array(p) - [h / 2, 0, 0], (1.0, 0.0, 0.0), h, "regular")
        out.append(-np.log(t[0, 1]) / h)
    return np.array(out)


def trilinear(values, u):
    i = np.minimum(u.astype(int), np.array(values.shape) - 2)
    f, total = u - i, 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1 - f))
        total += weight * values[tuple(i + corner)]
    return total


def test_lookup_is_trilinear_across_bricks():
    rng = np.random.default_rng(0)
    values = rng.random((20, 11, 9))
    m = media.grid(values, LO, HI)
    points = rng.uniform(LO, HI, (200, 3)) * 0.98 + 0.01 * (np.array(LO) + np.array(HI))
    u = (points - LO) / (np.array(HI) - LO) * (np.array(values.shape) - 1)
    want = [trilinear(values.astype(np.float32).astype(float), q) for q in u]
    # the probe is an extinction over 1e-6 u: -log(1 - 1e-6 rho) / 1e-6 loses 10 of 16 digits
    assert np.allclose(sample_at(m, points), want, atol=2e-5)


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(np.float32, st.tuples(*[st.integers(2, 20)] * 3), elements=st.floats(0, 100, width=32)))
def test_majorants_bound_the_density_everywhere(values):
    m = media.grid(values, LO, HI)
    assert np.array_equal(media.dense(m), values)
    u = np.random.default_rng(0).random((50, 3)) * (np.array(values.shape) - 1)
    for q in u:
        brick = np.ravel_multi_index(tuple((q // 8).astype(int)), m.bricks)
        rho = trilinear(values.astype(float), q)
        slack = 1e-6 * max(rho, 1e-30)
        assert m.brick_min[brick] - slack <= rho <= m.brick_max[brick] + slack <= m.max_density * (1 + 2e-6) + 1e-29


def test_empty_bricks_are_not_stored():
    values = np.zeros((65, 65, 65))
    values[30, 30, 30] = 1.0
    m = media.grid(values, LO, HI)
    assert m.samples.size == 729 and (m.offsets >= 0).sum() == 1


def test_exponential_majorants_bound_it():
    m = media.exponential((0, 0, 0), (1, 1, 2), 0.3)
    edges = np.linspace(0, 2, 17)
    assert np.allclose(m.brick_max, np.exp(-edges[:-1] / 0.3)) and np.allclose(m.brick_min, np.exp(-edges[1:] / 0.3))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"density": -np.ones((3, 3, 3))}, "not negative"),
        ({"density": np.full((3, 3, 3), np.nan)}, "NaN"),
        ({"density": np.ones((3, 3))}, "3D"),
        ({"majorant": 0.5}, "majorant 0.5 lies below the largest density 1"),
        ({"sigma_t": -1.0}, "sigma_t"),
        ({"sigma_t": (1.0, np.nan, 1.0)}, "sigma_t"),
        ({"albedo": 1.2}, "albedo"),
        ({"Le": -0.1}, "Le"),
        ({"attribute": np.ones((2, 2, 2))}, "attribute"),
        ({"lo": (0.0, 0.0, 5.0)}, "lo < hi"),
    ],
)
def test_bad_coefficients_are_refused(change, message):
    good = {"density": np.ones((3, 3, 3)), "lo": (0, 0, 0), "hi": (1, 1, 1)}
    with pytest.raises(InputError, match=message):
        media.grid(**(good | change))
