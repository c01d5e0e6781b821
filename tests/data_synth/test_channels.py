"""Every written channel (radiance, alpha, distance) of every integrator against closed forms, and against change.

Media here have three extinctions and three albedos, so that no colour, weight or order of events can stand for another.
"""

import numpy as np
import pytest
from scipy import integrate, special

from data_synth import (
    Camera,
    DeepShadow,
    Emission,
    March,
    Path,
    lights,
    look_at,
    materials,
    media,
    phase,
    render,
    sggx,
    spongecake,
    surfaces,
)  # fmt: skip
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means, assert_sample_mean

SIGMA, ALBEDO = np.array([0.5, 1.0, 2.5]), (1.0, 0.5, 0.1)


def camera(eye=(0.1, -3.0, 0.2), target=(0, 0, 0), size=2, focal=6.0):
    return Camera(size, size, focal, look_at(eye, target))


def centre_rays(c):
    x = (np.arange(c.width) + 0.5 - c.width / 2) / c.focal
    d = np.stack(np.broadcast_arrays(x[None, :], -x[:, None], -1.0), axis=-1) @ c.c2w[:3, :3].T
    return c.c2w[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


def chord(o, d, lo=-1.0, hi=1.0):
    a, b = (lo - o) / d, (hi - o) / d
    return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)


def cube(kind, **kwargs):
    if kind == "grid":
        return media.grid(np.ones((10, 10, 10)), (-1,) * 3, (1,) * 3, SIGMA, **kwargs)
    return media.homogeneous((-1,) * 3, (1,) * 3, SIGMA, **kwargs)


def expected(c):
    """(alpha, distance) of the cube: integral of sigma e^(-sigma (t - t0)) t over the chord, the mean over colours."""
    o, d = centre_rays(c)
    t0, t1 = (t[..., None] for t in chord(o, d))
    T = np.exp(-SIGMA * (t1 - t0))
    return (1 - T).mean(axis=-1), (t0 - t1 * T + (1 - T) / SIGMA).mean(axis=-1)


@pytest.mark.parametrize("kind", ["grid", "homogeneous"])
def test_alpha_and_distance_of_marched_rays(kind):
    c = camera()
    alpha, distance = expected(c)
    m = cube(kind, albedo=ALBEDO, Le=0.3)._replace(step=0.01)
    scene = Scene(medium=m, lights=[lights.directional((0.3, 0.2, 1.0), 2.0)])
    for integrator in (Emission(), March(), DeepShadow(resolution=8)):
        picture = integrator.render(scene, c)
        assert np.allclose(picture.alpha, alpha, atol=1e-9)
        # midpoints of steps h: the relative error of a first moment is about (sigma h)^2 / 12, 5e-5 here
        assert np.allclose(picture.distance, distance, rtol=6e-5)


@pytest.mark.parametrize("albedo", [0.0, 0.5, 1.0, ALBEDO])
@pytest.mark.parametrize("kind", ["grid", "homogeneous"])
def test_alpha_and_distance_of_paths(kind, albedo):
    """They do not depend on the albedo: absorbed light ends at its distance as scattered light does."""
    c = camera()
    alpha, distance = expected(c)
    scene = Scene(medium=cube(kind, albedo=albedo), lights=[lights.directional((0.3, 0.2, 1.0), 2.0)])
    pictures = [Path(spp=200, max_depth=1, jitter=False).render(scene, c, seed=seed) for seed in range(60)]
    assert_sample_mean([p.distance for p in pictures], distance)
    assert_sample_mean([p.alpha for p in pictures], alpha)


