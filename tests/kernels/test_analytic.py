"""Octrees of analytic fields: images and gradients approach the closed forms at the stated order in the voxel's side.

sigma is what is prescribed; vertices hold explin_inverse(sigma). Rays are cut at voxels and sampled at midpoints, so
for a smooth field the error of an optical depth is second order in the side: trilinear interpolation, midpoint rule.
"""

import numpy as np
import pytest
import torch
from scipy.special import erf

from nerfvol.kernels import on_torch, ops
from nerfvol.octree.rows import explin_inverse
from nerfvol.octree.tree import Octree
from tests.fixtures.gradients import assert_order
from tests.fixtures.random_octrees import unit

LEVELS = (3, 4, 5)
SIDES = [2.0 / 2**level for level in LEVELS]


def grid(level: int, sigma, density_scale: float = 1.0) -> Octree:
    """Every cell of [-1, 1]^3 at this level; sigma(position) > 0 at the vertices."""
    cells = np.stack(np.meshgrid(*[np.arange(1 << level)] * 3, indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(len(cells), level), cells, (-1, -1, -1), 2.0, 0, density_scale)
    octree.density = explin_inverse(sigma(octree.vertex_positions()) / density_scale)
    return octree


def through_the_cube(n: int = 24, tilt: float = 0.35) -> tuple[np.ndarray, np.ndarray]:
    """Rays that cross the two faces at x = -1 and 1 and no other, from x = -2."""
    rng = np.random.default_rng(5)
    o = np.column_stack([np.full(n, -2.0), rng.uniform(-0.2, 0.2, (n, 2))])
    d = np.column_stack([np.ones(n), rng.uniform(-tilt, tilt, (n, 2)) * 0.6])
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def optical_depth(octree: Octree, o, d, dtype=torch.float64) -> np.ndarray:
    values = torch.from_numpy(octree.values).to(dtype)
    with torch.no_grad():
        _, trans, _ = on_torch.render_values(octree, values, o.astype(np.float64), d, (0, 0, 0))
    return -np.log(trans.numpy().astype(np.float64))


def gaussian(x: np.ndarray) -> np.ndarray:
    return 0.05 + 3.0 * np.exp(-0.5 * ((x - [0.1, -0.05, 0.08]) ** 2).sum(-1) / 0.35**2)


def gaussian_depth(o, d) -> np.ndarray:
    """Closed form of the integral of the Gaussian along the ray's part in the cube, x from -1 to 1."""
    t0, t1 = (-1 - o[:, 0]) / d[:, 0], (1 - o[:, 0]) / d[:, 0]
    to_center = o - [0.1, -0.05, 0.08]
    b = (to_center * d).sum(1)
    nearest = (to_center**2).sum(1) - b * b
    s = 0.35 * np.sqrt(2)
    along = s * np.sqrt(np.pi) / 2 * (erf((t1 + b) / s) - erf((t0 + b) / s))
    return 0.05 * (t1 - t0) + 3.0 * np.exp(-nearest / s**2) * along


def test_gaussian_converges_at_second_order():
    o, d = through_the_cube()
    exact = gaussian_depth(o, d)
    errors = [np.sqrt(np.mean((optical_depth(grid(level, gaussian), o, d) - exact) ** 2)) for level in LEVELS]
    assert_order(SIDES, errors, 2.0, 0.15)


def test_compiled_kernels_converge_to_the_gaussian_too(isa):
    """The same, as images: the error is the discretisation's until float32 shows (tau near 2: u x hits x few)."""
    o, d = through_the_cube()
    exact = gaussian_depth(o, d)
    errors = []
    for level in LEVELS:
        out = ops.render_rays(grid(level, gaussian), o, d, early_stop_eps=0.0, outputs=("opacity",))
        errors.append(np.sqrt(np.mean((out["opacity"] - (1 - np.exp(-exact))) ** 2)))
    assert errors[-1] > 2**-24 * 2**5 * 8, "finer than float32 can show: choose coarser levels"
    assert_order(SIDES, errors, 2.0, 0.15)


def test_a_linear_ramp_is_exact_on_any_octree(isa):
    """raw = sigma = a + b . x with values above 1: linear in the voxel, and the midpoint rule integrates it exactly.

    Values are multiples of 1/4: exact in float32. What remains is rounding, 64 segments of 8 u each at tau below 16.
    """
    slope = np.array([1.0, 0.5, -0.75])

    def ramp(x):
        return 4.0 + x @ slope

    octree = grid(2, ramp)
    rng = np.random.default_rng(0)
    for _ in range(2):
        octree, _ = octree.subdivide(rng.random(octree.n_leaves) < 0.3)
    assert np.array_equal(octree.density, ramp(octree.vertex_positions()))
    o, d = through_the_cube()
    t0, t1 = (-1 - o[:, 0]) / d[:, 0], (1 - o[:, 0]) / d[:, 0]
    expected = ramp(o + (t0 + t1)[:, None] / 2 * d) * (t1 - t0)
    assert np.abs(optical_depth(octree, o, d) - expected).max() < 1e-12
    trans = 1 - ops.render_rays(octree, o, d, early_stop_eps=0.0)["opacity"]
    bound = 2**-24 + np.exp(-expected) * 64 * 8 * 2**-24 * 16
    assert (np.abs(trans - np.exp(-expected)) < bound).all()


def test_a_solid_sphere_converges_at_first_order():
    """A step in density: a vertex is in or out, so the chord is known to a voxel. The error averaged over many chords
    falls with the side; a smooth field's second order would be a sign that the step was smoothed away."""
    radius = 0.7

    def ball(x):
        return np.where((x**2).sum(-1) < radius**2, 2.0, 1e-9)

    rng = np.random.default_rng(3)
    o, d = through_the_cube(600)
    o[:, 1:] += rng.uniform(-0.3, 0.3, (600, 2))
    d = unit(np.column_stack([np.ones(600), rng.uniform(-0.1, 0.1, (600, 2))])).astype(np.float64)
    b = (o * d).sum(1)
    chord = 2 * np.sqrt(np.maximum(b * b - (o**2).sum(1) + radius**2, 0))
    errors = [np.abs(optical_depth(grid(level, ball), o, d) - 2.0 * chord).mean() for level in LEVELS]
    assert_order(SIDES, errors, 1.0, 0.3)


def test_gradients_of_the_gaussian_scene_converge(isa):
    """d tau / d(amplitude) through the chain rule over all vertices: the kernel's gradient against the closed form.

    sigma(x) = A s(x) + b: with raw = explin_inverse(sigma), d raw / dA = s(x) / explin'(raw) at each vertex.
    """
    o, d = through_the_cube()
    exact = gaussian_depth(o, d)
    t0, t1 = (-1 - o[:, 0]) / d[:, 0], (1 - o[:, 0]) / d[:, 0]
    per_amplitude = (exact - 0.05 * (t1 - t0)) / 3.0
    truth = -np.exp(-exact) * per_amplitude
    chosen = range(0, len(o), 2)
    errors = []
    for level in LEVELS:
        octree = grid(level, gaussian)
        sigma = gaussian(octree.vertex_positions())
        by_amplitude = (sigma - 0.05) / 3.0 / np.where(sigma < 1, sigma, 1.0)  # explin' is sigma below 1
        values = torch.from_numpy(octree.values).requires_grad_()
        _, trans, _ = on_torch.render_values(octree, values, o, d.astype(np.float32), (0, 0, 0))
        gradients = [torch.autograd.grad(trans[i], values, retain_graph=True)[0][:, 12].numpy() for i in chosen]
        error = [g @ by_amplitude - truth[i] for i, g in zip(chosen, gradients, strict=True)]
        errors.append(np.sqrt(np.mean(np.square(error))))
    assert_order(SIDES, errors, 2.0, 0.2)


@pytest.mark.parametrize("sigma", [0.1, 2.0, 50.0])
def test_slab(isa, sigma):
    """T = exp(-sigma L) to rounding: 16 segments of 8 u, relative to tau."""
    octree = grid(4, lambda x: np.full(len(x), sigma), density_scale=0.5)
    o, d = through_the_cube()
    length = 2 / d[:, 0]
    out = ops.render_rays(octree, o, d, (0, 0, 0), 0.0)
    tau = sigma * length
    bound = 2**-24 + np.exp(-tau) * tau * 64 * 8 * 2**-24
    assert (np.abs(1 - out["opacity"] - np.exp(-tau)) < bound).all()
    assert np.abs(out["rgb"] - 0.5 * out["opacity"][:, None]).max() < 64 * 2**-24


@pytest.mark.parametrize("n_leaves", [31, 32, 63, 64, 127, 128])
def test_every_vertex_of_a_row_gets_its_gradient_once(isa, n_leaves):
    """A ray through the middle of a row of cells, dT / d(raw) = -T scale side / 8 for each cell that a vertex is of.

    The vertices' gradients are summed in ranges of equal size; these rows have just as many vertices as fill all ranges,
    or four more. raw = 1, where explin is 1 with slope 1. T is a product of n_leaves exponentials: 4 u each, and 16 u.
    """
    cells = np.column_stack([np.arange(n_leaves), np.full((n_leaves, 2), 5)])
    octree = Octree.from_leaves(np.full(n_leaves, 7), cells, (0, 0, 0), 1.0, 0, 1.5)
    octree.density = 1.0
    middle = 5.5 / 128
    ray = np.array([[-0.5, middle, middle]]), np.array([[1, 0, 0]], np.float32)
    values = torch.from_numpy(octree.values).requires_grad_()
    trans = on_torch.render_values(octree, values, *ray)[1]
    gradient = torch.autograd.grad(trans.sum(), values)[0].numpy()[:, 12]
    assert octree.n_vertices == 4 * (n_leaves + 1)
    cells_of_vertex = np.bincount(octree.corners.ravel())
    expected = -np.exp(-1.5 * n_leaves / 128) * 1.5 / 128 * cells_of_vertex / 8
    assert np.abs(gradient / expected - 1).max() < (4 * n_leaves + 16) * 2**-24
