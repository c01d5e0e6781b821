"""The compiled kernels against the float64 reference, every build; bounds are derived in rounding.py."""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from nerfvol.kernels import on_torch, ops, reference
from nerfvol.kernels.state import OUTPUTS
from nerfvol.octree.rows import sh_slots
from nerfvol.octree.tree import Octree
from tests.fixtures.random_octrees import DYADIC, ODD, camera_tiles, lattice_rays, random_octree, scattered_rays, unit
from tests.kernels import rounding

BACKGROUND = (0.9, 0.2, -0.4)
KINDS = ["mixed", "full", "single", "sparse"]


def per_ray(rays_o: np.ndarray, n: int) -> np.ndarray:
    return rays_o if len(rays_o) == n else rays_o.repeat(64, 0)[:n]


@dataclass(frozen=True)
class Case:
    """An octree and rays by their recipe, so that what the reference says of them is worked out once for all builds."""

    kind: str
    degree: int
    seed: int
    frame: str = "dyadic"
    strength: float = 3.0
    rays: str = "camera"
    n: int = 6
    distance: tuple[float, float] = (0.8, 2.5)


@functools.cache
def build(case: Case) -> tuple[Octree, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(case.seed)
    octree = random_octree(case.kind, case.degree, rng, DYADIC if case.frame == "dyadic" else ODD, case.strength)
    if case.rays == "camera":
        return octree, *camera_tiles(octree, rng, case.n, case.distance)
    if case.rays == "scattered":
        return octree, *scattered_rays(octree, rng, case.n)
    return octree, *lattice_rays(octree, rng, case.n, octree.max_level)


@functools.cache
def traced(case: Case, eps: float = 0.0) -> rounding.Trace:
    octree, o, d = build(case)
    return rounding.trace(octree, per_ray(o, len(d)), d, eps)


@functools.cache
def truth_of(case: Case, eps: float = 0.0) -> dict[str, np.ndarray]:
    octree, o, d = build(case)
    return truth(octree, per_ray(o, len(d)), d, eps)


def truth(octree: Octree, rays_o, rays_d, eps: float = 0.0) -> dict[str, np.ndarray]:
    """The reference's images in float64; rays_o one a ray."""
    values = torch.from_numpy(octree.values).double()
    o, d = (torch.from_numpy(a).double() for a in (rays_o, rays_d))
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    with torch.no_grad():
        rgb, trans, depth = reference.render(octree, values, o, d, background, eps)
        samples = reference.sample(octree, values, o, d, eps)
        median = reference.median_depth(octree, samples, len(d))
        normal = reference.normals(octree, values, o, d, eps)
    out = {"rgb": rgb, "trans": trans, "depth": depth, "median_depth": median, "normal": normal}
    return {k: v.numpy() for k, v in out.items()}


def assert_within(name: str, ours: np.ndarray, theirs: np.ndarray, bound: np.ndarray) -> None:
    ours = np.asarray(ours, np.float64)
    assert np.isfinite(ours).all(), f"{name}: {(~np.isfinite(ours)).sum()} entries are not finite"
    excess = np.abs(ours - theirs) - bound
    worst = np.unravel_index(int(excess.argmax()), excess.shape)
    assert excess.max() <= 0, (
        f"{name}{list(worst)} is {ours[worst]:.9g}, expected {theirs[worst]:.9g} within {bound[worst]:.3g}; "
        f"{(excess > 0).sum()} of {excess.size} entries are too far off"
    )


def assert_images_agree(case: Case, eps: float = 0.0) -> rounding.Trace:
    octree, rays_o, rays_d = build(case)
    out = ops.render_rays(octree, rays_o, rays_d, BACKGROUND, eps)
    ours = dict(out)
    assert all(v.dtype == np.float32 for v in ours.values())
    theirs, t = truth_of(case, eps), traced(case, eps)
    steady = ~rounding.undecided(t, eps)
    assert steady.mean() > 0.95
    bounds = rounding.image_bounds(t, octree, BACKGROUND)
    ours["trans"] = 1 - ours.pop("opacity")
    for name, bound in bounds.items():
        assert_within(name, ours[name][steady], theirs[name][steady], bound[steady])
    median = steady & ~rounding.undecided(t, 0.5)
    bound = rounding.median_bound(t, theirs["median_depth"])
    assert_within("median_depth", ours["median_depth"][median], theirs["median_depth"][median], bound[median])
    return t


# ------------------------------------------------------------------ forward
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", KINDS)
def test_images_of_cameras(isa, kind, degree):
    """Tiles from outside and inside the cube; hundreds of the rays hit."""
    t = assert_images_agree(Case(kind, degree, 10 * degree + KINDS.index(kind), "odd" if degree % 2 else "dyadic"))
    assert (t.hits > (3 if kind in ("mixed", "full") else 0)).sum() > 60


def test_the_bounds_are_tight_enough_to_mean_something():
    """A test that allows everything tests nothing: values are of the order of 1."""
    case = Case("mixed", 3, 0)
    for name, bound in rounding.image_bounds(traced(case), build(case)[0], BACKGROUND).items():
        assert np.median(bound) < (1e-3 if name == "normal" else 3e-4), name


@pytest.mark.parametrize("n", [0, 1, 7, 63, 65, 130])
def test_any_number_of_rays_from_many_origins(isa, n):
    if n == 0:
        octree = build(Case("mixed", 1, 0))[0]
        out = ops.render_rays(octree, np.empty((0, 3)), np.empty((0, 3)))
        assert {k: tuple(v.shape) for k, v in out.items()} == {
            "rgb": (0, 3), "opacity": (0,), "depth": (0,), "median_depth": (0,), "normal": (0, 3),
        }  # fmt: skip
        return
    assert_images_agree(Case("mixed", 1, n, rays="scattered", n=n))


def test_origins_per_tile_and_per_ray_are_the_same(isa):
    rng = np.random.default_rng(4)
    octree = random_octree("mixed", 2, rng)
    o, d = camera_tiles(octree, rng, 3)
    d = d[:150]
    a, b = ops.render_rays(octree, o, d), ops.render_rays(octree, per_ray(o, 150), d)
    for name in a:
        assert np.array_equal(a[name], b[name]), name


@pytest.mark.parametrize("kind", KINDS)
def test_rays_along_faces_and_edges(isa, kind):
    """Everything dyadic: both sides compute the same half-open boxes exactly, whichever plane the ray lies in."""
    case = Case(kind, 1, 17, rays="lattice", n=320)
    octree, o, d = build(case)
    t = traced(case)
    assert (t.hits > 0).any() and not t.ghost.any() and not t.d_near.any()
    out = ops.render_rays(octree, o, d, BACKGROUND, 0.0)
    theirs, bounds = truth_of(case), rounding.image_bounds(t, octree, BACKGROUND)
    assert_within("rgb", out["rgb"], theirs["rgb"], bounds["rgb"])
    assert_within("trans", 1 - out["opacity"], theirs["trans"], bounds["trans"])
    assert_within("depth", out["depth"], theirs["depth"], bounds["depth"])


@functools.cache
def rows_in_planes():
    """An octree and 16 tiles: the middle row of seven, and the eighth alone with an origin of its own, in a plane."""
    rng = np.random.default_rng(19)
    octree = random_octree("mixed", 1, rng)
    finest = 2**octree.max_level
    rays_o, rays_d = [], []
    for tile in range(16):
        o = octree.origin + octree.size * rng.uniform(-0.5, 1.5, 3)
        o[1] = octree.origin[1] + octree.size * rng.integers(0, finest) / finest
        forward = octree.origin + octree.size * rng.uniform(0.3, 0.7, 3) - o
        forward = forward * [1, 0, 1] / np.hypot(forward[0], forward[2])
        up = np.array([0, 1, 0]) if tile % 2 else np.array([0, -1, 0])
        side, down = np.cross(forward, up), -up
        u, v = np.meshgrid((np.arange(8) - 3.5) * 0.02, np.append(np.arange(7) - 3, 0) * rng.choice([0.05, 0.2]))
        d = unit(forward + u[..., None] * side + v[..., None] * down).reshape(64, 3)
        o = np.where(np.arange(64)[:, None] < 56, o, o + 0.3 * side)
        rays_o.append(np.roll(o - octree.origin, tile % 3, 1) + octree.origin)
        rays_d.append(np.roll(d, tile % 3, 1))
    o, d = np.concatenate(rays_o).astype(np.float32), np.concatenate(rays_d)
    assert (d == 0).any(1).sum() == 2 * 8 * 16
    return octree, o, d, truth(octree, o, d), rounding.image_bounds(rounding.trace(octree, o, d), octree, BACKGROUND)


def test_tiles_with_a_row_in_a_plane_of_faces(isa):
    """A row that runs exactly in a plane between cells is at the edge of what it may meet, and crosses it at full length.

    What discards cells for a whole tile is tight there, since the tile's axis lies in the plane too.
    """
    octree, o, d, theirs, bounds = rows_in_planes()
    out = ops.render_rays(octree, o, d, BACKGROUND, 0.0)
    for name in ("rgb", "depth"):
        assert_within(name, out[name], theirs[name], bounds[name])


@pytest.mark.parametrize("widest", [60, 85, 110, 150, 180])
def test_any_64_rays_from_one_origin_are_correct(isa, widest):
    """Directions up to so many degrees from an axis, in no order, from inside the cube: no tile of a picture, no pyramid."""
    rng = np.random.default_rng(widest)
    octree = random_octree("full", 1, rng)
    o = (octree.origin + octree.size * rng.uniform(0.2, 0.8, (3, 3))).astype(np.float32)
    height = rng.uniform(np.cos(np.radians(widest)), 1, 192)
    around = rng.uniform(0, 2 * np.pi, 192)
    radius = np.sqrt(1 - height**2)
    d = unit(np.column_stack([radius * np.cos(around), height, radius * np.sin(around)]))
    out, theirs = ops.render_rays(octree, o, d, BACKGROUND, 0.0), truth(octree, per_ray(o, 192), d)
    bounds = rounding.image_bounds(rounding.trace(octree, per_ray(o, 192), d), octree, BACKGROUND)
    for name in ("rgb", "depth"):
        assert_within(name, out[name], theirs[name], bounds[name])


def test_a_ray_in_a_plane_of_faces_belongs_to_the_box_above(isa):
    """Two leaves side by side, the ray in their common face, then in the outer faces."""
    octree = Octree.from_leaves([1, 1], [[0, 0, 0], [0, 1, 0]], (0, 0, 0), 2.0, 0, 1.0)
    octree.density = 2.0
    o = np.array([[-1, 1, 0.5], [-1, 0, 0.5], [-1, 2, 0.5], [-1, 0.5, 0], [-1, 0.5, 1], [3, 1, 0.5]], np.float32)
    d = np.array([[1, 0, 0]] * 5 + [[-1, 0, 0]], np.float32)
    opacity = ops.render_rays(octree, o, d, BACKGROUND, 0.0, ("opacity",))["opacity"]
    expected = 1 - np.exp(-np.array([2, 2, 0, 2, 0, 2]))
    assert np.abs(opacity - expected).max() < 8 * rounding.U
    assert octree.query(o[[0, 1, 2]] + [1.5, 0, 0]).tolist() == [1, 0, -1]


def test_zero_length_and_grazing_hits(isa):
    """Rays along diagonals of faces and cells, from and through vertices: they touch many boxes in a point or an edge.

    The distances of the planes that meet there are equal numbers on both sides (same components, dyadic places), so a
    touch has no length for either, and ghosts are not to be excused.
    """
    octree = random_octree("full", 1, np.random.default_rng(3))
    vertices = octree.vertex_positions()[::2]
    diagonals = np.array([[1, 1, 1], [1, -1, 0], [0, 1, 1], [-1, 1, -1], [1, 0, 1]], float)
    o = np.concatenate([vertices - 0.25 * k * d for d in diagonals for k in (0, 4)]).astype(np.float32)
    d = unit(np.repeat(diagonals, 2 * len(vertices), 0))
    t = rounding.trace(octree, o, d)
    assert (t.hits > 0).sum() > 200 and (t.ghost > 0).sum() > 200
    t.ghost[:] = 0
    out = ops.render_rays(octree, o, d, BACKGROUND, 0.0)
    bounds, theirs = rounding.image_bounds(t, octree, BACKGROUND), truth(octree, o, d)
    for name in ("rgb", "depth"):
        assert_within(name, out[name], theirs[name], bounds[name])


def test_misses_see_the_background_and_nothing_else(isa):
    octree = random_octree("full", 3, np.random.default_rng(5))
    n = 200
    rng = np.random.default_rng(6)
    o = (octree.origin + octree.size * (0.5 + 2 * unit(rng.standard_normal((n, 3))))).astype(np.float32)
    d = unit(o - octree.origin - octree.size / 2)  # away from the cube
    out = ops.render_rays(octree, o, d, BACKGROUND, 0.0)
    assert (out["rgb"] == np.float32(BACKGROUND)).all()
    for name in ("opacity", "depth", "median_depth", "normal"):
        assert not out[name].any(), name


@pytest.mark.parametrize("strength", [1e-6, 1e2, 1e4, 1e8])
def test_thin_and_opaque_matter(isa, strength):
    """Optical depths from 1e-6 to 1e8 across the cube: no NaN, and thin matter keeps its relative precision."""
    case = Case("mixed", 1, 9, strength=strength, n=4)
    octree, o, d = build(case)
    out = ops.render_rays(octree, o, d, (0, 0, 0), 0.0)
    assert all(np.isfinite(v).all() for v in out.values())
    if strength > 1:
        assert_images_agree(case)
        return
    theirs = truth_of(case)
    colour = theirs["rgb"] - theirs["trans"][:, None] * BACKGROUND
    size = np.linalg.norm(colour, axis=1)
    hit = size > 1e-8
    error = np.linalg.norm(out["rgb"] - colour, axis=1)[hit] / size[hit]
    assert hit.sum() > 100 and np.median(error) < 1e-5


@pytest.mark.parametrize("eps", [1 / 255, 0.2])
def test_early_stop(isa, eps):
    """The same segments are dropped, and the promise holds: a colour moves by less than eps x its largest range."""
    case = Case("mixed", 1, 11, strength=20.0)
    octree, o, d = build(case)
    t, full, exact = assert_images_agree(case, eps), traced(case), truth_of(case)
    assert (exact["trans"] < 0.9 * eps).sum() > 50 and len(t.ray) < len(full.ray)
    stopped = ops.render_rays(octree, o, d, BACKGROUND, eps)
    # |C_stopped - C| = |sum of dropped w (c - background)| <= eps max|c - background|; the same for opacity.
    span = np.abs(full.colour[:, None] - np.array(BACKGROUND)).max()
    slack = rounding.image_bounds(full, octree, BACKGROUND)
    assert (np.abs(stopped["rgb"] - exact["rgb"]) <= eps * span + slack["rgb"]).all()
    assert (np.abs(1 - stopped["opacity"] - exact["trans"]) <= eps + slack["trans"]).all()


def test_outputs_on_request_are_the_same_numbers(isa):
    rng = np.random.default_rng(12)
    octree = random_octree("mixed", 2, rng)
    o, d = camera_tiles(octree, rng, 2)
    everything = ops.render_rays(octree, o, d, BACKGROUND)
    assert list(everything) == list(OUTPUTS)
    for name in OUTPUTS:
        alone = ops.render_rays(octree, o, d, BACKGROUND, outputs=(name,))
        assert list(alone) == [name] and np.array_equal(alone[name], everything[name])


# ------------------------------------------------------------------ backward
def kernel_gradient(octree: Octree, rays_o, rays_d, cotangents, eps=0.0) -> np.ndarray:
    values = torch.from_numpy(octree.values.copy()).requires_grad_()
    outputs = on_torch.render_values(octree, values, rays_o, rays_d, BACKGROUND, eps)
    total = sum((o * torch.as_tensor(c, dtype=torch.float32)).sum() for o, c in zip(outputs, cotangents, strict=True))
    return torch.autograd.grad(total, values)[0].numpy()


@functools.cache
def random_cotangents(case: Case, eps: float = 0.0) -> tuple[np.ndarray, ...]:
    """Standard normal float32 numbers; zero where rounding decides which segment is the ray's last."""
    n, rng = len(build(case)[2]), np.random.default_rng(case.seed + 1)
    decided = ~rounding.undecided(traced(case, eps), eps)
    draws = rng.standard_normal((n, 3)), rng.standard_normal(n), rng.standard_normal(n)
    return tuple((g.T * decided).T.astype(np.float32) for g in draws)


@functools.cache
def true_gradient(case: Case, eps: float = 0.0) -> np.ndarray:
    octree, rays_o, rays_d = build(case)
    values = torch.from_numpy(octree.values).double().requires_grad_()
    outputs = on_torch.render_values(octree, values, rays_o, rays_d, BACKGROUND, eps)
    pairs = zip(outputs, random_cotangents(case, eps), strict=True)
    total = sum((o * torch.from_numpy(c).double()).sum() for o, c in pairs)
    return torch.autograd.grad(total, values)[0].numpy()


def assert_gradients_agree(case: Case, eps: float = 0.0) -> None:
    octree, rays_o, rays_d = build(case)
    cotangents = random_cotangents(case, eps)
    ours, theirs = kernel_gradient(octree, rays_o, rays_d, cotangents, eps), true_gradient(case, eps)
    bound = rounding.output_gradient_bounds(traced(case, eps), octree, BACKGROUND, *cotangents)
    assert_within("gradient", ours, theirs, bound)
    # A test that allows everything tests nothing: on the whole the bound is small against the gradient.
    assert np.linalg.norm(bound) < 0.05 * np.linalg.norm(theirs)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_random_cotangents(isa, kind, degree):
    frame, seed = "dyadic" if degree % 2 else "odd", 100 + 10 * degree + KINDS.index(kind)
    assert_gradients_agree(Case(kind, degree, seed, frame, n=4, distance=(0.8, 1.5)))


def test_gradients_of_rays_from_many_origins(isa):
    assert_gradients_agree(Case("mixed", 2, 23, rays="scattered", n=100))


def test_gradients_along_faces_and_edges(isa):
    assert_gradients_agree(Case("mixed", 1, 29, rays="lattice", n=200))


def test_gradients_with_early_stop(isa):
    assert_gradients_agree(Case("mixed", 1, 31, strength=20.0, n=4), 0.1)


@pytest.mark.parametrize("degree", range(4))
def test_every_vertex_that_a_ray_touches_gets_a_gradient_and_no_other(isa, degree):
    case = Case("mixed", degree, 37 + degree, n=5)
    octree, o, d = build(case)
    rng = np.random.default_rng(0)
    gradient = kernel_gradient(octree, o, d, [1 + rng.random((len(d), 3)), rng.random(len(d)), rng.random(len(d))])
    leaf = traced(case).leaf
    touched = np.zeros(octree.n_vertices, bool)
    touched[octree.corners[leaf]] = True
    assert 0 < touched.sum() < octree.n_vertices
    slots = [*sh_slots(degree).ravel(), 12]
    assert (gradient[touched][:, slots] != 0).all()
    assert not gradient[~touched].any()
    spare = np.setdiff1d(np.arange(gradient.shape[1]), slots)
    assert not gradient[:, spare].any()


def test_opaque_matter_has_finite_gradients(isa):
    rng = np.random.default_rng(41)
    for strength in (1e-6, 1e4, 1e8):
        octree, o, d = build(Case("mixed", 1, 9, strength=strength, n=4))
        cotangents = [rng.standard_normal(shape) for shape in ((len(d), 3), len(d), len(d))]
        assert np.isfinite(kernel_gradient(octree, o, d, cotangents)).all()
