"""Spherical harmonics: orthonormality, signs, rotation, projection of known functions."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerfvol import sh


def sphere_quadrature(n: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions (m, 3) and weights (m,): exact for polynomials of degree < 2 n on the sphere."""
    z, w = np.polynomial.legendre.leggauss(n)
    phi = 2 * np.pi * np.arange(2 * n) / (2 * n)
    z, phi = (a.reshape(-1) for a in np.meshgrid(z, phi, indexing="ij"))
    s = np.sqrt(1 - z * z)
    dirs = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
    return torch.from_numpy(dirs), torch.from_numpy(np.repeat(w, 2 * n) * 2 * np.pi / (2 * n))


@pytest.mark.parametrize("degree", range(5))
def test_orthonormal(degree: int) -> None:
    dirs, weights = sphere_quadrature()
    basis = sh.eval_basis(degree, dirs)
    gram = torch.einsum("n,ni,nj->ij", weights, basis, basis)
    torch.testing.assert_close(gram, torch.eye(sh.basis_dim(degree), dtype=torch.float64), rtol=0, atol=1e-13)


def test_order_and_signs() -> None:
    """The file conventions: band by band, m rising, and the signs that PlenOctree and 3DGS files carry."""
    x, y, z = d = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    expected = {
        0: 0.28209479177387814,
        1: -0.4886025119029199 * y, 2: 0.4886025119029199 * z, 3: -0.4886025119029199 * x,
        4: 1.0925484305920792 * x * y, 5: -1.0925484305920792 * y * z,
        6: 0.31539156525252005 * (2 * z * z - x * x - y * y),
        7: -1.0925484305920792 * x * z, 8: 0.5462742152960396 * (x * x - y * y),
        9: -0.5900435899266435 * y * (3 * x * x - y * y), 10: 2.890611442640554 * x * y * z,
        12: 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        15: -0.5900435899266435 * x * (x * x - 3 * y * y),
    }  # fmt: skip
    basis = sh.eval_basis(4, d)
    for k, value in expected.items():
        assert float(basis[k]) == pytest.approx(float(value), abs=1e-14), k


@pytest.mark.parametrize("band", range(5))
def test_band_energy_is_rotation_invariant(band: int) -> None:
    """The energy of a band of a rotated function is that of the function: it holds only for a complete band."""
    dirs, weights = sphere_quadrature()
    basis = sh.eval_basis(4, dirs)
    coefficients = torch.randn(25, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    rotation = torch.from_numpy(Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix())
    rotated = sh.eval_basis(4, dirs @ rotation.T) @ coefficients
    projected = torch.einsum("n,n,ni->i", weights, rotated, basis)
    own = slice(band * band, (band + 1) ** 2)
    assert float(projected[own].square().sum()) == pytest.approx(float(coefficients[own].square().sum()), rel=1e-12)


def test_addition_theorem() -> None:
    """sum_m Y_lm(a) Y_lm(b) = (2 l + 1) / (4 pi) P_l(a . b): every band has its full set of functions and scale."""
    generator = torch.Generator().manual_seed(2)
    a, b = torch.nn.functional.normalize(torch.randn(2, 50, 3, dtype=torch.float64, generator=generator), dim=-1)
    product = sh.eval_basis(4, a) * sh.eval_basis(4, b)
    cosine = (a * b).sum(-1).numpy()
    for band in range(5):
        legendre = np.polynomial.legendre.legval(cosine, [0] * band + [1])
        total = product[:, band * band : (band + 1) ** 2].sum(-1)
        np.testing.assert_allclose(total, (2 * band + 1) / (4 * math.pi) * legendre, atol=1e-14)


def test_projection_of_a_known_function() -> None:
    """max(cos, 0) about z: the textbook coefficients of the clamped cosine (Ramamoorthi and Hanrahan 2001)."""
    dirs, weights = sphere_quadrature(200)
    projected = torch.einsum("n,n,ni->i", weights, dirs[:, 2].clamp(min=0), sh.eval_basis(4, dirs))
    expected = torch.zeros(25, dtype=torch.float64)
    expected[0], expected[2] = math.sqrt(math.pi) / 2, math.sqrt(math.pi / 3)
    expected[6], expected[20] = math.sqrt(5 * math.pi) / 8, -math.sqrt(math.pi) / 16
    torch.testing.assert_close(projected, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_shape_and_colour(dtype: torch.dtype) -> None:
    dirs = torch.nn.functional.normalize(torch.randn(4, 5, 3, dtype=dtype), dim=-1)
    assert sh.eval_basis(2, dirs).shape == (4, 5, 9) and sh.eval_basis(2, dirs).dtype == dtype
    coefficients = torch.randn(4, 5, 3, 9, dtype=dtype)
    expected = 0.5 + torch.einsum("abck,abk->abc", coefficients, sh.eval_basis(2, dirs))
    torch.testing.assert_close(sh.eval_colour(coefficients, dirs), expected)
    grey = torch.zeros(1, 3, 1, dtype=dtype)
    assert torch.equal(sh.eval_colour(grey, dirs[0, :1]), torch.full((1, 3), 0.5, dtype=dtype))


def test_refuses_what_it_cannot_mean() -> None:
    for degree in (-1, 5):
        with pytest.raises(ValueError, match="0 to 4"):
            sh.eval_basis(degree, torch.zeros(1, 3))
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        sh.eval_basis(1, torch.zeros(1, 2))
    with pytest.raises(ValueError, match="degree"):
        sh.eval_colour(torch.zeros(1, 3, 5), torch.zeros(1, 3))
