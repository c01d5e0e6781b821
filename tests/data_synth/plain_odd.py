"""Odd parameters of march and of the textbook path tracer against quadrature, in plain Python (NUMBA_DISABLE_JIT=1).

The reference knows nothing of data_synth: solids are balls and boxes cut analytically by a line, later ones hold sway over
earlier ones, and light is single scattering of a sun and a lamp by Gauss-Legendre quadrature between the cuts.
"""

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
import pytest

from data_synth import Camera, Emission, March, Path, lights, look_at, materials, media, phase, scenes, surfaces
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means, assert_sample_mean

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
NODES, WEIGHTS = np.polynomial.legendre.leggauss(10)
PARTS = 2  # of each piece of the eye's ray
SIGMA, OTHER = np.array([0.3, 0.6, 1.2]), np.array([2.0, 0.2, 0.6])
COLOURS, DULL = (0.1, 0.9, 0.5), (1.0, 0.3, 0.7)
SUN = np.array([0.4, -0.8, 0.9]) / np.linalg.norm([0.4, -0.8, 0.9])
E, LAMP, INTENSITY = np.array([5.0, 4.0, 3.0]), np.array([1.6, -0.4, 1.3]), np.array([2.0, 3.0, 4.0])


class Zone(NamedTuple):
    """Where a line is inside, and what is there. rho: of points (n, 3); planes: along each axis, where rho has kinks."""

    cuts: Callable[[np.ndarray, np.ndarray], list[float]]
    sigma: np.ndarray
    albedo: np.ndarray
    g: float
    rho: Callable[[np.ndarray], np.ndarray] = lambda p: np.ones(len(p))
    planes: tuple[np.ndarray, ...] = ()


def ball(centre, radius):
    def cuts(o, d):
        b = d @ (o - np.array(centre))
        q = b * b - (o - np.array(centre)) @ (o - np.array(centre)) + radius**2
        return [-b - np.sqrt(q), -b + np.sqrt(q)] if q > 0 else []

    return cuts


def box(lo, hi):
    def cuts(o, d):
        with np.errstate(divide="ignore"):
            ends = np.sort([(np.array(lo) - o) / d, (np.array(hi) - o) / d], axis=0)
        return [ends[0].max(), ends[1].min()] if ends[0].max() < ends[1].min() else []

    return cuts


def pieces(zones, o, d, end):
    """(start, end, zone) along a line from o, in order."""
    spans = [zone.cuts(o, d) for zone in zones]
    cuts = {t for span in spans for t in span}
    for zone in zones:
        cuts |= {(x - o[k]) / d[k] for k, planes in enumerate(zone.planes) for x in planes if d[k] != 0}
    cuts = [0.0, *sorted(t for t in cuts if 0 < t < end), end]
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        inside = [z for z, span in zip(zones, spans, strict=True) if span and span[0] < 0.5 * (a + b) < span[1]]
        if inside and b - a > 1e-12 * end:
            yield a, b, inside[-1]


def thickness(zones, o, d, end):
    total = np.zeros(3)
    for a, b, zone in pieces(zones, o, d, end):
        t = 0.5 * (a + b) + 0.5 * (b - a) * NODES
        total += zone.sigma * 0.5 * (b - a) * (WEIGHTS @ zone.rho(o + t[:, None] * d))
    return total


def lobe(g, cosine):
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def single_scattering(zones, o, d, k, lamp):
    """(rgb, alpha, distance) of a ray in a scene k times as large."""
    L, alpha, far, before = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for start, end, zone in pieces(zones, o, d, 20 * k):
        for part in range(PARTS):
            a, b = (start + (end - start) * x / PARTS for x in (part, part + 1))
            t, w = 0.5 * (a + b) + 0.5 * (b - a) * NODES, 0.5 * (b - a) * WEIGHTS
            rho = zone.rho(o + t[:, None] * d)
            for x, share, density in zip(t, w, rho, strict=True):
                p, inner = o + x * d, a + 0.5 * (x - a) * (NODES + 1)
                own = zone.sigma * 0.5 * (x - a) * (WEIGHTS @ zone.rho(o + inner[:, None] * d))
                here = np.exp(-before - own) * zone.sigma * density * share
                alpha, far = alpha + here, far + here * x
                reach = np.linalg.norm(lamp - p)
                for wi, light, away in ((SUN, E, 20 * k), ((lamp - p) / reach, k**2 * INTENSITY / reach**2, reach)):
                    arrives = light * np.exp(-thickness(zones, p, wi, away))
                    L = L + here * zone.albedo * arrives * lobe(zone.g, d @ wi)
            before = before + zone.sigma * (w @ rho)
    return L, alpha.mean(), far.mean()