@pytest.mark.parametrize("integrator", [March(), Path(spp=40, jitter=False)])
def test_glass_is_opaque_and_stands_where_it_is_first_met(integrator):
    """A clear ball under a sky of (1, 0.5, 0.2) shows that sky; alpha is 1 and the distance that of its near side."""
    sky = np.array([1.0, 0.5, 0.2])
    scene = Scene(
        shapes=[surfaces.sphere(0, (0, 0, 0), 0.9)], materials=[materials.dielectric(1.5)],
        lights=[lights.environment(sky)],
    )  # fmt: skip
    c = camera(size=6, focal=9.0)
    o, d = centre_rays(c)
    b = -(d @ o)
    h = 0.81 - ((o + b[..., None] * d) ** 2).sum(axis=-1)
    hit = h > 0
    picture = integrator.render(scene, c)
    assert hit.any() and not hit.all()
    assert np.array_equal(picture.alpha, hit.astype(float))
    assert np.allclose(picture.distance, np.where(hit, b - np.sqrt(np.maximum(h, 0)), 0), atol=1e-9)
    if isinstance(integrator, Path):
        assert_means(picture.rgb, picture.variance, np.where(hit[..., None], sky, 0.0))
    else:
        assert np.allclose(picture.rgb, np.where(hit[..., None], sky, 0.0), atol=1e-9)


def sheet(tau, z=0.5):
    """A wide sheet of black flakes that are as large from every side: straight through goes e^(-tau / cosine)."""
    flakes = spongecake.layer(tau, sggx.fibre((0, 0, 1), 1.0), 0.0)
    corners = np.array([[-900, -900, z], [900, -900, z], [900, 900, z], [-900, 900, z]], float)
    return {
        "triangles": surfaces.mesh(1, corners, np.array([[0, 1, 2], [0, 2, 3]])), "layers": [flakes],
        "materials": [materials.lambert((0.8, 0.5, 0.2)), materials.layered(0, 1)],
    }  # fmt: skip


def test_sheets_let_light_through_to_what_lies_below():
    """Under a sheet e^(-1/2) of a sun in the zenith arrives, and 2 E_3(1/2) of a sky."""
    floor, c = surfaces.plane(0, (0, 0, 0), (0, 0, 1)), camera((0.1, -1.0, 0.3), (0, 0, 0))
    albedo = np.array([0.8, 0.5, 0.2])
    for lamp, irradiance in (
        (lights.directional((0, 0, 1), 2.0), 2.0 * np.exp(-0.5)),
        (lights.environment(0.7), 0.7 * np.pi * 2 * special.expn(3, 0.5)),
    ):  # fmt: skip
        scene = Scene(shapes=[floor], lights=[lamp], **sheet(0.5))
        want = albedo / np.pi * irradiance
        picture = Path(spp=2000, max_depth=1, jitter=False).render(scene, c)
        assert_means(picture.rgb, picture.variance, want)
        # beams: the midpoint rule of 400 cosines, whose weight is smooth
        assert np.allclose(March(beams=800).render(scene, c).rgb, want, rtol=2e-3)


def test_sheets_are_as_transparent_in_paths_as_in_marches():
    scene = Scene(lights=[lights.environment(0.7)], **sheet(0.5))
    c = camera((0.1, -0.5, 3.0), (0.1, 0.0, 0.5))
    o, d = centre_rays(c)
    cosine = -d[..., 2]
    alpha, distance = 1 - np.exp(-0.5 / cosine), (o[2] - 0.5) / cosine
    marched, n = March(beams=4).render(scene, c), 4000
    assert np.allclose(marched.alpha, alpha) and np.allclose(marched.distance, alpha * distance)
    traced = Path(spp=n, jitter=False).render(scene, c)
    assert_means(traced.alpha, alpha * (1 - alpha) / n, alpha)
    assert_means(traced.distance / distance, alpha * (1 - alpha) / n, alpha)
    assert traced.rgb.max() == 0.0  # the sky behind it is not part of the picture


def test_a_changed_scene_is_rendered_anew():
    c = camera()
    scene = Scene(medium=cube("grid", albedo=ALBEDO), lights=[lights.directional((0.3, 0.2, 1.0), 2.0)])
    for integrator in (Path(spp=200), March(), DeepShadow(resolution=6)):
        first = integrator.render(scene, c).rgb
        scene.lights[0][4:7] *= 1e-4  # in place
        dim = integrator.render(scene, c).rgb
        assert np.allclose(dim, 1e-4 * first, rtol=1e-9) and first.max() > 0
        scene.lights = [lights.directional((0.3, 0.2, 1.0), 2.0)]
        assert np.array_equal(integrator.render(scene, c).rgb, first)
        kept, scene.medium = scene.medium, scene.medium._replace(sigma_t=(0.0, 0.0, 0.0))
        assert integrator.render(scene, c).alpha.max() == 0.0
        scene.medium = kept._replace(samples=2 * kept.samples, brick_max=2 * kept.brick_max, max_density=2.0)
        thicker, thinner = integrator.render(scene, c), integrator.render(Scene(medium=kept, lights=scene.lights), c)
        assert thicker.alpha.min() > 1.05 * thinner.alpha.max()
        scene.medium = kept
        scene.opaque_sky = True
        assert integrator.render(scene, c).alpha.min() == 1.0
        scene.opaque_sky = False


