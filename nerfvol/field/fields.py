"""Radiance fields: callables from positions and view directions to coefficient and colour.

All fields share one protocol, so sampling, compositing and distillation know no network. Positions are scene
coordinates; ``sigma`` is in 1/u of the scene; colour is 1/2 + sum_k sh_k Y_k(d) without a clamp where the head is SH
(``nerfvol.sh``), and in (0, 1) where it is a view-dependent network.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from nerfvol import sh as spherical
from nerfvol.config.field import FieldShape
from nerfvol.field.encodings import FrequencyEncoding, HashGrid
from nerfvol.field.layout import Domain


@runtime_checkable
class RadianceField(Protocol):
    """What every field offers."""

    def __call__(self, positions: Tensor, viewdirs: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 3) scene positions and (n, 3) unit directions -> sigma (n,) >= 0 in 1/u, rgb (n, 3)."""
        ...

    def density(self, positions: Tensor) -> Tensor:
        """(n, 3) -> sigma (n,)."""
        ...


class SHField(RadianceField, Protocol):
    """A field whose view dependence is spherical harmonics: it distils into an octree without sampling directions."""

    has_sh: bool
    sh_degree: int

    def sh(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 3) -> sigma (n,), sh (n, 3, (sh_degree + 1)**2)."""
        ...


ROWS = 2048
"""Networks are evaluated for a multiple of so many points. The library of matrix products (oneDNN) compiles and keeps code
for each new number of rows: points as many as the rays happen to have took 0.7 GB of it and a seventh of the time."""


def _in_whole_rows(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """``evaluate(field, *inputs)`` with inputs (n, 3) filled up to a multiple of ROWS, and results of n rows again."""

    @functools.wraps(evaluate)
    def padded(field: NeuralField, *inputs: Tensor) -> Any:
        n = len(inputs[0])
        if n % ROWS == 0:
            return evaluate(field, *inputs)
        out = evaluate(field, *(functional.pad(x, (0, 0, 0, -n % ROWS)) for x in inputs))
        return tuple(rows[:n] for rows in out) if isinstance(out, tuple) else out[:n]

    return padded


class AtPoints:
    """A field of torch in numpy, without gradients: ``nerfvol.field.layout.PointField``."""

    def __init__(self, field: RadianceField) -> None:
        self.field = field
        self.has_sh = bool(getattr(field, "has_sh", False))

    @torch.no_grad()
    def __call__(self, positions: np.ndarray, viewdirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3), (n, 3) unit -> sigma (n,) in 1/u, rgb (n, 3)."""
        sigma, rgb = self.field(torch.from_numpy(positions), torch.tensor(viewdirs))
        return sigma.numpy(), rgb.numpy()

    @torch.no_grad()
    def density(self, positions: np.ndarray) -> np.ndarray:
        """(n, 3) -> sigma (n,) in 1/u."""
        return self.field.density(torch.from_numpy(positions)).numpy()

    @torch.no_grad()
    def sh(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) -> sigma (n,), sh (n, 3, basis_dim), where ``has_sh``."""
        sigma, sh = cast(SHField, self.field).sh(torch.from_numpy(positions))
        return sigma.numpy(), sh.numpy()


class _TruncatedExp(torch.autograd.Function):
    """exp(x) whose gradient uses min(x, 15): a large value cannot overflow the step it causes."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x.clamp(max=80))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0] * torch.exp(ctx.saved_tensors[0].clamp(max=15))


def truncated_exp(x: Tensor) -> Tensor:
    """exp(x), finite for every finite float32 x, with gradient exp(min(x, 15))."""
    return _TruncatedExp.apply(x)


class _Trunk(nn.Module):
    """Fully connected ReLU layers; layer ``skip`` sees the input again."""

    def __init__(self, in_dim: int, width: int, depth: int, skip: int) -> None:
        super().__init__()
        self.skip = skip
        sizes = [in_dim] + [width] * (depth - 1)
        self.layers = nn.ModuleList(
            nn.Linear(size + (in_dim if skip and i == skip else 0), width) for i, size in enumerate(sizes)
        )

    def forward(self, x: Tensor) -> Tensor:
        h = x
        for i, layer in enumerate(self.layers):
            if self.skip and i == self.skip:
                h = torch.cat([h, x], dim=-1)
            h = functional.relu(layer(h))
        return h