def trilinear(rho, lo, hi):
    """(density at points, planes of its cells)."""
    n, lo, hi = np.array(rho.shape), np.array(lo), np.array(hi)

    def density(p):
        u = np.clip((p - lo) / (hi - lo) * (n - 1), 0, n - 1)
        i = np.minimum(u.astype(int), n - 2)
        parts = [np.prod(np.where(c, u - i, 1 - (u - i)), -1) * rho[tuple((i + c).T)] for c in np.ndindex(2, 2, 2)]
        return np.sum(parts, axis=0)

    return density, tuple(np.linspace(lo[k], hi[k], n[k]) for k in range(3))


def check(scene, zones, eye, target, k=1.0, lamp=LAMP, step=0.04, rel=2e-3):
    """The march, to ``rel``, which belongs to its step, and the path tracer's mean, alpha and distance."""
    camera = Camera(1, 1, 50.0, look_at(tuple(k * np.array(eye)), tuple(k * np.array(target))))
    scene.lights = [lights.directional(SUN, E), lights.point(k * np.array(lamp), k * k * INTENSITY)]
    want = single_scattering(zones, camera.c2w[:3, 3], -camera.c2w[:3, 2], k, k * np.array(lamp))
    scene.medium = scene.medium._replace(step=step * k)
    scene.media = [m._replace(step=step * k) for m in scene.media]
    p = March().render(scene, camera)
    for found, true in zip((p.rgb[0, 0], p.alpha[0, 0], p.distance[0, 0]), want, strict=True):
        assert found == pytest.approx(true, rel=rel, abs=1e-12)
    runs = [Path(spp=10, max_depth=1, jitter=False, textbook=True).render(scene, camera, seed) for seed in range(20)]
    for name, true in zip(("rgb", "alpha", "distance"), want, strict=True):
        assert_sample_mean(np.array([getattr(run, name)[0, 0] for run in runs]), true, alpha=1e-5)


def test_nothing_here_is_compiled():
    assert numba.config.DISABLE_JIT  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


@pytest.mark.parametrize("k, g, albedo, eye", [
    (1e-3, 0.9, COLOURS, (0.3, -4.0, 0.4)), (1e3, -0.9, 1.0, (0.3, -4.0, 0.4)), (1.0, -0.9, COLOURS, (0.2, -0.3, 0.1)),
    (1.0, 0.9, 0.0, (0.2, -0.3, 0.1)),
])  # fmt: skip
def test_a_box_of_fog(k, g, albedo, eye):
    """Seen from without and from within."""
    m = media.homogeneous((-k,) * 3, (k,) * 3, SIGMA / k, albedo, phase=phase.henyey_greenstein(g))
    zone = Zone(box((-k,) * 3, (k,) * 3), SIGMA / k, np.broadcast_to(albedo, 3), g)
    check(Scene(medium=m), [zone], eye, (0.05, 0.1, 0.1) if eye[1] < -1 else (0.9, 0.8, 0.3), k)


BALLS = [((0.0, 0.0, 0.0), 0.9), ((0.1, 0.3, 0.0), 0.4)]


@pytest.mark.parametrize("eye, k, lamp", [
    ((0.1, -4.0, 0.2), 1e-3, LAMP), ((0.1, -0.5, 0.05), 1e3, LAMP), ((0.05, 0.35, 0.1), 1.0, LAMP),
    ((0.1, -4.0, 0.2), 1.0, (0.15, 0.4, 0.1)),
], ids=["outside", "between", "inside", "lamp inside"])  # fmt: skip
def test_a_ball_in_a_ball_of_another_medium(eye, k, lamp):
    """Whatever the order of the shapes; the inner one has the higher priority."""
    lo, hi = (-2 * k,) * 3, (2 * k,) * 3
    outer = media.homogeneous(lo, hi, SIGMA / k, COLOURS, phase=phase.henyey_greenstein(0.9))
    inner = media.homogeneous(lo, hi, OTHER / k, DULL, phase=phase.henyey_greenstein(-0.9))
    shapes = [surfaces.sphere(i, k * np.array(c), k * r) for i, (c, r) in enumerate(BALLS)]
    scene = Scene(
        medium=outer, media=[inner], bounded=True, materials=[materials.null(0, 0), materials.null(1, 1)],
        shapes=shapes[::-1] if eye[1] < -1 else shapes,
    )  # fmt: skip
    zones = [
        Zone(ball(k * np.array(c), k * r), sigma / k, np.array(albedo), g)
        for (c, r), sigma, albedo, g in zip(BALLS, (SIGMA, OTHER), (COLOURS, DULL), (0.9, -0.9), strict=True)
    ]
    check(scene, zones, eye, (0.1, 2.0, 0.15), k, lamp, step=0.02)


