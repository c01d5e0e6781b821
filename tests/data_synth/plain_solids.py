"""Level sets in plain Python (NUMBA_DISABLE_JIT=1): hits and normals against closed forms, and what a VDB grid encloses."""

from typing import Any

import numba
import numpy as np
import pytest

from data_synth import Camera, InputError, Path, lights, look_at, materials, media, surfaces
from data_synth.crossings import collected, first_root, hit_level_set, within
from data_synth.level_sets import extent_of, holds, of_tree, sampled
from data_synth.scene import Scene
from data_synth.vdb_tree import Reader, Tree
from tests.fixtures.hypothesis_tests import assert_means

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
ROUNDING = 2.0**-23  # of the samples


def test_nothing_here_is_compiled():
    assert numba.config.DISABLE_JIT  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def grid(n, reach, centre=(0.0, 0.0, 0.0)):
    axes = [c + np.linspace(-reach, reach, n) for c in centre]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), 2 * reach / (n - 1)


def ball(n=33, reach=1.3, radius=1.0, by=1.0, at=(0.0, 0.0, 0.0), material=0):
    """(level set of a sphere whose sizes are times ``by``, about ``at``; its spacing)."""
    p, h = grid(n, reach)
    lo, hi = np.array(at) - by * reach, np.array(at) + by * reach
    return sampled(material, by * (np.linalg.norm(p, axis=-1) - radius), lo, hi), by * h


def rays(n, reach, seed=0, start=3.0):
    """n rays from around towards points within ``reach``: some of them miss."""
    rng = np.random.default_rng(seed)
    o, p = rng.normal(size=(2, n, 3))
    o *= start / np.linalg.norm(o, axis=1, keepdims=True)
    p *= reach * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(p, axis=1, keepdims=True)
    d = (p - o) / np.linalg.norm(p - o, axis=1, keepdims=True)
    return [(tuple(a), tuple(b)) for a, b in zip(o, d, strict=True)]


def trilinear_of(values, lo, h, p) -> Any:
    """By numpy, of an array."""
    at = (np.asarray(p) - lo) / h
    cell = np.clip(at.astype(int), 0, np.array(values.shape) - 2)
    w = at - cell
    return 0.0 + sum(
        values[tuple(np.moveaxis(cell + s, -1, 0))] * np.prod(np.where(s, w, 1 - w), axis=-1)
        for s in np.ndindex(2, 2, 2)
    )


@pytest.mark.parametrize("by, at", [(1.0, (0, 0, 0)), (1e-6, (0, 0, 0)), (1e6, (3e6, 0, -1e6))])
def test_a_sphere_is_hit_where_it_is(by, at):
    """Trilinear interpolation of a convex function lies above it, by h^2/8 of its second derivatives, 2/r, at the most: the
    solid shrinks by that and no more. A component of the gradient is off by h/2 times 1/r, and by what 3/r^2 of higher ones
    adds."""
    solid, h = ball(by=by, at=at)
    levels, radius = collected([solid]), by
    nearest = radius - 2 * h  # a cell that the surface crosses reaches no further in
    shrinks, turns = h * h / 4 / nearest, np.sqrt(3) * (h / 2 / nearest + 3 * h * h / 8 / nearest**2)
    hits = 0
    for o, d in rays(80, 1.1):
        o = tuple(np.array(at) + by * np.array(o))
        t, n = hit_level_set(levels, 0, (o, d), np.inf)
        p = np.array(o) + t * np.array(d) - at
        missed = np.linalg.norm(np.cross(np.array(o) - at, d))
        if missed > radius:
            assert t == np.inf
        if missed < radius - shrinks - 1e-9 * by:
            hits += 1
            rounding = 4 * ROUNDING * radius
            assert radius - shrinks - rounding <= np.linalg.norm(p) <= radius + rounding
            assert np.dot(n, p) / np.linalg.norm(p) > np.cos(turns) and np.dot(n, d) < 0
            back, m = hit_level_set(levels, 0, (tuple(p + at), d), np.inf)
            assert back > 0 and np.dot(m, d) > 0  # the same ray leaves again
            assert hit_level_set(levels, 0, (o, d), t * (1 - 1e-12))[0] == t * (1 - 1e-12)
    assert hits > 50


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_stepped_over(seed):
    """Noise, crossed in most cells, some of them twice or thrice: no sign changes before the hit, the function is 0 there, the
    normal is its gradient. Cells overlap by 1e-9 of one (``traverse.cells``): by that a hit between two may be off."""
    rng = np.random.default_rng(seed)
    values = (rng.normal(size=(9, 10, 11)) + 0.3).astype(np.float32).astype(float)
    lo, h = np.array([-1.0, -1.2, -0.9]), np.array([0.25, 0.3, 0.2])
    hi = lo + h * (np.array(values.shape) - 1)
    solid = sampled(0, values, lo, hi)
    padded = np.pad(values, 1, constant_values=np.abs(values).max())
    f = lambda p: trilinear_of(padded, lo - h, h, p)  # noqa: E731
    for o, d in rays(60, 0.8, seed, start=0.9):
        t, n = hit_level_set(collected([solid]), 0, (o, d), 9.0)
        p = np.array(o) + t * np.array(d)
        if t == 9.0:
            continue
        assert abs(f(p)) < 2e-9 * 2 * abs(values).max()
        before = f(np.array(o) + np.linspace(1e-8, t - 2e-9, 400)[:, None] * np.array(d))
        after = f(p + 2e-9 * np.array(d))
        assert len(set(before < 0)) == 1 and (before[0] < 0) != (after < 0)
        e = 1e-6 * np.eye(3)
        g = np.array([f(p + s) - f(p - s) for s in e])
        at = (p - lo + h) / h
        if abs(at - np.rint(at)).min() > 1e-4:  # not across a face of the cell
            assert np.allclose(n, g / np.linalg.norm(g), atol=1e-4)
        assert np.dot(n, d) * (1 if before[0] < 0 else -1) > 0