def test_the_seed_arrives_without_an_integrator_too():
    scene = Scene(medium=cube("grid", albedo=ALBEDO), lights=[lights.environment(1.0)], integrators=("path",))
    a, b, c = (render(scene, camera(), seed=seed).rgb for seed in (1, 2, 1))
    assert np.array_equal(a, c) and not np.array_equal(a, b)


def test_default_paths_have_no_last_order():
    """A thick white medium in its own colour of light: 64 events would lose some per cent of it."""
    m = media.homogeneous((-1,) * 3, (1,) * 3, (40.0, 25.0, 40.0), 1.0, phase=phase.henyey_greenstein(0.8))
    scene = Scene(medium=m, lights=[lights.environment((0.7, 0.3, 0.5))], opaque_sky=True)
    picture = Path(spp=500, jitter=False).render(scene, camera())
    assert_means(picture.rgb, picture.variance, (0.7, 0.3, 0.5))
    with pytest.raises(AssertionError, match="exceeds"):
        cut = Path(spp=500, max_depth=64, jitter=False).render(scene, camera())
        assert_means(cut.rgb, cut.variance, (0.7, 0.3, 0.5))


def everything(k):
    """A scene of every kind of object, k times as large."""

    def rho(x, y, z):
        return np.clip(1.2 - np.sqrt(x * x + y * y + z * z) / k + 0.3 * np.sin(5 * x / k), 0, 1)

    m = media.from_function(rho, (-k,) * 3, (k,) * 3, 17, sigma_t=SIGMA / k, albedo=ALBEDO, Le=0.1)
    corners = k * np.array([[-0.9, -1.3, -0.9], [-0.3, -1.3, -0.9], [-0.6, -1.1, -0.3]])
    return Scene(
        medium=m, opaque_sky=True,
        shapes=[surfaces.plane(0, (0, 0, -k), (0, 0, 1)), surfaces.sphere(1, (0.5 * k, -0.9 * k, 0), 0.3 * k),
                surfaces.box(2, (0.2 * k, 0.2 * k, -k), (0.6 * k, 0.6 * k, -0.2 * k))],
        triangles=surfaces.mesh(0, corners, np.array([[0, 1, 2]])),
        materials=[materials.lambert(0.6, 0.2, 0.25 * k), materials.dielectric(1.4), materials.blinn_phong(0.5, 0.2, 20)],
        lights=[lights.directional((0.3, -0.4, 1.0), 1.5), lights.point((0.2 * k, 0.1 * k, 0.7 * k), 0.6 * k * k),
                lights.quad((-0.5 * k, -k, 1.5 * k), (0, 0.7 * k, 0), (0.6 * k, 0, 0), 2.0), lights.sky(0.7, 0.5, 0.2)],
    )  # fmt: skip


@pytest.mark.parametrize("integrator", [Path(spp=20), March(beams=3), DeepShadow(beams=3, resolution=8)])
def test_scenes_of_any_size_look_alike(integrator):
    """A power of two changes no digit of any product: pictures must be equal to the last rounding of exp and sums."""

    def render_at(k):
        return integrator.render(everything(k), camera(k * np.array([0.1, -3.0, 0.4]), size=8, focal=9.0))

    one = render_at(1.0)
    for k in (2.0**-20, 2.0**-10, 2.0**10, 2.0**20):
        picture = render_at(k)
        for a, b in ((picture.rgb, one.rgb), (picture.alpha, one.alpha), (picture.distance / k, one.distance)):
            assert np.allclose(a, b, rtol=1e-9, atol=1e-9), f"{k:g}"


