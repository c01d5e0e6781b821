"""Single scattering on a grid: closed forms, the order of the deep shadow map, and its adjoint against finite differences."""

import math

import numpy as np
import pytest
import torch

from nerfvol.medium.lighting import Beam, Lobe
from nerfvol.medium.transport import Medium, at_points, depth_to_light, displayed, phase_function, receive

ISOTROPIC = (Lobe(0.0, 1.0),)
DIRECTIONS = [(0.6, 0.0, 0.8), (-0.2, 0.9, 0.4), (0.3, -0.9, -0.3), (-0.8, 0.1, 0.6), (0.0, 0.0, -1.0)]
"""Near every axis, from both sides."""


def unit(*v: float) -> tuple[float, float, float]:
    n = math.sqrt(sum(x * x for x in v))
    return v[0] / n, v[1] / n, v[2] / n


def blob(shape: tuple[int, int, int], lo=(-1.0, -1.2, -0.8), hi=(1.0, 1.0, 1.1)) -> Medium:
    """A Gaussian of 1/u that is almost nothing at the box's faces: amplitude 5, variance 0.04."""
    axes = [torch.linspace(a, b, n, dtype=torch.float64) for a, b, n in zip(lo, hi, shape, strict=True)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    sigma = 5 * torch.exp(-(x**2 + y**2 + z**2) / 0.08)
    albedo = torch.stack([0.9 + 0 * x, 0.5 + 0.3 * x, 0.4 + 0.3 * y * z]).clamp(0, 1)
    return Medium(sigma, albedo, torch.tensor(lo, dtype=torch.float64), torch.tensor(hi, dtype=torch.float64))


def depth_of_blob(points: np.ndarray, towards) -> np.ndarray:
    """Closed form: the integral of the Gaussian from ``points`` along ``towards``."""
    along = points @ np.array(towards)
    across = (points**2).sum(-1) - along**2
    tail = torch.special.erfc(torch.from_numpy(along / math.sqrt(0.08))).numpy()
    return 5 * np.exp(-across / 0.08) * math.sqrt(math.pi * 0.08) / 2 * tail


def places(medium: Medium) -> np.ndarray:
    axes = [
        np.linspace(float(a), float(b), n) for a, b, n in zip(medium.lo, medium.hi, medium.sigma_t.shape, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


@pytest.mark.parametrize("towards", DIRECTIONS)
def test_depth_to_light_is_of_second_order(towards):
    towards, errors = unit(*towards), []
    for n in (24, 47):  # half the distance of vertices
        medium = blob((n, n + 3, n - 2))
        found = depth_to_light(medium, towards).numpy()
        errors.append(np.abs(found - depth_of_blob(places(medium), towards)).max())
    # Linear interpolation across a plane errs by h^2 / 8 of the second derivative (at most 5 / 0.04) along each of two axes, on
    # the way into the columns and back; a column is sqrt(0.08 pi) of the Gaussian long.
    h = float(medium.voxel.max())
    assert errors[1] < 2 * 2 * h * h / 8 * (5 / 0.04) * math.sqrt(0.08 * math.pi)
    assert errors[0] / errors[1] > 3  # 4 in the limit


def test_homogeneous_slab_has_its_closed_form():
    """Sun behind the eye, above a slab: a f E integral of sigma exp(-2 sigma t) = a f E (1 - exp(-2 sigma)) / 2."""
    sigma, shape = 1.7, (5, 5, 9)
    ones = torch.ones(shape, dtype=torch.float64)
    albedo = torch.stack([0.2 * ones, 0.5 * ones, 0.9 * ones])
    medium = Medium(sigma * ones, albedo, torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    o = torch.tensor([[0.4, 0.5, 3.0]], dtype=torch.float64)
    d = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    beams, lobes = (Beam((0.0, 0.0, 1.0), (3.0, 2.0, 1.0)),), (Lobe(0.5, 0.25), Lobe(-0.3, 0.75))
    found = receive(medium, (o, d), beams, lobes, step=1 / 64)
    back = 0.25 * 0.75 / (4 * math.pi * 1.5**3) + 0.75 * 0.91 / (4 * math.pi * 0.7**3)  # HG at cos = -1
    expected = back * (1 - math.exp(-2 * sigma)) / 2 * np.array([3.0, 2.0, 1.0]) * [0.2, 0.5, 0.9]
    # midpoint rule: sigma^2 h^2 / 24 of each step's exponential
    np.testing.assert_allclose(found.radiance[0].numpy(), expected, rtol=(sigma / 64) ** 2)
    assert float(found.opacity[0]) == pytest.approx(1 - math.exp(-sigma), rel=1e-12)


def test_phase_function_is_normalised_and_forward():
    cosine = torch.from_numpy(np.polynomial.legendre.leggauss(64)[0])
    weights = np.polynomial.legendre.leggauss(64)[1]
    f = phase_function(cosine, (Lobe(0.6, 0.6), Lobe(-0.25, 0.4))).numpy()
    assert 2 * math.pi * (weights * f).sum() == pytest.approx(1, rel=1e-12)
    assert 2 * math.pi * (weights * f * cosine.numpy()).sum() == pytest.approx(0.6 * 0.6 - 0.25 * 0.4, rel=1e-12)


def test_points_are_linear_between_vertices_and_nothing_outside():
    medium = blob((4, 5, 6))
    points = torch.from_numpy(places(medium).reshape(-1, 3))
    found = at_points(medium.albedo, medium.lo, medium.hi, points)
    np.testing.assert_allclose(found.numpy(), medium.albedo.movedim(0, -1).reshape(-1, 3).numpy(), atol=1e-12)
    beyond = at_points(medium.albedo, medium.lo, medium.hi, medium.hi[None] + medium.voxel)
    assert not beyond.any()


def rays_through(medium: Medium, n: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    aim = 0.4 * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    o = 4 * torch.nn.functional.normalize(torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1)
    return o, torch.nn.functional.normalize(aim - o, dim=1)


def test_adjoint_against_finite_differences():
    """Of radiance and opacity of rays under two suns in the extinction and the albedo of every vertex, float64."""
    start = blob((5, 4, 6))
    # nothing thin or hidden: what is skipped there has no gradient (transport.THIN, HIDDEN)
    sigma = (0.3 * start.sigma_t + 0.2).requires_grad_()
    albedo = (0.8 * start.albedo + 0.1).requires_grad_()
    rays = rays_through(start, 6, 1)
    beams = (Beam(unit(0.6, 0.1, 0.8), (1.0, 2.0, 3.0)), Beam(unit(-0.3, -0.9, 0.2), (2.0, 1.0, 0.5)))

    def seen(sigma, albedo):
        out = receive(Medium(sigma, albedo, start.lo, start.hi), rays, beams, (Lobe(0.4, 1.0),), step=0.3)
        return out.radiance, out.opacity, out.depth, displayed(out, 2.0)

    assert torch.autograd.gradcheck(seen, (sigma, albedo), eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=True)


def test_shadow_has_a_gradient_of_its_own():
    """Density between sun and what is seen darkens it though no ray crosses it."""
    medium = blob((9, 9, 9), (-1.0,) * 3, (1.0, 1.0, 1.0))
    sigma = medium.sigma_t.clone().requires_grad_()
    o = torch.tensor([[-3.0, 0.0, 0.0]], dtype=torch.float64)
    d = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    out = receive(
        medium._replace(sigma_t=sigma), (o, d), (Beam((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)),), ISOTROPIC, step=0.1
    )
    out.radiance.sum().backward()
    assert sigma.grad is not None
    above, below = sigma.grad[4, 4, 6], sigma.grad[4, 4, 2]
    assert float(above) < -1e-4 and float(below) == 0


def test_light_of_two_suns_is_the_sum_of_each():
    medium, rays = blob((9, 9, 9)), rays_through(blob((9, 9, 9)), 16, 3)
    suns = Beam(unit(0.6, 0.1, 0.8), (1.0, 2.0, 3.0)), Beam(unit(-0.3, -0.9, 0.2), (2.0, 1.0, 0.5))
    both, first, second = (
        receive(medium, rays, beams, ISOTROPIC, 0.1).radiance for beams in (suns, suns[:1], suns[1:])
    )
    np.testing.assert_allclose(both.numpy(), (first + second).numpy(), rtol=1e-12)
    assert float(first[:, 0].max()) > 1e-3 and float(second[:, 0].max()) > 1e-3


def test_steps_converge():
    medium, beams = blob((17, 17, 17)), (Beam(unit(0.3, 0.5, 0.8), (1.0, 1.0, 1.0)),)
    rays = rays_through(medium, 32, 2)
    coarse, fine, finest = (receive(medium, rays, beams, ISOTROPIC, h).radiance for h in (0.08, 0.04, 0.005))
    first, second = (float((x - finest).abs().max()) for x in (coarse, fine))
    assert second < 0.01 * float(finest.max()) and second < 0.5 * first
