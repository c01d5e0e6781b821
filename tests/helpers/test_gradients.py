"""The derivative and convergence checks must let right functions pass and catch each kind of wrong one."""

import numpy as np
import pytest
import torch

from tests.helpers.gradients import (
    assert_gradients_are_derivatives,
    assert_order,
    assert_same_gradients,
    convergence_order,
    gradients,
)


class Scaled(torch.autograd.Function):
    """x^3 * y whose gradients are multiplied by given factors: the planted bugs."""

    @staticmethod
    def forward(ctx, x, y, factor_x, factor_y):
        ctx.save_for_backward(x, y)
        ctx.factors = factor_x, factor_y
        return x**3 * y

    @staticmethod
    def backward(ctx, grad):
        x, y = ctx.saved_tensors
        return ctx.factors[0] * grad * 3 * x**2 * y, ctx.factors[1] * grad * x**3, None, None


def inputs(n=7, dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)
    return [torch.rand(n, generator=generator, dtype=dtype) + 0.5 for _ in range(2)]


def planted(factor_x=1.0, factor_y=1.0):
    return lambda x, y: Scaled.apply(x, y, factor_x, factor_y)


def test_right_gradients_pass():
    assert_gradients_are_derivatives(planted(), inputs())
    assert_same_gradients(planted(), lambda x, y: x**3 * y, inputs(dtype=torch.float32), rtol=8 * 2.0**-23)


def test_gradients_of_several_outputs():
    assert_gradients_are_derivatives(lambda x, y: (torch.sin(x) * y, (x * y).sum()), inputs())


@pytest.mark.parametrize("factors", [(1.001, 1.0), (1.0, 0.0), (-1.0, 1.0), (1.0, 1.00001)])
def test_wrong_gradients_fail(factors):
    with pytest.raises(AssertionError, match="input [01]"):
        assert_gradients_are_derivatives(planted(*factors), inputs())
    with pytest.raises(AssertionError, match="gradient of input [01]"):
        assert_same_gradients(planted(*factors), lambda x, y: x**3 * y, inputs(), rtol=1e-6)


def test_a_permuted_gradient_fails_though_its_sum_is_right():
    class Flipped(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return 2 * x

        @staticmethod
        def backward(ctx, grad):
            return 2 * grad.flip(0)

    x = inputs()[0].requires_grad_(True)
    (flat,) = torch.autograd.grad(Flipped.apply(x).sum(), x)
    assert torch.equal(flat, torch.full_like(x, 2))  # a plain sum cannot see the bug
    with pytest.raises(AssertionError, match="input 0"):
        assert_gradients_are_derivatives(Flipped.apply, [x])


def test_a_wrong_value_fails():
    with pytest.raises(AssertionError, match="output 0"):
        assert_same_gradients(lambda x: 2 * x, lambda x: 2 * x + 1e-3, inputs()[:1], rtol=1e-6)


def test_missing_and_detached_gradients_fail():
    with pytest.raises(AssertionError, match="input 1 got no gradient"):
        gradients(lambda x, y: x * y.detach(), inputs())
    with pytest.raises(AssertionError, match="no output depends"):
        gradients(lambda x, y: (x * y).detach(), inputs())


def test_non_finite_gradients_fail():
    with pytest.raises(AssertionError, match="1 non-finite"):
        gradients(lambda x: torch.sqrt(x), [torch.tensor([0.0, 1.0])])


@pytest.mark.parametrize("order", [1, 2, 4])
def test_orders_of_differences_are_measured(order):
    stencil = {
        1: lambda h: (np.exp(h) - 1) / h,
        2: lambda h: (np.exp(h) - np.exp(-h)) / (2 * h),
        4: lambda h: (8 * (np.exp(h) - np.exp(-h)) - (np.exp(2 * h) - np.exp(-2 * h))) / (12 * h),
    }[order]
    steps = 0.1 * 0.5 ** np.arange(4)
    errors = [abs(stencil(h) - 1) for h in steps]
    assert_order(steps, errors, order)
    with pytest.raises(AssertionError, match="expected order"):
        assert_order(steps, errors, order + 1)


def test_errors_that_follow_no_power_fail():
    with pytest.raises(AssertionError, match="no power"):
        assert_order([1, 0.5, 0.25, 0.125], [1.0, 0.1, 0.4, 0.02], 2)
    with pytest.raises(AssertionError, match="positive errors"):
        convergence_order([1, 0.5, 0.25], [1.0, 0.5, 0.0])
