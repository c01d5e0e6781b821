"""The compiled field against its float64 twin: pictures, values, gradients of every shape, term and instruction set."""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from nerfvol.kernels import field_ops, field_reference
from nerfvol.kernels.field_ops import FieldLoss
from tests.kernels import fields
from tests.kernels.rounding import U

TERMS = {
    "squared": FieldLoss((0.2, 0.5, 0.9), early_stop_eps=0.0),
    "colour": FieldLoss((0.2, 0.5, 0.9), colour=1.0, early_stop_eps=0.0),
    "distortion": FieldLoss((0.2, 0.5, 0.9), distortion=1.0, early_stop_eps=0.0),
    "entropy": FieldLoss((0.2, 0.5, 0.9), entropy=1.0, early_stop_eps=0.0),
    "early stop": dataclasses.replace(fields.ALL_TERMS, early_stop_eps=0.2),
}


def rounding(shape, samples_of_a_ray: int) -> float:
    """Relative to the largest of its kind: a first-order bound on what float32 may change.

    A sum of n products is good to n u; a network's layers follow each other, forwards and backwards, and so do a ray's
    samples. A position is off by 4 u, which a grid of n cells (the last of its frequencies) makes 4 n u of a feature, and those
    of neighbours differ by up to twice the largest. Exponentials and the basis: 24 u.
    """
    layers = sum(layer.inputs + 4 for layer in field_reference.FieldState(fields.INSIDE, shape).layers)
    fineness = shape.hash_max if shape.encoding == "hash" else np.pi * 2**shape.n_frequencies
    return (2 * layers + 8 * fineness + 2 * samples_of_a_ray + 24) * U


@functools.cache
def case(name: str, outside: bool, terms: str):
    domain = fields.OUTSIDE if outside else fields.INSIDE
    state, batch, march = fields.field(fields.SHAPES[name], domain), fields.rays(37, domain), fields.everywhere(domain)
    options = TERMS.get(terms, fields.ALL_TERMS)
    return state, batch, march, options, field_reference.loss_gradient(state, batch, march, options)


def assert_gradients_agree(name: str, outside: bool = False, terms: str = "all") -> None:
    state, batch, march, options, (table, network, total) = case(name, outside, terms)
    ours = field_ops.loss_gradient(state, batch, march, options)
    tolerance = rounding(state.shape, len(march.edges))
    at = 0
    groups = [(ours[0], table.numpy())] if state.n_levels else []
    for layer in state.layers:
        for count in (layer.inputs * layer.outputs, layer.outputs):
            part = slice(at, at + count)
            groups.append((ours[1][part], network.numpy()[part]))
            at += count
    assert at == len(network)
    for mine, twin in groups:
        assert np.abs(twin).max() > 0
        assert np.abs(mine - twin).max() <= tolerance * np.abs(twin).max()
    assert ours[2].loss == pytest.approx(float(total), rel=tolerance)
    assert not state.table_gradient.any() and not state.network_gradient.any()


@pytest.mark.parametrize("name", fields.SHAPES)
def test_gradients_of_every_shape(isa, name):
    assert_gradients_agree(name)


@pytest.mark.parametrize("terms", TERMS)
def test_gradients_of_each_term(isa, terms):
    assert_gradients_agree("default", terms=terms)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_gradients_with_a_background(isa, name):
    assert_gradients_agree(name, outside=True)


@pytest.mark.parametrize("name", fields.SHAPES)
def test_values_at_points(isa, name):
    """Inside, on the faces, and outside of the region."""
    state = fields.field(fields.SHAPES[name], fields.OUTSIDE)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(203, 3)) * rng.choice([0.5, 3, 20], (203, 1))
    x[:3] = [[1.7, -1.6, 1.8], [9.2, 8.9, 9.3], [0.2, -0.1, 0.3]]
    d = rng.normal(size=x.shape)
    x, d = x.astype(np.float32), (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    twin = field_reference.as_field(state)
    with torch.no_grad():
        points, dirs = torch.from_numpy(x).double(), torch.from_numpy(d).double()
        sigma, values = twin.sh(points) if twin.has_sh else twin(points, dirs)
    ours_sigma, ours = field_ops.evaluate(state, x, d)
    tolerance = rounding(state.shape, 0)
    assert ours.shape == tuple(values.shape)
    # sigma is an exponential: the error of the raw density, of the order of the largest, is relative to it.
    largest = max(1.0, float(sigma.log().abs().max())) if state.shape.density == "exp" else 1.0
    scale = sigma.numpy() if state.shape.density == "exp" else float(sigma.max())
    assert np.abs(ours_sigma - sigma.numpy()).max(initial=0, where=sigma.numpy() > 0) <= np.max(
        tolerance * largest * scale
    )
    assert np.abs(ours - values.numpy()).max() <= tolerance * max(1.0, float(values.abs().max()))
    assert np.array_equal(field_ops.evaluate(state, x, values=False)[0], ours_sigma)


@pytest.mark.parametrize("name", ["default", "rgb"])
@pytest.mark.parametrize("eps", [0.0, 0.05])
def test_pictures(isa, name, eps):
    state, batch, march = fields.field(fields.SHAPES[name]), fields.rays(70), fields.everywhere()
    batch = dataclasses.replace(batch, jitter=np.full(70, 0.5, np.float32))
    with torch.no_grad():
        samples = field_reference.march_rays(state, batch, march)
        drawn = field_reference.draw(field_reference.as_field(state), batch, samples, (0.2, 0.5, 0.9), eps)
    ours = field_ops.render_rays(state, batch.rays_o, batch.rays_d, march, (0.2, 0.5, 0.9), eps)
    middle = (drawn.samples.t_starts + drawn.samples.t_ends) / 2
    depth = torch.zeros(70, dtype=torch.float64).index_add(0, drawn.samples.ray_indices, drawn.weights * middle)
    tolerance = rounding(state.shape, len(march.edges))
    expected = {"rgb": drawn.colour, "opacity": 1 - drawn.trans, "depth": depth}
    for key, image in expected.items():
        assert np.abs(ours[key] - image.numpy()).max() <= tolerance * max(1, float(image.abs().max())), key


@pytest.mark.parametrize("name", ["degree 2", "rgb", "deep with skip", "paper"])
def test_the_twin_against_central_differences(name):
    """Along random directions in the table and in the network; hidden units near zero have a kink there."""
    state, batch, march = fields.field(fields.SHAPES[name]), fields.rays(9), fields.everywhere(n_steps=16)
    twin = field_reference.as_field(state)
    samples = field_reference.march_rays(state, batch, march)
    options = dataclasses.replace(fields.ALL_TERMS, early_stop_eps=0.0)
    parameters = list(twin.parameters())
    total, _ = field_reference.loss(twin, batch, samples, options)
    grads = torch.autograd.grad(total, parameters)
    rng = np.random.default_rng(3)
    h = 1e-7
    for parameter, grad in zip(parameters, grads, strict=True):
        direction = torch.from_numpy(rng.normal(size=tuple(parameter.shape)))
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter += sign * h * direction
                ends.append(float(field_reference.loss(twin, batch, samples, options)[0]))
                parameter -= sign * h * direction
        expected = float((grad * direction).sum())
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(expected, rel=1e-4, abs=1e-7), parameter.shape


def test_a_state_is_a_torch_field_and_back():
    for shape in fields.SHAPES.values():
        state = fields.field(shape)
        again = field_reference.from_field(field_reference.as_field(state, torch.float32))
        assert np.array_equal(again.table, state.table) and np.array_equal(again.network, state.network)
