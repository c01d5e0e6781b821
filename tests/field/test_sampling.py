"""Samplers: distribution (chi-squared), exact quantiles, boxes, and random numbers that depend on counters alone."""

import numpy as np
import pytest
import torch
from scipy import stats

from nerfvol.field.sampling import edges_of, intersect_aabb, inverse_cdf, step_generator, stratified

N = 4000


def chi2_p(samples: np.ndarray, edges: np.ndarray, mass: np.ndarray) -> float:
    """p-value of counts in the bins against the expected masses."""
    counts = np.histogram(samples, edges)[0]
    return stats.chisquare(counts, mass / mass.sum() * len(samples)).pvalue


def test_stratified_has_one_uniform_sample_in_each_bin() -> None:
    near, far = torch.full((N,), 2.0, dtype=torch.float64), torch.full((N,), 5.0, dtype=torch.float64)
    t = stratified(near, far, 6, step_generator(1, 0))
    bins = ((t - 2) / 0.5).floor().long()
    assert torch.equal(bins, torch.arange(6).expand(N, 6))
    # Uniform inside each bin, and independent between bins.
    inside = ((t - 2) / 0.5 - bins).numpy()
    for column in inside.T:
        assert chi2_p(column, np.linspace(0, 1, 17), np.ones(16)) > 1e-4
    assert abs(np.corrcoef(inside.T)[0, 1]) < 4 / np.sqrt(N)
    middles = stratified(near[:1], far[:1], 6)
    torch.testing.assert_close(middles, torch.tensor([[2.25, 2.75, 3.25, 3.75, 4.25, 4.75]], dtype=torch.float64))


def test_inverse_cdf_follows_the_weights() -> None:
    """Samples of one draw a ray (no stratification between rays) follow the piecewise-constant density."""
    edges = np.array([0.0, 0.5, 2.0, 2.25, 4.0])
    mass = np.array([0.2, 1.3, 0.0, 0.9])
    t = inverse_cdf(torch.tensor(edges).expand(N, 5), torch.tensor(mass).expand(N, 4), 1, step_generator(2, 0)).numpy()[
        :, 0
    ]
    fine = np.concatenate(
        [np.linspace(a, b, 5)[:-1] for a, b in zip(edges[:-1], edges[1:], strict=True)] + [edges[-1:]]
    )
    expected = np.repeat(mass / 4, 4)
    counts = np.histogram(t, fine)[0]
    assert counts[8:12].sum() == 0
    used = expected > 0
    assert stats.chisquare(counts[used], expected[used] / mass.sum() * N).pvalue > 1e-4
    mean = float((mass * (edges[1:] + edges[:-1]) / 2).sum() / mass.sum())
    assert abs(t.mean() - mean) < 4 * t.std() / np.sqrt(N)


def test_inverse_cdf_without_a_generator_gives_the_quantiles() -> None:
    t = inverse_cdf(torch.tensor([[0.0, 1.0, 3.0]]), torch.tensor([[1.0, 1.0]]), 4)
    torch.testing.assert_close(t, torch.tensor([[0.25, 0.75, 1.5, 2.5]]))
    # A quantile on the edge of an empty bin lies where the next mass begins.
    assert float(inverse_cdf(torch.tensor([[0.0, 1.0, 2.0, 3.0]]), torch.tensor([[1.0, 0.0, 1.0]]), 1)) == 2


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_inverse_cdf_of_degenerate_weights(scale: float) -> None:
    """Empty bins at both ends, all mass in one bin, no mass at all: finite, sorted, inside the edges."""
    edges = torch.linspace(1, 2, 6).expand(3, 6)
    weights = torch.tensor([[0.0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [0, 1, 0, 1, 0]]) * scale
    t = inverse_cdf(edges, weights, 64, step_generator(3, 0))
    assert bool(t.isfinite().all()) and bool((t.diff(dim=-1) >= 0).all())
    assert float(t[0].min()) >= 1.4 - 1e-6 and float(t[0].max()) <= 1.6 + 1e-6
    assert chi2_p(t[1].numpy(), np.linspace(1, 2, 9), np.ones(8)) > 1e-3
    assert not bool(((t[2] > 1.4 + 1e-6) & (t[2] < 1.6 - 1e-6)).any())


def test_inverse_cdf_refuses_mismatched_arrays_and_passes_no_gradient() -> None:
    weights = torch.rand(2, 4, requires_grad=True)
    assert not inverse_cdf(torch.linspace(0, 1, 5).expand(2, 5), weights, 3).requires_grad
    with pytest.raises(ValueError, match="one more column"):
        inverse_cdf(torch.rand(2, 4), torch.rand(2, 4), 3)


def test_edges_close_the_interval() -> None:
    edges = edges_of(torch.tensor([[1.0, 2.0, 4.0]]), torch.tensor([0.5]), torch.tensor([5.0]))
    torch.testing.assert_close(edges, torch.tensor([[0.5, 1.5, 3.0, 5.0]]))


def test_boxes_against_a_dense_scan() -> None:
    """near and far agree with where a finely sampled ray is inside, for rays from inside, outside and along axes."""
    generator = torch.Generator().manual_seed(4)
    aabb = torch.tensor([[-1.0, -0.5, 0.2], [0.8, 1.5, 2.0]], dtype=torch.float64)
    o, aside = torch.randn(2, 300, 3, dtype=torch.float64, generator=generator) * 1.5
    d = torch.nn.functional.normalize(aside - o, dim=-1)
    d[:50] = torch.eye(3, dtype=torch.float64)[torch.arange(50) % 3] * torch.where(o[:50, :1] > 0, -1.0, 1.0)
    near, far = intersect_aabb(o, d, aabb)
    t = torch.linspace(0, 12, 6001, dtype=torch.float64)
    points = o[:, None] + d[:, None] * t[:, None]
    inside = ((points > aabb[0]) & (points < aabb[1])).all(-1)
    length = inside.sum(-1).double() * float(t[1])
    torch.testing.assert_close(far - near, length, rtol=0, atol=2 * float(t[1]))
    hit = inside.any(-1)
    assert 60 < int(hit.sum()) < 270
    first = t[inside[hit].to(torch.uint8).argmax(-1)]
    torch.testing.assert_close(near[hit], first, rtol=0, atol=2 * float(t[1]))
    assert bool((near >= 0).all()) and bool((far >= near).all())


def test_generators_depend_on_the_counters_alone() -> None:
    def draw(*counters: int) -> list[float]:
        return torch.rand(4, generator=step_generator(*counters)).tolist()

    assert draw(5, 7) == draw(5, 7)
    different = [draw(*c) for c in ((5, 7), (5, 8), (7, 5), (6, 7), (5, 7, 1), (0, 0), (0, 1), (1, 0))]
    assert len({tuple(values) for values in different}) == len(different)
    # First numbers of neighbouring steps are themselves a uniform sample.
    first = np.array([draw(0, step)[0] for step in range(2000)])
    assert chi2_p(first, np.linspace(0, 1, 17), np.ones(16)) > 1e-4
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 4 / np.sqrt(2000)