class NeuralField(nn.Module):
    """Encoding, trunk and head as ``FieldShape`` says; the base of ``MLPField`` and ``HashField``.

    The optical thickness per edge of the inner cube, not per scene unit, comes out of the activation: a scene in
    millimetres and the same scene in metres train alike.
    """

    def __init__(self, domain: Domain, shape: FieldShape, encoding: FrequencyEncoding | HashGrid) -> None:
        super().__init__()
        self.domain, self.shape, self.encoding = domain, shape, encoding
        self.has_sh = shape.head == "sh"
        self.sh_degree = shape.sh_degree if self.has_sh else 0
        self.trunk = _Trunk(encoding.out_dim, shape.width, shape.depth, shape.skip)
        self.density_scale = 1 / (2 * domain.half)
        if shape.head == "sh":
            self.head = nn.Linear(shape.width, 1 + 3 * spherical.basis_dim(shape.sh_degree))
        else:
            self.head = nn.Linear(shape.width, 1 + shape.width)
            self.encode_dirs = FrequencyEncoding(shape.n_frequencies_dir)
            hidden = max(shape.width // 2, 16)
            self.colour = nn.Sequential(
                nn.Linear(shape.width + self.encode_dirs.out_dim, hidden), nn.ReLU(), nn.Linear(hidden, 3)
            )

    def encode(self, positions: Tensor) -> Tensor:
        """(n, 3) scene positions -> (n, encoding.out_dim)."""
        return self.encoding(self.domain.contract(positions))

    def _features(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        out = self.head(self.trunk(self.encode(positions)))
        return self._sigma(out[:, 0]), out[:, 1:]

    def _sigma(self, raw: Tensor) -> Tensor:
        raw = raw.float() if raw.dtype == torch.bfloat16 else raw
        raw = raw + self.shape.density_bias
        activated = truncated_exp(raw) if self.shape.density == "exp" else functional.softplus(raw)
        return activated * self.density_scale

    @_in_whole_rows
    def density(self, positions: Tensor) -> Tensor:
        """(n, 3) -> sigma (n,) in 1/u."""
        return self._features(positions)[0]

    @_in_whole_rows
    def sh(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 3) -> sigma (n,), sh (n, 3, basis_dim); ValueError unless the field has the SH head."""
        if self.shape.head != "sh":
            raise ValueError("this field has a view-dependent rgb head: it has no SH coefficients to give")
        sigma, flat = self._features(positions)
        return sigma, flat.reshape(len(flat), 3, spherical.basis_dim(self.sh_degree)).to(sigma.dtype)

    @_in_whole_rows
    def forward(self, positions: Tensor, viewdirs: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 3), (n, 3) unit -> sigma (n,) in 1/u, rgb (n, 3)."""
        if self.shape.head == "sh":
            sigma, sh = self.sh(positions)
            return sigma, spherical.eval_colour(sh, viewdirs)
        sigma, features = self._features(positions)
        rgb = self.colour(torch.cat([features, self.encode_dirs(viewdirs).to(features.dtype)], dim=-1))
        return sigma, torch.sigmoid(rgb).to(sigma.dtype)


class MLPField(NeuralField):
    """Frequency encoding and a fully connected trunk (Mildenhall et al. 2020)."""

    def __init__(self, domain: Domain, shape: FieldShape) -> None:
        super().__init__(domain, shape, FrequencyEncoding(shape.n_frequencies))


class HashField(NeuralField):
    """Multiresolution hash grid and a small trunk (Mueller et al. 2022)."""

    def __init__(self, domain: Domain, shape: FieldShape) -> None:
        grid = HashGrid(shape.hash_levels, shape.hash_features, shape.log2_table, shape.hash_min, shape.finest)
        super().__init__(domain, shape, grid)

    def encode(self, positions: Tensor) -> Tensor:
        """(n, 3) scene positions -> (n, encoding.out_dim)."""
        return self.encoding(self.domain.contract(positions) * 0.5 + 0.5)


def make_field(domain: Domain, shape: FieldShape, seed: int = 0) -> NeuralField:
    """The field that ``shape.encoding`` names, its weights drawn from ``seed`` alone, the global RNG left as it was.

    Raises:
        ValueError: there is no such encoding.
    """
    kinds = {"frequency": MLPField, "hash": HashField}
    if shape.encoding not in kinds:
        raise ValueError(f"encoding must be one of {sorted(kinds)}, got {shape.encoding!r}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return kinds[shape.encoding](domain, shape)