def test_shadow_rays_of_a_march_pass_straight_through_glass():
    """A medium in glass that hardly refracts is lit as without glass."""

    def ball(material):
        m = cube("grid", albedo=ALBEDO)
        return Scene(
            medium=m, shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)], materials=[material], bounded=True, opaque_sky=True,
            lights=[lights.directional((0.3, 0.2, 1.0), 2.0), lights.point((0.5, -1.5, 1.0), 1.0), lights.environment(0.4)],
        )  # fmt: skip

    for integrator in (March(beams=5), DeepShadow(beams=5, resolution=12)):
        free, glass = (
            integrator.render(ball(b), camera()).rgb for b in (materials.null(), materials.dielectric(1.0001))
        )
        # rays that come to the glass at a grazing angle bend and mirror most
        assert free.min() > 0.01 and np.allclose(glass, free, rtol=0.01)
    scene = Scene(
        shapes=[surfaces.plane(0, (0, 0, -1), (0, 0, 1)), surfaces.box(1, (-3, -3, 0.5), (3, 3, 0.6))],
        materials=[materials.lambert(0.5), materials.dielectric(1.5)], lights=[lights.directional((0, 0, 1), 2.0)],
    )  # fmt: skip
    through = (1 - 0.04) ** 2  # two faces at right angles
    picture = March().render(scene, camera((0.1, -2.0, 0.0), (0, 0, -1.0)))
    assert np.allclose(picture.rgb, 0.5 / np.pi * 2.0 * through, rtol=1e-9)


def test_a_point_light_in_the_medium_has_the_variance_that_equiangular_sampling_promises():
    """Single scattering in a ball against quadrature: of the mean, and of the second moments of both techniques.

    X = A + B: A from a vertex drawn with density sigma T, B from one drawn with the equiangular density, shares by the
    balance heuristic. Chance enters nowhere else, since a homogeneous ball has its transmittance in closed form.
    """
    sigma, albedo, g, light = 1.3, 0.8, 0.3, np.array([0.1, 0.05, 0.2])
    c, n = camera(), 40_000
    scene = Scene(
        medium=media.homogeneous((-1,) * 3, (1,) * 3, sigma, albedo, phase=phase.henyey_greenstein(g)),
        shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)], materials=[materials.null()], bounded=True,
        lights=[lights.point(light, 5.0)],
    )  # fmt: skip
    picture = Path(spp=n, max_depth=1, jitter=False).render(scene, c)
    o, rays = centre_rays(c)
    for i in np.ndindex(2, 2):
        d = rays[i]
        near = (light - o) @ d
        D = np.linalg.norm(light - o - near * d)
        b = -o @ d
        half = np.sqrt(0.64 - ((o + b * d) ** 2).sum())
        t0, t1 = b - half, b + half
        turn = np.arctan((t1 - near) / D) - np.arctan((t0 - near) / D)

        def parts(t, d=d, near=near, D=D, t0=t0, turn=turn):
            p = o + t * d
            r = np.linalg.norm(light - p)
            cosine = d @ (light - p) / r
            f = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
            F = np.exp(-sigma * (t - t0)) * sigma * albedo * f * 5.0 / r**2 * np.exp(-sigma * r)
            own, equi = sigma * np.exp(-sigma * (t - t0)), D / (turn * (D * D + (t - near) ** 2))
            a = sigma / (sigma + equi)
            return F, F * a, (F * a) ** 2 / own, (F * (1 - a)) ** 2 / equi

        F, A, AA, BB = (
            integrate.quad(lambda t, k=k: parts(t)[k], t0, t1, points=[near], epsabs=1e-13)[0] for k in range(4)
        )
        variance = AA - A**2 + BB - (F - A) ** 2
        assert_means(picture.rgb[i][0], variance / n, F)
        # Russian roulette of weak next events adds to the variance: f / 0.1 survives, from 0.26 up at g = 0.3
        measured = picture.variance[i][0] * n
        assert 0.8 * variance < measured < 3.9 * variance
        assert np.sqrt(measured) < 1.5 * F
