"""Paths in plain Python (NUMBA_DISABLE_JIT=1): test_plain.py runs this file in a process of its own.

What is traced is the same source that numba compiles, without the minute that compiling takes, so that a bug in it can be
planted and seen in seconds. Scenes have second values: two lights of two strengths, albedos between 0 and 1, null boundaries.
"""

from typing import Any

import numba
import numpy as np
import pytest

from data_synth import Camera, Path, lights, look_at, materials, media, phase, surfaces
from data_synth.lights import hit_quad, quad_radiance, sample_light, sky_blend
from data_synth.materials import albedo_at, refracted
from data_synth.rng import new_rng
from data_synth.scene import Scene
from data_synth.world import inside_at, number_at
from tests.fixtures.hypothesis_tests import assert_histogram, assert_means

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
SKY = np.array([0.7, 0.4, 0.2])
DIM, BRIGHT = lights.directional((0.6, 0.0, 0.8), (1.0, 2.0, 3.0)), lights.directional((0.0, 0.0, 1.0), (5.0, 0.5, 0.1))


def test_nothing_here_is_compiled():
    assert numba.config.DISABLE_JIT  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def pixel(eye, target):
    return Camera(1, 1, 50.0, look_at(eye, target))


def seen(scene, camera, **path):
    picture = Path(jitter=False, **path).render(scene, camera)
    return picture.rgb, picture.variance


FLOOR: dict[str, Any] = {
    "shapes": [surfaces.plane(0, (0, 0, 0), (0, 0, 1))],
    "materials": [materials.lambert((0.9, 0.5, 0.2))],
}


@pytest.mark.parametrize("above", [False, True])
def test_two_suns_of_two_strengths_on_a_matt_floor(above):
    """albedo / pi times the sum of irradiances and cosines, also through a null boundary on the way."""
    scene = Scene(lights=[DIM, BRIGHT], **FLOOR)
    if above:
        scene.shapes = [*scene.shapes, surfaces.box(1, (-9, -9, 1), (9, 9, 2))]
        scene.materials = [*scene.materials, materials.null(materials.CLEAR)]
    want = np.array([0.9, 0.5, 0.2]) / np.pi * (0.8 * DIM[4:7] + BRIGHT[4:7])
    rgb, variance = seen(scene, pixel((0.5, -0.2, 0.5), (0, 0, 0)), spp=1500, max_depth=1)
    assert_means(rgb, variance, want)


@pytest.mark.parametrize("boundary", [materials.null(), materials.dielectric(1.0)])
def test_an_isothermal_furnace_behind_a_boundary(boundary):
    """A ball whose glow is as bright as the sky around it disappears, whatever its albedos; two skies share the brightness."""
    ball = media.homogeneous(
        (-1,) * 3,
        (1,) * 3,
        sigma_t=(1.0, 2.0, 0.5),
        albedo=(0.0, 0.5, 0.9),
        Le=SKY,
        phase=phase.two_lobes(0.6, -0.3, 0.7),
    )
    scene = Scene(medium=ball, bounded=True, opaque_sky=True, shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)],
                  materials=[boundary], lights=[lights.environment(0.25 * SKY), lights.environment(0.75 * SKY)])  # fmt: skip
    rgb, variance = seen(scene, pixel((0.1, -3.0, 0.2), (0.1, 0, 0.1)), spp=500)
    assert_means(rgb, variance, SKY)


def test_a_glow_is_weighted_by_what_absorbs():
    """(1 - albedo) Le (1 - exp(-tau)) of the light that is never scattered: no order of scattering is followed."""
    ball = media.homogeneous((-1,) * 3, (1,) * 3, sigma_t=0.4, albedo=(0.0, 0.5, 0.9), Le=SKY)
    scene = Scene(medium=ball, bounded=True, shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)], materials=[materials.null()])
    rgb, variance = seen(scene, pixel((0.0, -3.0, 0.0), (0, 0, 0)), spp=400, max_depth=0)
    want = (1 - np.array([0.0, 0.5, 0.9])) * SKY * (1 - np.exp(-0.4 * 1.6))
    assert_means(rgb, variance, want)


