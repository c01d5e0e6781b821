"""The test helpers themselves: they accept the right distribution and reject a slightly wrong one."""

import numpy as np
import pytest

from tests.helpers.hypothesis_tests import assert_histogram, assert_means, assert_sample_mean, sidak


def test_sidak_is_the_joint_level():
    assert 1 - (1 - sidak(0.05, 400)) ** 400 == pytest.approx(0.05)


def test_mean_test_accepts_truth_and_rejects_one_percent():
    x = np.random.default_rng(0).normal(1.0, 0.5, (40_000, 3))
    assert_sample_mean(x, 1.0)
    with pytest.raises(AssertionError, match="exceeds"):
        assert_sample_mean(x, 1.015)
    with pytest.raises(AssertionError, match="constant samples"):
        assert_means(1.0, 0.0, 1.001)


def test_false_alarms_are_as_rare_as_claimed():
    rng, failed = np.random.default_rng(1), 0
    for _ in range(400):
        try:
            assert_sample_mean(rng.random((200, 5)), 0.5, alpha=0.1)
        except AssertionError:
            failed += 1
    assert 20 <= failed <= 64  # 40 expected, +- 4 standard deviations


def test_histogram_accepts_truth_and_rejects_a_tilt():
    rng = np.random.default_rng(2)
    counts = np.bincount((rng.random(50_000) * 20).astype(int), minlength=20)
    assert_histogram(counts, np.full(20, 2500.0))
    with pytest.raises(AssertionError, match="chi2"):
        assert_histogram(counts, 2500.0 * (1 + 0.05 * np.linspace(-1, 1, 20)))
    with pytest.raises(AssertionError, match="normalised"):
        assert_histogram(counts, np.full(20, 2400.0))
