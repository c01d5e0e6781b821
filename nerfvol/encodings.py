"""Encodings of a position: Fourier features and a multiresolution hash grid, in plain torch.

Positions are in the unit ball of the encoding: [-1, 1]**3 for ``FrequencyEncoding``, [0, 1]**3 for ``HashGrid``.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

# Spatial hash of Teschner et al. 2003, as used by Mueller et al. 2022.
_PRIMES = (1, 2654435761, 805459861)


class FrequencyEncoding(nn.Module):
    """gamma(p) = (p, sin(2**k pi p), cos(2**k pi p)) for k = 0..n_frequencies-1 (Mildenhall et al. 2020, eq. 4)."""

    def __init__(self, n_frequencies: int, in_dim: int = 3) -> None:
        super().__init__()
        self.n_frequencies = n_frequencies
        self.out_dim = in_dim * (1 + 2 * n_frequencies)

    def forward(self, p: Tensor) -> Tensor:
        """(..., in_dim) -> (..., in_dim * (1 + 2 * n_frequencies)): p, then sines and cosines of each k."""
        scales = torch.pi * 2.0 ** torch.arange(self.n_frequencies, dtype=p.dtype)
        angles = p.unsqueeze(-2) * scales[:, None]
        waves = torch.stack([angles.sin(), angles.cos()], dim=-2)
        return torch.cat([p, waves.flatten(-3)], dim=-1)


class _TableLookup(torch.autograd.Function):
    """sum_c weights[i, c] * table[indices[i, c]], with a gradient for the table and for the weights.

    torch's own backward of ``embedding_bag`` sorts all indices: 60 ms for 65,000 x 8 of them on two cores, where one
    ``bincount`` a feature takes 1 ms and sums in a fixed order.
    """

    @staticmethod
    def forward(ctx, table: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(table, indices, weights)
        return functional.embedding_bag(indices, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
        table, indices, weights = ctx.saved_tensors
        grad_table = grad_weights = None
        if ctx.needs_input_grad[0]:
            flat = indices.reshape(-1)
            columns = [
                torch.bincount(flat, (weights * column[:, None]).reshape(-1), minlength=table.shape[0])
                for column in grad.unbind(-1)
            ]
            grad_table = torch.stack(columns, dim=-1).to(table.dtype)
        if ctx.needs_input_grad[2]:
            grad_weights = torch.einsum("icf,if->ic", table[indices], grad)
        return grad_table, None, grad_weights


class HashGrid(nn.Module):
    """Multiresolution grid of trilinearly interpolated features (Mueller et al. 2022).

    Level l has resolution N_l = floor(n_min * b**l), b = exp(ln(n_max / n_min) / (n_levels - 1)), and its vertices are
    stored densely where (N_l + 1)**3 fits into 2**log2_table entries; finer levels share the entries through a hash.

    Args:
        n_levels: number of levels (at least 1).
        n_features: features per entry.
        log2_table: largest number of entries of a level, as a power of two.
        n_min, n_max: resolution of the coarsest and of the finest level, in cells along an edge of the unit cube.
    """

    def __init__(
        self, n_levels: int = 8, n_features: int = 2, log2_table: int = 17, n_min: int = 16, n_max: int = 256
    ) -> None:
        super().__init__()
        if n_levels < 1 or n_max < n_min or n_min < 1:
            raise ValueError(f"need n_levels >= 1 and 1 <= n_min <= n_max, got {n_levels}, {n_min}, {n_max}")
        growth = math.log(n_max / n_min) / max(n_levels - 1, 1)
        # The tiny relative excess keeps an exact n_max from being rounded down to n_max - 1.
        self.resolutions = [int(n_min * math.exp(growth * level) * (1 + 1e-9)) for level in range(n_levels)]
        self.table_size = 1 << log2_table
        self.dense = [(n + 1) ** 3 <= self.table_size for n in self.resolutions]
        self.out_dim = n_levels * n_features
        sizes = [
            (n + 1) ** 3 if dense else self.table_size for n, dense in zip(self.resolutions, self.dense, strict=True)
        ]
        self.tables = nn.ParameterList(nn.Parameter(torch.empty(size, n_features)) for size in sizes)
        for table in self.tables:
            nn.init.uniform_(table, -1e-4, 1e-4)

    def corners(self, level: int, p: Tensor) -> tuple[Tensor, Tensor]:
        """Table entries and trilinear weights of the 8 vertices around each point, each (n, 8); p (n, 3) in [0, 1]."""
        n = self.resolutions[level]
        scaled = (p * n).clamp(0, n)
        cell = scaled.floor().clamp(max=n - 1)
        high = scaled - cell
        sides = torch.stack([1 - high, high], dim=-1)  # (n, 3, 2)
        weights = (sides[:, 0, :, None, None] * sides[:, 1, None, :, None] * sides[:, 2, None, None, :]).reshape(-1, 8)
        cell = cell.long()
        if self.dense[level]:
            strides = ((n + 1) ** 2, n + 1, 1)
            base = cell[:, 0] * strides[0] + cell[:, 1] * strides[1] + cell[:, 2]
            offsets = [x * strides[0] + y * strides[1] + z for x in (0, 1) for y in (0, 1) for z in (0, 1)]
            return base[:, None] + torch.tensor(offsets), weights
        hashed = [torch.stack([cell[:, i] * _PRIMES[i], (cell[:, i] + 1) * _PRIMES[i]], dim=-1) for i in range(3)]
        mixed = hashed[0][:, :, None, None] ^ hashed[1][:, None, :, None] ^ hashed[2][:, None, None, :]
        return (mixed & (self.table_size - 1)).reshape(-1, 8), weights

    def forward(self, p: Tensor) -> Tensor:
        """(n, 3) in [0, 1]**3 (outside is clamped) -> (n, n_levels * n_features), coarse level first."""
        features = [_TableLookup.apply(table, *self.corners(level, p)) for level, table in enumerate(self.tables)]
        return torch.cat(features, dim=-1)