def test_a_lamp_shines_from_its_face_alone():
    """The radiance over the density of the direction, in front; nothing behind, where a clear one is not met at all."""
    for back, met in (("black", 0), ("clear", -1)):
        lamp = lights.quad((-1, -1, 2.0), (0, 2.0, 0), (2.0, 0, 0), SKY, back=back)[None]
        front, behind = (0.3, 0.2, 0.0), (0.3, 0.2, 3.0)
        for k in range(20):
            wi, r, value, pdf = sample_light(lamp, 0, front, new_rng(k, 0))
            p = np.array(front) + r * np.array(wi)
            assert p[2] == pytest.approx(2.0) and abs(p[:2]).max() <= 1.0
            assert pdf == pytest.approx(r * r / (4 * wi[2])) and np.allclose(np.array(value) * pdf, SKY)
            assert sample_light(lamp, 0, behind, new_rng(k, 0))[2] == (0.0, 0.0, 0.0)
        up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
        assert hit_quad(lamp, (front, up), 9.0) == (2.0, 0) and hit_quad(lamp, (front, up), 1.9)[1] == -1
        assert hit_quad(lamp, (behind, down), 9.0)[1] == met
        assert quad_radiance(lamp, 0, up) == tuple(SKY) and quad_radiance(lamp, 0, down) == (0.0, 0.0, 0.0)


def test_the_nearer_of_two_lamps_is_met():
    lamps = np.stack([lights.quad((-1, -1, z), (0, 2.0, 0), (2.0, 0, 0), z * SKY) for z in (2.0, 1.0, 3.0)])
    assert hit_quad(lamps, ((0.1, 0.2, 0.0), (0.0, 0.0, 1.0)), 9.0) == (1.0, 1)


def test_a_sky_of_three_colours():
    zenith, horizon, ground = (0.1, 0.2, 0.9), (0.8, 0.8, 0.8), (0.3, 0.2, 0.1)
    blends = [sky_blend(zenith, horizon, ground, z) for z in (1.0, 0.25, 0.0, -0.0625, -0.125, -1.0)]
    middle = [tuple(0.5 * (x + y) for x, y in zip(a, horizon, strict=True)) for a in (zenith, ground)]
    assert np.allclose(blends, [zenith, middle[0], horizon, middle[1], ground, ground])


@pytest.mark.parametrize("colours", [(1.0, 0.0, 0.0), (0.1, (0.9, 0.5, 0.2), 0.0)])
def test_a_matt_floor_under_two_skies(colours):
    """albedo / pi times the integral of (h + sqrt(z) (top - h)) z over the upper half: h + 4/5 (top - h), of both skies."""
    top, h = (np.broadcast_to(c, 3) for c in colours[:2])
    scene = Scene(lights=[lights.sky(*colours), lights.environment(0.3)], **FLOOR)
    rgb, variance = seen(scene, pixel((0.5, -0.2, 0.5), (0, 0, 0)), spp=3000, max_depth=1)
    assert_means(rgb, variance, np.array([0.9, 0.5, 0.2]) * (h + 0.8 * (top - h) + 0.3))


def test_directions_to_a_sky_are_even():
    """d_z and azimuth are even, whatever the sky: the density is 1 / 4 pi, as the balance heuristic takes it to be."""
    row, rng, n = lights.sky((0.1, 0.2, 0.9), 0.8, 0.0)[None], new_rng(3, 5), 4000
    drawn = [sample_light(row, 0, (0.0, 0.0, 0.0), rng) for _ in range(n)]
    x, y, z = np.array([d[0] for d in drawn]).T
    assert_histogram(np.histogram2d(z, np.arctan2(y, x), (8, 8), ((-1, 1), (-np.pi, np.pi)))[0], np.full(64, n / 64))
    for wi, distance, value, pdf in drawn[:50]:
        assert distance == np.inf and pdf == pytest.approx(0.25 / np.pi)
        assert np.allclose(np.array(value) * pdf, lights.sky_radiance(row[0], wi))


