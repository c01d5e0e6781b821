"""The compositing mathematics (docs/mathematics.md, section 1): closed forms, gradients, magnitudes."""

import math

import numpy as np
import pytest
import torch

from nerfvol.quadrature import accumulate, composite, composite_packed, median_depth

DTYPES = [torch.float32, torch.float64]


def random_rays(n: int = 40, s: int = 17, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    sigmas = torch.rand(n, s, generator=generator, dtype=torch.float64) * 4
    deltas = torch.rand(n, s, generator=generator, dtype=torch.float64)
    return sigmas.to(dtype), deltas.to(dtype)


def pixel(sigmas: torch.Tensor, deltas: torch.Tensor, colours: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    parts = composite(sigmas, deltas)
    return accumulate(parts.weights, colours) + parts.trans_final[..., None] * background


@pytest.mark.parametrize("dtype", DTYPES)
def test_weights_and_transmittance_sum_to_one(dtype: torch.dtype) -> None:
    sigmas, deltas = random_rays(dtype=dtype)
    parts = composite(sigmas, deltas)
    # Every factor exp(-x) carries a relative error of x * eps from x itself; s segments are summed.
    tolerance = 4 * sigmas.shape[1] * torch.finfo(dtype).eps
    torch.testing.assert_close(
        parts.weights.sum(-1) + parts.trans_final, torch.ones(len(sigmas), dtype=dtype), rtol=0, atol=tolerance
    )


def test_transmittance_is_taken_before_the_segment() -> None:
    parts = composite(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64), torch.tensor([0.5, 0.25, 0.125]))
    expected = torch.exp(-torch.tensor([[0.0, 0.5, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(parts.trans, expected, rtol=1e-15, atol=0)
    torch.testing.assert_close(parts.trans_final, torch.tensor([math.exp(-1.375)], dtype=torch.float64))
    torch.testing.assert_close(parts.alphas[0, 0], torch.tensor(1 - math.exp(-0.5), dtype=torch.float64))


@pytest.mark.parametrize("n", [1, 2, 7, 64])
def test_homogeneous_slab_and_split_segments(n: int) -> None:
    """A slab gives exp(-sigma L) and (1 - exp(-sigma L)) of its colour, however it is cut."""
    sigma, length = 1.7, 2.3
    cuts = torch.rand(n, dtype=torch.float64, generator=torch.Generator().manual_seed(n))
    deltas = (length * cuts / cuts.sum())[None]
    parts = composite(torch.full((1, n), sigma, dtype=torch.float64), deltas)
    assert float(parts.trans_final) == pytest.approx(math.exp(-sigma * length), rel=1e-14)
    assert float(parts.weights.sum()) == pytest.approx(-math.expm1(-sigma * length), rel=1e-14)


def test_order_matters() -> None:
    sigmas, deltas = torch.tensor([[1.0, 3.0]]), torch.tensor([[1.0, 1.0]])
    colours, background = torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]]]), torch.zeros(3)
    there = pixel(sigmas, deltas, colours, background)
    back = pixel(sigmas.flip(1), deltas, colours.flip(1), background)
    assert (there - back).abs().max() > 0.1
    # Red in front of green: the closed form of two segments.
    a, b = -math.expm1(-1), -math.expm1(-3)
    torch.testing.assert_close(there, torch.tensor([[a, (1 - a) * b, 0.0]]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_empty_and_opaque_limits(dtype: torch.dtype) -> None:
    colours = torch.rand(1, 5, 3, dtype=dtype)
    background = torch.tensor([0.2, 0.4, 0.6], dtype=dtype)
    deltas = torch.ones(1, 5, dtype=dtype)
    empty = pixel(torch.zeros(1, 5, dtype=dtype), deltas, colours, background)
    assert torch.equal(empty[0], background)
    for sigma in (1e4, 1e20, math.inf):
        opaque = pixel(torch.full((1, 5), sigma, dtype=dtype), deltas, colours, background)
        assert torch.equal(opaque[0], colours[0, 0])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("packed", [False, True])
def test_magnitudes(dtype: torch.dtype, packed: bool) -> None:
    """sigma * delta from 1e-12 to 1e4: finite values and gradients, and the small ones keep their digits."""
    for tau in 10.0 ** np.arange(-12, 5):
        sigmas = torch.full((2, 6), tau, dtype=dtype, requires_grad=True)
        deltas = torch.ones(2, 6, dtype=dtype)
        if packed:
            rays = torch.arange(2).repeat_interleave(6)
            parts = composite_packed(sigmas.reshape(-1), deltas.reshape(-1), rays, 2)
        else:
            parts = composite(sigmas, deltas)
        alpha, expected = parts.alphas.reshape(-1)[0], -math.expm1(-tau)
        assert float(alpha.detach()) == pytest.approx(expected, rel=4 * torch.finfo(dtype).eps)
        (parts.weights.sum() + 0.3 * parts.trans_final.sum()).backward()
        assert all(bool(part.isfinite().all()) for part in parts) and bool(sigmas.grad.isfinite().all())


def test_gradients_against_the_closed_form_and_finite_differences() -> None:
    sigmas, deltas = random_rays(6, 9)
    generator = torch.Generator().manual_seed(5)
    colours = torch.rand(6, 9, 3, generator=generator, dtype=torch.float64)
    background = torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64)
    cotangent = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    sigmas.requires_grad_(), colours.requires_grad_()
    (pixel(sigmas, deltas, colours, background) * cotangent).sum().backward()
    with torch.no_grad():
        parts = composite(sigmas, deltas)
        weighted = parts.weights[..., None] * colours
        behind = weighted.sum(1, keepdim=True) - weighted.cumsum(1)  # sum over j > i of w_j c_j
        after = parts.trans * (1 - parts.alphas)  # T_{i+1}
        jacobian = deltas[..., None] * (
            after[..., None] * colours - behind - parts.trans_final[:, None, None] * background
        )
        torch.testing.assert_close(sigmas.grad, (jacobian * cotangent[:, None]).sum(-1), rtol=1e-11, atol=1e-13)
        torch.testing.assert_close(colours.grad, parts.weights[..., None] * cotangent[:, None], rtol=1e-13, atol=0)
    assert torch.autograd.gradcheck(
        lambda s, c: pixel(s, deltas, c, background), (sigmas, colours), eps=1e-6, atol=1e-8, rtol=1e-6
    )


def test_packed_gradients_are_those_of_dense() -> None:
    """Rays of different length, one of them without samples; values and gradients of the same rays in dense form."""
    sigmas, deltas = random_rays(5, 8)
    counts = torch.tensor([8, 3, 0, 5, 1])
    used = torch.arange(8)[None] < counts[:, None]
    dense = (sigmas * used).requires_grad_()
    packed = sigmas[used].clone().requires_grad_()
    rays = torch.arange(5).repeat_interleave(counts)
    a, b = composite(dense, deltas), composite_packed(packed, deltas[used], rays, 5)
    values = torch.rand(5, 8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for mine, other in ((b.alphas, a.alphas), (b.trans, a.trans), (b.weights, a.weights)):
        torch.testing.assert_close(mine, other[used], rtol=1e-13, atol=1e-15)
    torch.testing.assert_close(b.trans_final, a.trans_final, rtol=1e-13, atol=0)
    assert float(b.trans_final[2].detach()) == 1
    colour_a = accumulate(a.weights, values) + a.trans_final[:, None]
    colour_b = accumulate(b.weights, values[used], rays, 5) + b.trans_final[:, None]
    torch.testing.assert_close(colour_b, colour_a, rtol=1e-13, atol=0)
    colour_a.square().sum().backward()
    colour_b.square().sum().backward()
    torch.testing.assert_close(packed.grad, dense.grad[used], rtol=1e-11, atol=1e-13)


def test_an_opaque_ray_does_not_blur_its_neighbours() -> None:
    """In packed float32 form all rays share one running sum: a huge segment must not cost others their digits."""
    sigmas = torch.tensor([1e30, 1e-3, 2e-3, 1e12, 3e-3])
    rays = torch.tensor([0, 1, 1, 2, 3])
    parts = composite_packed(sigmas, torch.ones(5), rays, 4)
    expected = torch.tensor([0.0, math.exp(-3e-3), 0.0, math.exp(-3e-3)])
    torch.testing.assert_close(parts.trans_final, expected, rtol=1e-6, atol=0)
    assert float(parts.trans[2]) == pytest.approx(math.exp(-1e-3), rel=1e-6)


@pytest.mark.parametrize(("where", "order"), [("left", 1.0), ("middle", 2.0)])
def test_order_of_convergence(where: str, order: float) -> None:
    """A smooth coefficient and colour: first order with left samples, second with midpoints (log-log regression)."""
    length = 2.0

    def sigma(t: torch.Tensor) -> torch.Tensor:
        return 1.5 + torch.sin(2 * t)

    def colour(n: int, shift: float) -> float:
        t = (torch.arange(n, dtype=torch.float64) + shift) * (length / n)
        source = torch.cos(t).square()[None, :, None]
        parts = composite(sigma(t)[None], torch.full((1, n), length / n, dtype=torch.float64))
        return float(accumulate(parts.weights, source)) + 0.25 * float(parts.trans_final)

    reference = colour(1 << 16, 0.5)
    counts = [16, 32, 64, 128, 256]
    errors = [abs(colour(n, 0.0 if where == "left" else 0.5) - reference) for n in counts]
    slope = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.1)


def test_median_depth_is_exact_inside_a_segment() -> None:
    t = torch.tensor([[0.0, 1.0, 2.0]], dtype=torch.float64)
    sigmas = torch.tensor([[0.1, 2.0, 1e9], [0.0, 0.0, 1e9], [0.0, 0.3, 0.2], [50.0, 0.0, 0.0]], dtype=torch.float64)
    depth = median_depth(sigmas, t.expand(4, 3), t.expand(4, 3) + 1)
    expected = [1 + (math.log(2) - 0.1) / 2, 2 + math.log(2) / 1e9, math.inf, math.log(2) / 50]
    np.testing.assert_allclose(depth, expected, rtol=1e-14)


def test_refuses_unsorted_rays_and_wrong_shapes() -> None:
    with pytest.raises(ValueError, match="sort the samples"):
        composite_packed(torch.ones(2), torch.ones(2), torch.tensor([1, 0]), 2)
    with pytest.raises(ValueError, match="n_samples"):
        composite_packed(torch.ones(2, 2), torch.ones(2, 2), torch.tensor([0, 1]), 2)
    with pytest.raises(ValueError, match="n_rays"):
        accumulate(torch.ones(2), torch.ones(2, 1), torch.tensor([0, 1]))
