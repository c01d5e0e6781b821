"""Encodings: values against their definitions, gradients, interpolation, dense and hashed levels."""

import math

import pytest
import torch

from nerfvol.field.encodings import FrequencyEncoding, HashGrid


def test_frequencies_are_those_of_the_paper() -> None:
    """Includes p itself, then sin and cos of 2**k pi p: written out, element by element."""
    p = torch.tensor([[0.3, -0.7, 0.11]], dtype=torch.float64)
    encoding = FrequencyEncoding(10)
    out = encoding(p)[0]
    assert encoding.out_dim == out.numel() == 63
    expected = p[0].tolist()
    for k in range(10):
        expected += [math.sin(2**k * math.pi * v) for v in p[0].tolist()]
        expected += [math.cos(2**k * math.pi * v) for v in p[0].tolist()]
    torch.testing.assert_close(out, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12)
    assert FrequencyEncoding(4).out_dim == 27
    assert torch.equal(FrequencyEncoding(0)(p), p)


def grid(**kwargs: int) -> HashGrid:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        out = HashGrid(**kwargs).double()
        torch.nn.init.normal_(out.table)
    return out


def points(n: int) -> torch.Tensor:
    return torch.rand(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_levels_grow_geometrically_and_are_dense_where_they_fit() -> None:
    g = HashGrid(n_levels=5, n_features=2, log2_table=12, n_min=4, n_max=64)
    assert g.resolutions == [4, 8, 16, 32, 64]
    assert g.n_dense == 2  # 5**3 and 9**3 fit into 4096 entries, 17**3 = 4913 does not
    # Each level begins at a whole brick of 16 entries.
    assert g.table.shape == (128 + 736 + 3 * 4096, 2) and g.starts == [0, 128, 864, 4960, 9056]
    assert HashGrid(n_levels=1, n_min=7, n_max=7).resolutions == [7]


def test_a_dense_level_reproduces_a_trilinear_function() -> None:
    """Vertices that hold a trilinear function give that function everywhere: vertex order, weights, boundary."""
    g = grid(n_levels=1, n_features=1, log2_table=12, n_min=6, n_max=6)

    def f(p: torch.Tensor) -> torch.Tensor:
        x, y, z = p.unbind(-1)
        return 1 + 2 * x - 3 * y + 5 * z + x * y - 2 * y * z + 4 * x * y * z

    axis = torch.arange(7, dtype=torch.float64) / 6
    vertices = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    g.table.data[: len(vertices), 0] = f(vertices)
    p = torch.cat([points(200), vertices, torch.tensor([[-1.0, 0.5, 0.5], [2.0, 3.0, -4.0]], dtype=torch.float64)])
    torch.testing.assert_close(g(p)[:, 0], f(p.clamp(0, 1)), rtol=0, atol=1e-12)


def test_hashed_levels_match_the_definition() -> None:
    """Index and weights written out for one point at a time, with the 32-bit hash in Python integers."""
    g = grid(n_levels=4, n_features=3, log2_table=10, n_min=8, n_max=200)
    assert g.n_dense == 1
    p = points(20)
    expected = torch.zeros(20, g.out_dim, dtype=torch.float64)
    for i, point in enumerate(p.tolist()):
        for level, n in enumerate(g.resolutions):
            cell = [min(int(c * n), n - 1) for c in point]
            for o in range(8):
                bits = (o >> 2 & 1, o >> 1 & 1, o & 1)
                vertex = [c + b for c, b in zip(cell, bits, strict=True)]
                weight = math.prod(
                    (c * n - k) if b else 1 - (c * n - k) for c, k, b in zip(point, cell, bits, strict=True)
                )
                if level < g.n_dense:
                    entry = (vertex[0] * (n + 1) + vertex[1]) * (n + 1) + vertex[2]
                else:
                    x, y, z = vertex
                    mixed = (x // 2) ^ (y // 2 * 2654435761) ^ (z // 4 * 805459861)
                    entry = (mixed & 0xFFFFFFFF) % 64 * 16 + x % 2 * 8 + y % 2 * 4 + z % 4
                columns = slice(level * 3, level * 3 + 3)
                expected[i, columns] += weight * g.table.data[g.starts[level] + entry]
    torch.testing.assert_close(g(p).detach(), expected, rtol=0, atol=1e-12)


def test_continuous_across_cells() -> None:
    """A step of 1e-9 across a cell wall of any level changes the features by about as much, hashed or not."""
    g = grid(n_levels=4, n_features=2, log2_table=8, n_min=4, n_max=50)
    for n in g.resolutions:
        wall = torch.tensor([[1 / n, 0.37, 0.61], [0.2, 2 / n, 0.9], [0.4, 0.8, (n - 1) / n]], dtype=torch.float64)
        change = (g(wall + 1e-9) - g(wall - 1e-9)).detach().abs().max()
        # Slope of a level: differences of neighbouring entries (below 8) times its resolution, on three axes.
        assert float(change) < 2e-9 * 3 * 8 * max(g.resolutions)


def test_gradients() -> None:
    """Table and position, against finite differences; points away from cell walls, where it is not smooth."""
    g = grid(n_levels=3, n_features=2, log2_table=6, n_min=3, n_max=12)
    p = points(4).requires_grad_()
    table = g.table.data.clone().requires_grad_()

    def encode(values: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(g, {"table": values}, (where,))

    assert torch.autograd.gradcheck(encode, (table, p), eps=1e-7, atol=1e-6)


def test_repeated_entries_add_up() -> None:
    """Thousands of points in one cell: the gradient of an entry is the sum over all of them."""
    g = HashGrid(n_levels=2, n_features=2, log2_table=12, n_min=4, n_max=8)
    p = torch.full((5000, 3), 0.05)
    g(p).sum().backward()
    # Each of the 5000 float32 additions may round once.
    assert float(g.table.grad.sum()) == pytest.approx(5000 * 2 * 2, rel=5000 * torch.finfo(torch.float32).eps)
    assert int((g.table.grad != 0).any(-1).sum()) == 16


def test_refuses_impossible_levels() -> None:
    with pytest.raises(ValueError, match="n_levels"):
        HashGrid(n_levels=0)
    with pytest.raises(ValueError, match="n_min"):
        HashGrid(n_min=32, n_max=16)
