"""Seeds are independent: of two of them the means differ, and no sample of the one comes back in the other."""

import numpy as np
import pytest

from data_synth import InputError, media
from data_synth.rng import new_rng
from data_synth.transmittance import sample_flights, sample_transmittance

RAY = ((-2.0, 0.1, 0.2), (1.0, 0.0, 0.0))


def lumps():
    density = np.random.default_rng(3).random((9, 10, 11)) ** 2 * 3
    return media.grid(density, (-1, -1, -1), (1, 1, 1), (0.7, 1.0, 1.6), 0.8)


def test_seeds_share_no_samples():
    flights = [sample_flights(lumps(), *RAY, n=4000, seed=seed) for seed in range(4)]
    finite = [set(f[np.isfinite(f)]) for f in flights]
    assert min(map(len, finite)) > 1000  # nearly all flights differ from one another
    for a in range(4):
        for b in range(a):
            assert not finite[a] & finite[b]


def test_means_of_seeds_scatter_as_their_variance_says():
    """The spread of the means is sigma / sqrt(n): chi-square with 29 degrees of freedom, two-sided at 1e-4."""
    n, runs = 500, 30
    T = np.array([sample_transmittance(lumps(), *RAY, n=n, seed=seed)[:, 1] for seed in range(runs)])
    chi2 = ((T.mean(axis=1) - T.mean()) ** 2).sum() / (T.var() / n)
    assert 8.18 < chi2 < 68.4  # scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], 29)
    assert len(set(T.mean(axis=1))) == runs


def test_streams_of_a_seed_differ_as_well():
    starts = {int(new_rng(seed, stream)[0]) for seed in range(50) for stream in range(50)}
    assert len(starts) == 2500


def test_negative_seeds_are_refused():
    with pytest.raises(InputError, match="seed"):
        new_rng(-1, 0)
