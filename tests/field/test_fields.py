"""Fields: the protocol, scale of the scene, activations, heads, networks as configured."""

import math

import pytest
import torch

from nerfvol import sh as spherical
from nerfvol.config.field import FieldShape
from nerfvol.errors import InputError
from nerfvol.field.fields import (
    ROWS,
    Domain,
    HashField,
    MLPField,
    NeuralField,
    RadianceField,
    make_field,
    truncated_exp,
)

DOMAIN = Domain((0.5, -1.0, 2.0), 1.5)
SMALL = {"width": 16, "depth": 2, "hash_levels": 3, "hash_log2_table": 8, "hash_min": 4, "hash_max": 16}


def inputs(n: int = 50, domain: Domain = DOMAIN) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    low, high = domain.aabb
    positions = low + (high - low) * torch.rand(n, 3, generator=generator)
    return positions, torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=-1)


@pytest.mark.parametrize("encoding", ["hash", "frequency"])
@pytest.mark.parametrize("head", ["sh", "rgb"])
@pytest.mark.parametrize("density", ["exp", "softplus"])
def test_protocol(encoding: str, head: str, density: str) -> None:
    field = make_field(DOMAIN, FieldShape(encoding=encoding, head=head, density=density, sh_degree=2, **SMALL), seed=3)
    assert isinstance(field, RadianceField)
    assert isinstance(field, HashField if encoding == "hash" else MLPField)
    positions, dirs = inputs()
    sigma, rgb = field(positions, dirs)
    assert sigma.shape == (50,) and rgb.shape == (50, 3) and bool((sigma >= 0).all())
    torch.testing.assert_close(field.density(positions), sigma)
    (sigma.sum() + rgb.square().sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None and bool((parameter.grad != 0).any()), name
    empty = field(positions[:0], dirs[:0])
    assert empty[0].shape == (0,) and empty[1].shape == (0, 3)


def test_sh_head_is_the_octrees_convention() -> None:
    """Colour = 1/2 + sum sh Y, not clamped: the coefficients alone give the colour."""
    field = make_field(DOMAIN, FieldShape(sh_degree=3, **SMALL))
    with torch.no_grad():
        field.head.weight.mul_(30)
    positions, dirs = inputs()
    sigma, coefficients = field.sh(positions)
    assert coefficients.shape == (50, 3, 16)
    rgb = field(positions, dirs)[1]
    torch.testing.assert_close(rgb, 0.5 + (coefficients * spherical.eval_basis(3, dirs)[:, None]).sum(-1))
    assert float(rgb.detach().min()) < 0 and float(rgb.detach().max()) > 1


def test_rgb_head_depends_on_the_view_and_stays_in_range() -> None:
    field = make_field(DOMAIN, FieldShape(head="rgb", **SMALL))
    with torch.no_grad():
        for layer in (field.colour[0], field.colour[2]):
            layer.weight.mul_(10)
    positions, dirs = inputs()
    sigma, rgb = field(positions, dirs)
    other_sigma, other_rgb = field(positions, -dirs)
    assert torch.equal(sigma, other_sigma)
    assert float((rgb - other_rgb).detach().abs().max()) > 1e-3
    assert float(rgb.detach().min()) >= 0 and float(rgb.detach().max()) <= 1
    with pytest.raises(ValueError, match="no SH"):
        field.sh(positions)


@pytest.mark.parametrize("encoding", ["hash", "frequency"])
def test_scale_of_the_scene(encoding: str) -> None:
    """The same scene in other units: sigma is per unit, so lengths times k give sigma over k; colours stay."""
    shape, k = FieldShape(encoding=encoding, **SMALL), 1000.0
    small = make_field(DOMAIN, shape, seed=1)
    large = make_field(Domain(tuple(k * c for c in DOMAIN.center), k * DOMAIN.half), shape, seed=1)
    positions, dirs = inputs()
    # The highest frequency, 2**9 pi, turns the rounding of a position (6e-8) into 1e-4 of a wave.
    torch.testing.assert_close(large(k * positions, dirs)[0] * k, small(positions, dirs)[0], rtol=2e-3, atol=0)
    torch.testing.assert_close(large(k * positions, dirs)[1], small(positions, dirs)[1], rtol=0, atol=2e-3)


def test_paper_network_has_the_papers_layers() -> None:
    """8 x 256, L = 10 / 4, the position again in layer 5 (counted from 0), a half-width colour layer."""
    shape = FieldShape(encoding="frequency", width=256, depth=8, skip=5, head="rgb", density="softplus")
    field = make_field(DOMAIN, shape)
    assert [layer.in_features for layer in field.trunk.layers] == [63, 256, 256, 256, 256, 256 + 63, 256, 256]
    assert all(layer.out_features == 256 for layer in field.trunk.layers)
    assert field.colour[0].in_features == 256 + 27 and field.colour[0].out_features == 128


def test_seed_decides_the_weights_and_nothing_else_moves() -> None:
    before = torch.get_rng_state()
    a, b, c = (make_field(DOMAIN, FieldShape(**SMALL), seed) for seed in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(p, q) for p, q in zip(a.parameters(), b.parameters(), strict=True))
    assert not torch.equal(a.head.weight, c.head.weight)


def test_truncated_exp_is_exp_and_never_overflows() -> None:
    x = torch.tensor([-100.0, -3.0, 0.0, 14.0, 60.0, 1e4], requires_grad=True)
    y = truncated_exp(x)
    torch.testing.assert_close(y[:5], x[:5].exp())
    y.backward(torch.ones_like(x))
    assert bool(y.isfinite().all())
    torch.testing.assert_close(x.grad, x.detach().clamp(max=15).exp())


def test_contraction() -> None:
    """Linear inside the inner cube, 2 - 1/x outside, onto [-1, 1] at the outermost; monotonic and continuous."""
    domain = Domain((1.0, 0.0, 0.0), 2.0, outer=8.0)
    scale = 1 / (2 - 1 / 8)
    t = torch.linspace(0, 16, 4001, dtype=torch.float64)
    points = torch.stack([1 + t, -t, torch.zeros_like(t)], dim=-1)
    out = domain.contract(points)
    expected = scale * torch.where(t <= 2, t / 2, 2 - 2 / t.clamp(min=1e-9))
    torch.testing.assert_close(out[:, 0], expected)
    torch.testing.assert_close(out[:, 1], -expected)
    assert bool((out[:, 0].diff() > 0).all()) and float(out[-1, 0]) == pytest.approx(1)
    low, high = domain.aabb
    assert low.tolist() == [-15, -16, -16] and high.tolist() == [17, 16, 16]
    bounded = Domain((0.0, 0.0, 0.0), 2.0)
    torch.testing.assert_close(bounded.contract(torch.tensor([[1.0, -2.0, 9.0]])), torch.tensor([[0.5, -1.0, 1.0]]))


@pytest.mark.parametrize(
    "change", [{"width": 0}, {"depth": 2, "skip": 2}, {"sh_degree": 4}, {"hash_min": 9, "hash_max": 8},
               {"hash_log2_table": 30}, {"n_frequencies": -1}]
)  # fmt: skip
def test_refuses_impossible_shapes(change: dict[str, int]) -> None:
    with pytest.raises(InputError):
        FieldShape(**change)


def test_autocast_returns_full_precision_results() -> None:
    field = make_field(DOMAIN, FieldShape(**SMALL))
    positions, dirs = inputs()
    exact = field(positions, dirs)
    with torch.autocast("cpu", torch.bfloat16):
        sigma, rgb = field(positions, dirs)
    assert sigma.dtype == rgb.dtype == torch.float32
    # bfloat16 keeps 8 bits: raw density of order 1 to a few times 2**-8.
    torch.testing.assert_close(sigma, exact[0], rtol=8 * 2**-8, atol=0)
    assert math.isclose(float(rgb.mean().detach()), float(exact[1].mean().detach()), abs_tol=0.02)


@pytest.mark.parametrize("encoding", ["hash", "frequency"])
@pytest.mark.parametrize("head", ["sh", "rgb"])
def test_networks_see_whole_rows(encoding: str, head: str) -> None:
    """Any number of points is filled up to a multiple of ROWS, which changes neither values nor gradients."""
    field = make_field(DOMAIN, FieldShape(encoding=encoding, head=head, **SMALL), seed=1).double()
    seen: list[int] = []
    field.trunk.register_forward_hook(lambda module, inputs, output: seen.append(len(output)))
    for n in (1, 50, ROWS, ROWS + 1):
        positions, dirs = (rows.double() for rows in inputs(n))
        for name in ("density", "forward") + (("sh",) if head == "sh" else ()):
            arguments = (positions, dirs) if name == "forward" else (positions,)
            gradients = []
            for method in (getattr(NeuralField, name), getattr(NeuralField, name).__wrapped__):
                seen.clear()
                results = method(field, *arguments)
                results = results if isinstance(results, tuple) else (results,)
                if method is getattr(NeuralField, name):
                    assert seen == [-(-n // ROWS) * ROWS]
                assert {len(rows) for rows in results} == {n}
                field.zero_grad()
                sum(rows.sin().sum() for rows in results).backward()
                gradients.append([rows.detach() for rows in results] + [
                    p.grad.clone() for p in field.parameters() if p.grad is not None
                ])  # fmt: skip
            for padded, plain in zip(*gradients, strict=True):
                torch.testing.assert_close(padded, plain, rtol=1e-9, atol=1e-9)
