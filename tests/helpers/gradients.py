"""Checks of derivatives and of convergence orders, for the tests; they have tests of their own.

A function under test takes tensors and returns a tensor or a tuple of tensors. It is probed through <v, f(x)> with
random cotangents v, never through a plain sum: a sum hides permuted and cancelling gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

Function = Callable[..., Tensor | Sequence[Tensor]]


def _outputs(function: Function, inputs: Sequence[Tensor]) -> list[Tensor]:
    out = function(*inputs)
    return [out] if isinstance(out, Tensor) else list(out)


def _cotangents(outputs: Sequence[Tensor], seed: int) -> list[Tensor]:
    """Standard normal, drawn in float64 so that one seed means the same numbers for every precision."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in outputs]


def gradients(function: Function, inputs: Sequence[Tensor], seed: int = 0) -> list[Tensor]:
    """d<v, f(x)>/dx for every input, v standard normal from the seed. Missing and non-finite gradients are failures."""
    leaves = [x.detach().clone().requires_grad_(True) for x in inputs]
    outputs = _outputs(function, leaves)
    if not any(out.requires_grad for out in outputs):
        raise AssertionError("no output depends on any input: the function is detached from its inputs")
    pairs = [(o, v.to(o.dtype)) for o, v in zip(outputs, _cotangents(outputs, seed), strict=True) if o.requires_grad]
    loss = sum((out * v).sum() for out, v in pairs)
    found = torch.autograd.grad(loss, leaves, allow_unused=True)
    for i, g in enumerate(found):
        if g is None:
            raise AssertionError(f"input {i} got no gradient: the function is detached from it")
        if not torch.isfinite(g).all():
            raise AssertionError(f"the gradient of input {i} has {int((~torch.isfinite(g)).sum())} non-finite entries")
        if g.shape != leaves[i].shape:
            raise AssertionError(f"the gradient of input {i} has shape {tuple(g.shape)}, not {tuple(leaves[i].shape)}")
    return list(found)


def assert_same_gradients(
    function: Function, reference: Function, inputs: Sequence[Tensor], *, rtol: float, seeds: Sequence[int] = (0, 1)
) -> None:
    """The function's values and gradients agree with those of a reference evaluated in float64.

    ``rtol`` bounds every entry's error relative to the largest entry of its tensor, the scale that accumulated rounding
    follows; state it as eps times a number of operations.
    """
    wide = [x.detach().double() for x in inputs]
    with torch.no_grad():
        values, truths = _outputs(function, inputs), _outputs(reference, wide)
    for i, (value, truth) in enumerate(zip(values, truths, strict=True)):
        _assert_close(value, truth, rtol, f"output {i}")
    for seed in seeds:
        ours, theirs = gradients(function, inputs, seed), gradients(reference, wide, seed)
        for i, (ours_i, theirs_i) in enumerate(zip(ours, theirs, strict=True)):
            _assert_close(ours_i, theirs_i, rtol, f"the gradient of input {i} (seed {seed})")


def _assert_close(value: Tensor, truth: Tensor, rtol: float, what: str) -> None:
    if value.shape != truth.shape:
        raise AssertionError(f"{what} has shape {tuple(value.shape)}, expected {tuple(truth.shape)}")
    if value.numel() == 0:
        return
    error = (value.detach().double() - truth.detach().double()).abs()
    scale = float(truth.detach().abs().max())
    worst = int(error.argmax())
    if not float(error.max()) <= rtol * scale:  # also fails for NaN
        raise AssertionError(
            f"{what} is off by {float(error.max()):.3g} at flat index {worst} "
            f"({float(value.flatten()[worst]):.9g}, expected {float(truth.flatten()[worst]):.9g}); "
            f"allowed {rtol:.3g} of {scale:.3g}"
        )


def assert_gradients_are_derivatives(
    function: Function,
    inputs: Sequence[Tensor],
    *,
    rtol: float = 1e-6,
    step: float = 1e-3,
    seed: int = 0,
    n_directions: int = 4,
) -> None:
    """Every input's gradient agrees with finite differences along random directions, in float64.

    Central differences with steps h, h/2 and h/4, extrapolated; their own error is estimated from the last two stages
    and added to the tolerance ``rtol`` x |gradient| x |direction|. A kink within the step is the caller's to avoid.
    """
    base = [x.detach().double() for x in inputs]
    analytic = gradients(function, base, seed)
    with torch.no_grad():
        cotangents = _cotangents(_outputs(function, base), seed)

    def loss(points: Sequence[Tensor]) -> float:
        with torch.no_grad():
            return float(sum((o * v).sum() for o, v in zip(_outputs(function, points), cotangents, strict=True)))

    generator = torch.Generator().manual_seed(seed + 1)
    for i, gradient in enumerate(analytic):
        for _ in range(n_directions):
            direction = torch.randn(base[i].shape, generator=generator, dtype=torch.float64)
            central = []
            for h in (step, step / 2, step / 4):
                ahead, behind = (loss([*base[:i], base[i] + s * h * direction, *base[i + 1 :]]) for s in (1, -1))
                central.append((ahead - behind) / (2 * h))
            rough = (4 * central[1] - central[0]) / 3
            fine = (4 * central[2] - central[1]) / 3
            slope = float((gradient * direction).sum())
            rounding = 16 * np.finfo(float).eps * abs(loss(base)) / step
            allowed = rtol * float(gradient.norm() * direction.norm()) + abs(fine - rough) + rounding
            if not abs(slope - fine) <= allowed:
                raise AssertionError(
                    f"input {i}: the gradient gives a slope of {slope:.9g}, finite differences {fine:.9g}; "
                    f"allowed difference {allowed:.3g}"
                )


def convergence_order(steps: Sequence[float], errors: Sequence[float]) -> tuple[float, float]:
    """The exponent p of error ~ step^p by least squares in log-log, and its standard error."""
    h, e = np.asarray(steps, dtype=float), np.asarray(errors, dtype=float)
    if len(h) < 3 or not ((h > 0) & (e > 0) & np.isfinite(e)).all():
        raise AssertionError(f"an order needs three or more positive errors, got {list(errors)}")
    x, y = np.log(h), np.log(e)
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    residual = y - y.mean() - slope * x
    return slope, float(np.sqrt(residual @ residual / (len(x) - 2) / (x @ x)))


def assert_order(steps: Sequence[float], errors: Sequence[float], expected: float, tolerance: float = 0.1) -> None:
    """The measured order is the expected one to within the tolerance, on a line straight enough to mean something."""
    order, uncertainty = convergence_order(steps, errors)
    if uncertainty > tolerance:
        raise AssertionError(f"the errors {list(errors)} follow no power of the step: {order:.2f} +- {uncertainty:.2f}")
    if not abs(order - expected) <= tolerance:
        raise AssertionError(f"expected order {expected:g}, measured {order:.3f} +- {uncertainty:.3f}")