def test_alpha_of_a_coloured_ball_is_the_mean_of_its_opacities():
    ball = media.homogeneous((-1,) * 3, (1,) * 3, sigma_t=(0.2, 1.0, 3.0))
    scene = Scene(medium=ball, bounded=True, shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)], materials=[materials.null()],
                  lights=[lights.environment(1.0)])  # fmt: skip
    picture = Path(spp=300, jitter=False).render(scene, pixel((0.0, -3.0, 0.0), (0, 0, 0)))
    want = np.mean(1 - np.exp(-1.6 * np.array([0.2, 1.0, 3.0])))
    assert abs(picture.alpha - want) < 4 * 0.5 / np.sqrt(300)  # samples lie in [0, 1]


def test_lobes_and_rayleigh_integrate_to_one_and_have_their_mean_cosines():
    x, w = np.polynomial.legendre.leggauss(200)
    for of, mean in ((phase.two_lobes(0.6, -0.3, 0.7), 0.7 * 0.6 - 0.3 * 0.3), (phase.henyey_greenstein(-0.5), -0.5),
                     (phase.rayleigh(), 0.0)):  # fmt: skip
        f = 2 * np.pi * w * [phase.of_cosine(of, c) for c in x]
        assert f.sum() == pytest.approx(1) and (f * x).sum() == pytest.approx(mean, abs=1e-9)
        drawn = [-phase.sample(of, 0.0, (0.0, 0.0, 1.0), new_rng(k, 0))[2] for k in range(2000)]
        assert np.mean(drawn) == pytest.approx(mean, abs=4 / np.sqrt(2000))  # cosines lie in [-1, 1]


@pytest.mark.parametrize("eta", [1 / 1.5, 1.5])
def test_snell_and_fresnel_on_both_sides_of_glass(eta):
    """At Brewster's angle nothing that vibrates in the plane is mirrored; beyond the critical angle all is."""
    n = (0.0, 0.0, 1.0)
    brewster = np.arctan(1 / eta)
    for angle in (0.3, brewster):
        for side in (1.0, -1.0):
            d, reflected = refracted(n, (np.sin(angle), 0.0, side * np.cos(angle)), eta)
            assert -d[0] == pytest.approx(eta * np.sin(angle)) and d[2] * side < 0
            through = np.arcsin(eta * np.sin(angle))
            across = (np.sin(angle - through) / np.sin(angle + through)) ** 2
            parallel = (np.tan(angle - through) / np.tan(angle + through)) ** 2
            assert reflected == pytest.approx(0.5 * (across + parallel))
    d, reflected = refracted(n, (0.8, 0.0, 0.6), 1.5)
    assert reflected == 1.0 and d == pytest.approx((-0.8, 0.0, 0.6))


def test_the_highest_priority_says_which_medium_is_there():
    """Of equal ones the later material, whatever the order of the shapes; outside of all the ambient one."""
    inks = [media.homogeneous((-3,) * 3, (3,) * 3, sigma_t=k) for k in (1.0, 2.0, 3.0)]
    rows = [materials.null(1, 2.0), materials.null(2, 1.0), materials.null(3, 1.0)]
    for order in ((0, 1, 2), (2, 1, 0)):
        shapes = [surfaces.sphere(k, ((0.0, 1.0, 1.5)[k], 0, 0), 1.0) for k in order]
        world = Scene(media=inks, materials=rows, shapes=shapes, lights=[DIM]).world()
        found = [number_at(world, inside_at(world, (x, 0.0, 0.0))) for x in (-0.5, 0.5, 0.8, 1.5, 2.2, 5.0)]
        assert found == [1, 1, 1, 3, 3, -1]


def test_a_checker_has_its_second_colour_on_every_other_square():
    row = materials.lambert(0.9, (0.1, 0.2, 0.3), 0.5)
    for k in range(-3, 4):
        assert albedo_at(row, (0.5 * k + 0.25, 0.1, 0.1)) == ((0.1, 0.2, 0.3) if k % 2 else (0.9, 0.9, 0.9))
