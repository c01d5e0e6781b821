"""Transmittance and free flights: closed forms, unbiasedness of every tracker, order of the march."""

import numpy as np
import pytest
from scipy import integrate

from data_synth import media
from data_synth.errors import InputError
from data_synth.transmittance import sample_flights, sample_transmittance
from tests.fixtures.hypothesis_tests import assert_histogram, assert_sample_mean

D = np.array([0.6, 0.48, 0.64])
O = np.array([-0.4, -0.3, -0.35])  # noqa: E741
DETERMINISTIC = ["closed", "regular", "march"]
TRACKERS = ["delta", "ratio", "residual"]


def wavy(**kwargs):
    rng = np.random.default_rng(3)
    return media.grid(rng.random((22, 19, 17)) ** 2 * 3, (0, 0, 0), (1, 0.9, 0.8), (0.7, 1.0, 1.6), **kwargs)


@pytest.mark.parametrize("method", DETERMINISTIC)
def test_slab_is_exact(method):
    m = media.homogeneous((-5, -5, 0), (5, 5, 2), (0.3, 1.0, 7.0))
    cosine = D[2]
    T = sample_transmittance(m, (0, 0, -1), D, method=method)[0]
    assert np.allclose(T, np.exp(-np.array([0.3, 1.0, 7.0]) * 2 / cosine), rtol=1e-12)


@pytest.mark.parametrize("method", ["closed", "regular"])
@pytest.mark.parametrize("d", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), tuple(D)])
def test_exponential_density_is_exact(method, d):
    m, o = media.exponential((0, 0, 0), (1, 1, 1), 0.25, 3.0), np.array([0.3, 0.3, 0.4])
    T = sample_transmittance(m, o, d, 0.3, method)[0, 0]
    tau = 3.0 * integrate.quad(lambda t: np.exp(-(o[2] + t * d[2]) / 0.25), 0, 0.3, epsabs=1e-13)[0]
    assert pytest.approx(np.exp(-tau), rel=1e-12) == T


def test_regular_tracking_integrates_a_trilinear_grid_exactly():
    m = wavy()
    values = media.dense(m).astype(float)

    def rho(t):
        u = (O + t * D) / (np.array([1, 0.9, 0.8])) * (np.array(values.shape) - 1)
        u = np.clip(u, 0, np.array(values.shape) - 1)
        i = np.minimum(u.astype(int), np.array(values.shape) - 2)
        f = u - i
        return sum(np.prod(np.where(c, f, 1 - f)) * values[tuple(i + c)] for c in np.ndindex(2, 2, 2))

    t = np.linspace((-O / D).max(), ((np.array([1, 0.9, 0.8]) - O) / D).min(), 10_001)
    tau = integrate.trapezoid([rho(x) for x in t], t)
    T = sample_transmittance(m, O, D, method="regular")[0]
    # the trapezium's error on a continuous function with kinks: slope x step^2 / 8 per kink, 60 kinks, below 1e-5
    assert np.allclose(-np.log(T) / [0.7, 1.0, 1.6], tau, atol=1e-5)
    assert np.ptp(-np.log(T) / [0.7, 1.0, 1.6]) < 1e-12


@pytest.mark.parametrize("local", [True, False])
@pytest.mark.parametrize("method", TRACKERS)
def test_trackers_are_unbiased(method, local):
    m = wavy()
    exact = sample_transmittance(m, O, D, method="regular")[0]
    assert_sample_mean(sample_transmittance(m, O, D, method=method, local=local, n=200_000, seed=5), exact)


def test_trackers_are_unbiased_in_an_exponential_medium():
    m = media.exponential((0, 0, 0), (1, 1, 1), 0.25, 3.0)
    exact = sample_transmittance(m, O, D, method="closed")[0]
    for method in TRACKERS:
        assert_sample_mean(sample_transmittance(m, O, D, method=method, n=100_000), exact)


def test_ratio_beats_delta_and_residual_beats_both():
    m = media.grid(1.0 + 0.3 * np.random.default_rng(0).random((17, 17, 17)), (0, 0, 0), (1, 1, 1), 2.0)
    spread = [sample_transmittance(m, O, D, method=method, n=20_000)[:, 0].var() for method in TRACKERS]
    assert spread[0] > 1.3 * spread[1] > 2.6 * spread[2]


def test_march_converges_at_second_order():
    m = media.exponential((0, 0, 0), (1, 1, 1), 0.25, 3.0)
    exact = sample_transmittance(m, O, D, method="closed")[0, 0]
    lengths = np.array([0.099, 0.0495, 0.02475])  # one, two and four steps in each of the medium's layers
    errors = [abs(sample_transmittance(m._replace(step=h), O, D, method="march")[0, 0] - exact) for h in lengths]
    order = np.polyfit(np.log(lengths), np.log(errors), 1)[0]
    assert 1.9 < order < 2.1, f"errors {errors}"


def survival_bins(m, edges):
    T = [sample_transmittance(m, O, D, t, "regular")[0, 1] for t in edges]
    return -np.diff(T), T[-1]


@pytest.mark.parametrize("method, local", [("woodcock", True), ("woodcock", False), ("regular", True)])
def test_free_flights_follow_the_transmittance(method, local):
    m = wavy()._replace(sigma_t=(2.0, 2.0, 2.0))
    n, edges = 100_000, np.linspace(0.4, 2.2, 40)
    flights = sample_flights(m, O, D, method=method, local=local, n=n, seed=11)
    inside, beyond = survival_bins(m, edges)
    first = 1.0 - sample_transmittance(m, O, D, edges[0], "regular")[0, 1]
    counts, _ = np.histogram(flights[np.isfinite(flights)], np.concatenate([[0], edges]))
    assert_histogram([*counts, np.isinf(flights).sum()], n * np.array([first, *inside, beyond]))


def test_marched_flights_are_biased_and_say_so():
    """The baseline must fail the test that the trackers pass, or that test sees nothing."""
    m = wavy()._replace(sigma_t=(2.0, 2.0, 2.0), step=0.2)
    flights = sample_flights(m, O, D, method="march", n=100_000)
    exact = sample_transmittance(m, O, D, method="regular")[0, 1]
    with pytest.raises(AssertionError, match="exceeds"):
        assert_sample_mean(np.isinf(flights), exact)


def test_homogeneous_flights_are_exponential():
    m = media.homogeneous((-10, -10, -10), (10, 10, 10), 2.5)
    for method in ("closed", "woodcock", "regular", "march"):
        flights = sample_flights(m, (0, 0, 0), D, 1.0, method, n=50_000)
        edges = np.linspace(0, 1, 20)
        counts, _ = np.histogram(flights[np.isfinite(flights)], edges)
        survive = np.exp(-2.5 * edges)
        assert_histogram([*counts, np.isinf(flights).sum()], 50_000 * np.array([*-np.diff(survive), survive[-1]]))


def test_seeds_repeat_and_differ():
    m = wavy()
    a, b, c = (sample_transmittance(m, O, D, n=50, seed=s) for s in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match="unit length"):
        sample_transmittance(wavy(), O, 2 * D)
    with pytest.raises(InputError, match="no closed form"):
        sample_transmittance(wavy(), O, D, method="closed")
    with pytest.raises(InputError, match="expected one of"):
        sample_flights(wavy(), O, D, method="ratio")
