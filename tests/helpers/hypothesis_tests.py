"""Statistics for tests of anything random: what counts as a failure is a probability, not a hand-made tolerance."""

from __future__ import annotations

import numpy as np
from scipy import stats

ALPHA = 1e-4  # chance that a correct implementation fails one call, for a fresh seed; the seeds are fixed


def sidak(alpha: float, tests: int) -> float:
    """Per-test level such that ``tests`` independent tests together fail with probability ``alpha``."""
    return -np.expm1(np.log1p(-alpha) / tests)


def assert_means(mean, variance_of_mean, expected, alpha: float = ALPHA, bias: float = 0.0) -> None:
    """Two-sided z-test of every element at once, with Sidak's correction.

    mean, variance_of_mean, expected: broadcastable arrays. bias: known largest error of ``expected`` itself, such as
    a quadrature's; it is subtracted from the deviation. Elements without variance must agree to rounding.
    """
    mean, variance, expected = np.broadcast_arrays(
        np.asarray(mean, float), np.asarray(variance_of_mean, float), np.asarray(expected, float)
    )
    off = np.maximum(np.abs(mean - expected) - bias, 0.0)
    exact = variance <= 0
    rounding = 1e-9 * np.maximum(np.abs(expected), 1.0)
    assert (off[exact] <= rounding[exact]).all(), f"constant samples are off by up to {off[exact].max():.3g}"
    if (~exact).any():
        z = off[~exact] / np.sqrt(variance[~exact])
        limit = stats.norm.isf(0.5 * sidak(alpha, z.size))
        worst = int(np.argmax(z))
        assert z.max() <= limit, (
            f"|z| = {z.max():.2f} exceeds {limit:.2f} in {np.sum(z > limit)} of {z.size} tests; the worst has mean "
            f"{mean[~exact][worst]:.6g}, expected {expected[~exact][worst]:.6g}"
        )


def assert_sample_mean(samples, expected, alpha: float = ALPHA, bias: float = 0.0) -> None:
    """z-test of the mean over axis 0 of independent samples (n, ...)."""
    samples = np.asarray(samples, float)
    assert_means(samples.mean(axis=0), samples.var(axis=0, ddof=1) / len(samples), expected, alpha, bias)


def assert_histogram(counts, expected, alpha: float = ALPHA) -> None:
    """Pearson's chi-square test of bin counts against expected counts; bins are pooled until 5 are expected in each."""
    counts, expected = np.ravel(counts).astype(float), np.ravel(expected).astype(float)
    assert abs(counts.sum() - expected.sum()) <= 1e-6 * counts.sum() + 0.5, (
        f"{counts.sum()} samples against {expected.sum():.6g} expected: the density is not normalised"
    )
    observed, wanted = [0.0], [0.0]
    for k in np.argsort(expected):
        if wanted[-1] >= 5.0:
            observed.append(0.0)
            wanted.append(0.0)
        observed[-1] += counts[k]
        wanted[-1] += expected[k]
    assert len(wanted) > 1 and wanted[-1] >= 5.0, "too few samples for a chi-square test"
    observed, wanted = np.array(observed), np.array(wanted)
    chi2 = ((observed - wanted) ** 2 / wanted).sum()
    p = stats.chi2.sf(chi2, len(wanted) - 1)
    assert p > alpha, f"chi2 = {chi2:.1f} with {len(wanted) - 1} degrees of freedom, p = {p:.2g} < {alpha:g}"