def test_three_boundaries_deep_and_the_first_medium_again():
    m = [media.homogeneous((-2,) * 3, (2,) * 3, s, 0.8, phase=phase.henyey_greenstein(0.5)) for s in (SIGMA, OTHER)]
    lo, hi = (-0.2, 0.0, -0.2), (0.3, 0.4, 0.2)
    scene = Scene(
        medium=m[0], media=[m[1]], bounded=True, materials=[materials.null(0, 2), materials.null(1, 1), materials.null(0, 0)],
        shapes=[surfaces.sphere(2, (0, 0, 0), 0.9), surfaces.sphere(1, (0.1, 0.2, 0), 0.6), surfaces.box(0, lo, hi)],
    )  # fmt: skip
    cuts = (ball((0, 0, 0), 0.9), ball((0.1, 0.2, 0), 0.6), box(lo, hi))
    zones = [Zone(c, s, np.full(3, 0.8), 0.5) for c, s in zip(cuts, (SIGMA, OTHER, SIGMA), strict=True)]
    check(scene, zones, (0.3, -4.0, 0.1), (0.1, 0.2, 0.02), step=0.02)


def line(shape, *places):
    rho = np.zeros(shape)
    rho[tuple(slice(None) if p is None else p for p in places)] = 4.0
    return rho


GRIDS = {
    "one voxel": np.random.default_rng(1).random((2, 2, 2)),
    "on a face of the box": line((6, 2, 3), 0, None, None),
    "on an edge of the box": line((4, 4, 2), 3, 0, None),
    "between two bricks": line((2, 11, 2), None, 8, None),
    "nothing": np.zeros((3, 4, 5)),
}


@pytest.mark.parametrize("name", GRIDS)
def test_a_grid_with_next_to_nothing_in_it(name):
    rho, lo, hi = GRIDS[name], (-1.0, -0.8, -0.6), (1.0, 1.0, 0.9)
    m = media.grid(rho, lo, hi, 2 * SIGMA, COLOURS, phase=phase.henyey_greenstein(0.9))
    zone = Zone(box(lo, hi), 2 * SIGMA, np.array(COLOURS), 0.9, *trilinear(rho, lo, hi))
    target = (0.9, -0.75, 0.05) if "edge" in name else (-0.95, 0.1, 0.15) if "face" in name else (0.05, 0.1, 0.15)
    check(Scene(medium=m), [zone], (2.3, -3.0, 0.9), target, step=0.03, rel=1e-2)


@pytest.mark.parametrize("ior", [0.6, 1.7])
def test_the_axis_of_a_ball_that_is_thinner_or_denser_than_air(ior):
    """Normal incidence: F + (1 - F)^2 T / (1 - F T) of a constant sky comes back along the axis, F in (n - 1)^2 / (n + 1)^2."""
    m = media.homogeneous((-2,) * 3, (2,) * 3, SIGMA)
    scene = Scene(
        medium=m, bounded=True, shapes=[surfaces.sphere(0, (0, 0, 0), 0.9)], materials=[materials.dielectric(ior)],
        lights=[lights.environment(1.0)], opaque_sky=True,
    )  # fmt: skip
    p = Path(spp=1000, jitter=False, textbook=True).render(scene, Camera(1, 1, 50.0, look_at((0, -3, 0), (0, 0, 0))))
    F, T = ((ior - 1) / (ior + 1)) ** 2, np.exp(-1.8 * SIGMA)
    assert_means(p.rgb, p.variance, F + (1 - F) ** 2 * T / (1 - F * T))


def test_bars_of_a_slab_have_their_closed_form_and_gaps_are_clear():
    scene = scenes.slab(sigma=2.0, height=1.0, bars=4)
    for x, z, length in ((-0.8, -0.4, 1.5), (-0.8, -0.2, 0.0), (0.7, 0.45, 1.5), (0.95, 0.0, 0.0)):
        picture = Emission().render(scene, Camera(1, 1, 50.0, look_at((x, -4.0, z), (x, 0.0, z))))
        want = 1 - np.exp(-length * np.array([2.0, 1.6, 1.0]))
        assert picture.rgb[0, 0] == pytest.approx(want * [0.9, 0.55, 0.25], abs=1e-9)
        assert picture.alpha[0, 0] == pytest.approx(want.mean(), abs=1e-9)