@pytest.mark.parametrize("roots", [(-0.5, 0.2, 0.7), (-0.3, -0.3, 0.4), (-2.0, 0.1, 3.0), (-2.0, -1.5, 2.0)])
def test_the_first_root_of_a_cubic(roots):
    p = np.polynomial.polynomial.polyfromroots(roots)
    crossed = [r for r in roots if -1 < r < 1 and sum(q == r for q in roots) % 2]
    x, inside = first_root(tuple(p), -1.0)
    assert x == pytest.approx(crossed[0] if crossed else 2.0, abs=1e-12)
    assert inside == (np.polynomial.polynomial.polyval(min(x, 1.0) + 1e-6, p) < 0)
    assert first_root(tuple(p), 0.0 if p @ [1, -1, 1, -1] < 0 else 1.0)[0] == -1.0  # as the cell before says


def tree_of(values, background, first=(0, 0, 0)):
    """As OpenVDB keeps a dense array of whole blocks: a block of one value is a tile, below 0 or background."""
    tree = Tree.__new__(Tree)
    tree.r, tree.background, tree.channels = Reader(bytes(10**6), "x.vdb"), background, 1
    tree.boxes, tree.inside, tree.leaves, stored = [], [], [], []
    for b in np.ndindex(*(n // 8 for n in values.shape)):
        place = 8 * np.array(b)
        block = values[tuple(slice(a, a + 8) for a in place)]
        if (block == block[0, 0, 0]).all():
            if block[0, 0, 0] < 0:
                tree.inside.append(((place + first)[None], 8, block[:1, 0, 0]))
        else:
            tree.leaves.append(place + first)
            stored.append(block.ravel())
    tree.values = np.array(stored, np.float32).reshape(-1, 512)
    tree.active = abs(tree.values) < background
    return tree


@pytest.mark.parametrize("kind", ["ball", "shell", "box of tiles", "open"])
def test_a_grid_in_blocks_is_the_array(kind):
    """Leaves, tiles inside and the background: what encloses, and where it is hit, is as of the dense array of all of them."""
    p, _ = grid(56, 27.5)
    r = np.linalg.norm(p - (2.5, -1.0, 0.25), axis=-1)
    distance = {
        "ball": r - 22.3, "shell": abs(r - 18.0) - 1.7, "open": p[..., 0] + 0.2 * p[..., 1],
        "box of tiles": np.where((p > -12).all(-1) & (p < 20).all(-1), -3.0, 3.0),
    }[kind]  # fmt: skip
    values = np.clip(distance, -3, 3).astype(np.float32)
    first = np.array([-16, 8, 0])
    voxel, origin = np.array([0.5, 0.25, 1.0]), np.array([1.0, 2.0, 3.0])
    solid = of_tree(3, tree_of(values, 3.0, first), voxel, origin)
    lo = origin + voxel * first
    dense = sampled(3, values, lo, lo + voxel * 55)
    rng = np.random.default_rng(1)
    points = lo + voxel * rng.uniform(-12, 68, (3000, 3))
    assert (
        solid.material == 3
        and np.array_equal(holds(solid, points), holds(dense, points))
        and holds(solid, points).any()
    )
    a, b = collected([dense, solid]), extent_of(solid)
    assert np.allclose(b, extent_of(dense))
    for x in points[:60]:
        assert within(a, 1, tuple(x)) == holds(solid, x[None])[0]
    middle = lo + voxel * 27
    for o, d in zip(middle + rng.normal(size=(60, 3)) * 60, rng.normal(size=(60, 3)) * 5, strict=True):
        d = middle + d - o
        ray = (tuple(o), tuple(d / np.linalg.norm(d)))
        (t, n), (s, m) = (hit_level_set(a, k, ray, np.inf) for k in (0, 1))
        assert t == pytest.approx(s, rel=1e-9) and np.allclose(n, m, atol=1e-6)


def test_a_solid_on_the_lines_of_its_grid_is_closed():
    """A cube whose faces are samples of 0, as boxes come: rays through faces and edges go in and out, once each. Near an edge
    the function is a product of two: it is 0 to rounding within the square root of it, of a cell."""
    edge = 0.125 * 1e-16 ** (1 / 2)
    p, _ = grid(17, 1.0)
    solid = sampled(0, abs(p).max(axis=-1) - 0.5, (-1,) * 3, (1,) * 3)
    levels = collected([solid])
    for target in [(0, 0, 0), (0.25, 0.125, 0), (0.1, 0.3, -0.2)]:
        for o in [(3.0, 0, 0), (0, -3.0, 0), (0, 0.125, 3.0), (2.0, 2.0, 0.0), (1.9, 2.0, -2.1)]:
            d = np.array(target) - o
            d = d / np.linalg.norm(d)
            t, n = hit_level_set(levels, 0, (o, tuple(d)), np.inf)
            q = np.array(o) + t * d
            assert abs(abs(q).max() - 0.5) < edge and np.dot(n, d) < 0
            s, m = hit_level_set(levels, 0, (tuple(q), tuple(d)), np.inf)
            q = q + s * d
            assert abs(abs(q).max() - 0.5) < edge and np.dot(m, d) > 0
            assert hit_level_set(levels, 0, (tuple(q), tuple(d)), np.inf)[0] == np.inf


CAMERA = Camera(2, 2, 3.0, look_at((0.3, -3.0, 0.4), (0, 0, 0)))
SKY = np.array([0.7, 0.4, 0.2])


@pytest.mark.parametrize("material", [materials.lambert(1.0), materials.dielectric(1.4)])
def test_furnace(material):
    """A white or clear solid under an even sky is not seen."""
    solid, _ = ball(17)
    scene = Scene(level_sets=[solid], materials=[material], lights=[lights.environment(SKY)], opaque_sky=True)
    picture = Path(spp=40, jitter=False).render(scene, CAMERA)
    assert_means(picture.rgb, picture.variance, SKY * np.ones((2, 2, 1)))


def test_it_holds_a_medium():
    """1 - T of a chord of the sphere, from outside and from inside, alone and with a sphere in it that holds none."""
    solid, h = ball(33)
    sigma = np.array([0.4, 0.9, 1.7])
    fog = media.homogeneous((-2,) * 3, (2,) * 3, sigma, Le=np.ones(3))
    scene = Scene(medium=fog, level_sets=[solid], materials=[materials.null(0)], bounded=True)
    hole: dict[str, Any] = {
        "shapes": [surfaces.sphere(1, (0, 0, 0), 0.5)],
        "materials": [materials.null(0), materials.null(materials.CLEAR, priority=1)],
    }
    shrinks = 2 * h * h / 4 / (1 - 2 * h)
    for eye, chord, more in (((0, -4.0, 0), 2.0, {}), ((0, 0.2, 0), 0.8, {}), ((0, -4.0, 0), 1.0, hole)):
        for key, value in more.items():
            setattr(scene, key, value)
        picture = Path(spp=400, max_depth=0, jitter=False).render(scene, Camera(1, 1, 5.0, look_at(eye, (0, 9.0, 0))))
        want = 1 - np.exp(-chord * sigma)
        assert_means(picture.rgb, picture.variance, want, bias=1.7 * shrinks)


def test_arrays_that_enclose_nothing_or_are_no_distance():
    with pytest.raises(InputError, match="encloses nothing"):
        extent_of(sampled(0, np.ones((4, 4, 4)), (0,) * 3, (1,) * 3))
    for values, message in (
        (np.ones((4, 4)), "3D array"),
        (np.full((4, 4, 4), np.nan), "finite"),
        (np.ones((1, 4, 4)), "2 samples"),
    ):
        with pytest.raises(InputError, match=message):
            sampled(0, values, (0,) * 3, (1,) * 3)
    with pytest.raises(InputError, match="lo < hi"):
        sampled(0, np.ones((4, 4, 4)), (0,) * 3, (0,) * 3)
