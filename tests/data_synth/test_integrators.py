"""Integrators against closed forms, quadrature and one another. Pictures are tiny: a pixel is a measurement."""

import numpy as np
import pytest
from scipy import integrate

from data_synth import (
    Camera,
    DeepShadow,
    Emission,
    March,
    Path,
    Preview,
    RenderWarning,
    lights,
    look_at,
    materials,
    media,
    phase,
    surfaces,
)
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means

HG = phase.henyey_greenstein(0.3)
SUN = np.array([0.6, 0.0, 0.8])


def camera(eye=(0, -3.0, 0.2), target=(0, 0, 0), size=8, focal=14.0):
    return Camera(size, size, focal, look_at(eye, target))


def ball(**kwargs):
    """A medium bounded by a null sphere of radius 0.8."""
    m = media.homogeneous((-1, -1, -1), (1, 1, 1), **kwargs)
    return Scene(medium=m, shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)], materials=[materials.null()], bounded=True)


def lumps(resolution=33, **kwargs):
    def rho(x, y, z):
        return np.clip(1.1 - np.sqrt(x * x + y * y + z * z) + 0.3 * np.sin(5 * x) * np.cos(6 * y + z), 0, 1)

    return media.from_function(rho, (-1, -1, -1), (1, 1, 1), resolution, **kwargs)


def chord(d, o, radius):
    b = -np.dot(o, d)
    h = radius**2 - np.dot(o + b * d, o + b * d)
    return (b - np.sqrt(h), b + np.sqrt(h)) if h > 0 else None


def centre_rays(c):
    x = (np.arange(c.width) + 0.5 - c.width / 2) / c.focal
    d = np.stack(np.broadcast_arrays(x[None, :], -x[:, None], -1.0), axis=-1) @ c.c2w[:3, :3].T
    return c.c2w[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_emission_sphere_chord_is_exact():
    scene, c = ball(sigma_t=(0.5, 1.0, 2.0), Le=(0.9, 0.6, 0.3)), camera(size=12, focal=18.0)
    picture = Emission().render(scene, c)
    o, d = centre_rays(c)
    for i in np.ndindex(12, 12):
        hit = chord(d[i], o, 0.8)
        length = hit[1] - hit[0] if hit else 0.0
        alpha = 1 - np.exp(-np.array([0.5, 1.0, 2.0]) * length)
        # rays that come to 1e-4 of full absorption stop there
        assert np.allclose(picture.rgb[i], alpha * [0.9, 0.6, 0.3], atol=1e-9)
        assert picture.alpha[i] == pytest.approx(alpha.mean(), abs=1e-9)


def test_camera_inside_the_medium():
    scene = ball(sigma_t=0.7, Le=1.0)
    picture = Emission().render(scene, camera(eye=(0.0, -0.3, 0.0)))
    o, d = centre_rays(camera(eye=(0.0, -0.3, 0.0)))
    want = 1 - np.exp(-0.7 * chord(d[3, 3], o, 0.8)[1])
    assert picture.rgb[3, 3] == pytest.approx(want, abs=1e-9)


def single_scattering(o, d, sigma, albedo, g, irradiance, leave, span):
    """Quadrature of the single-scattering integral along one ray of a homogeneous medium."""
    cosine = np.dot(d, SUN)  # light travels along -SUN before and along -d after
    f = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
    value, _ = integrate.quad(
        lambda t: np.exp(-sigma * (t - span[0])) * sigma * albedo * f * np.exp(-sigma * leave(o + t * d)),
        *span,
        epsabs=1e-12,
    )
    return irradiance * value


@pytest.mark.parametrize("shape", ["sphere", "slab"])
def test_single_scattering_agrees_with_quadrature(shape):
    sigma, albedo = 1.7, 0.8
    if shape == "sphere":
        scene = ball(sigma_t=sigma, albedo=albedo, phase=HG)
    else:
        scene = Scene(medium=media.homogeneous((-9, -9, -0.5), (9, 9, 0.5), sigma, albedo, phase=HG))
    scene.medium = scene.medium._replace(step=0.004)
    scene.lights = [lights.directional(SUN, 3.0)]
    c = camera(eye=(0, -2.0, 1.4), size=4, focal=9.0)
    o, d = centre_rays(c)
    want = np.zeros((4, 4))
    for i in np.ndindex(4, 4):
        if shape == "sphere":
            span, leave = chord(d[i], o, 0.8), lambda p: chord(SUN, p, 0.8)[1]
        else:
            span = sorted(((0.5 - o[2]) / d[i][2], (-0.5 - o[2]) / d[i][2]))
            leave = lambda p: (0.5 - p[2]) / SUN[2]  # noqa: E731
        want[i] = single_scattering(o, d[i], sigma, albedo, 0.3, 3.0, leave, span) if span else 0.0
    marched = March().render(scene, c).rgb
    assert np.allclose(marched, want[..., None], atol=1e-4 * want.max())
    traced = Path(spp=4000, max_depth=1, jitter=False).render(scene, c)
    assert_means(traced.rgb[..., 0], traced.variance[..., 0], want)


def test_path_of_depth_one_is_march_is_deep_shadow():
    scene = Scene(
        medium=lumps(sigma_t=(3.0, 4.0, 5.0), albedo=(0.9, 0.8, 0.7), phase=HG),
        shapes=[surfaces.plane(0, (0, 0, -1.2), (0, 0, 1))],
        materials=[materials.lambert(0.6, 0.2, 0.5)],
        lights=[lights.directional(SUN, 2.0), lights.point((0.5, -1.5, 2.0), 4.0)],
    )
    c = camera(eye=(0, -2.5, 1.0), size=10, focal=14)
    scene.medium = scene.medium._replace(step=0.01)
    marched = March().render(scene, c).rgb
    traced = Path(spp=1500, max_depth=1, jitter=False).render(scene, c)
    # midpoint steps of 0.01 leave a relative error of about (sigma step)^2 / 24 per leg, below 5e-4 here
    assert_means(traced.rgb, traced.variance, marched, bias=5e-4 * marched.max())
    errors = [
        np.abs(DeepShadow(resolution=n).render(scene, c).rgb - marched).mean() / marched.mean() for n in (12, 24, 48)
    ]
    order = -np.polyfit(np.log([12, 24, 48]), np.log(errors), 1)[0]
    assert order > 0.9 and errors[-1] < 0.01, f"errors {errors}, order {order:.2f}"
    eager = DeepShadow(resolution=24, fill="eager").render(scene, c).rgb
    lazy = DeepShadow(resolution=24, fill="lazy").render(scene, c).rgb
    assert np.allclose(eager, lazy, atol=1e-12)
    assert np.abs(eager - marched).mean() < 0.04 * marched.mean()


@pytest.mark.parametrize("g", [0.0, 0.6])
@pytest.mark.parametrize("kind", ["homogeneous", "grid", "flakes"])
def test_white_furnace(kind, g):
    """A lossless medium in a constant environment returns the environment."""
    if kind == "flakes":
        ph = phase.microflakes(np.diag([1.0, 1.0, 0.2]), diffuse=g > 0)
        m = lumps(sigma_t=5.0, albedo=1.0, phase=ph)
    else:
        make = lumps if kind == "grid" else (lambda **k: media.homogeneous((-1, -1, -1), (1, 1, 1), **k))
        m = make(sigma_t=5.0, albedo=1.0, phase=phase.henyey_greenstein(g))
    scene = Scene(medium=m, lights=[lights.environment(0.7)], opaque_sky=True)
    picture = Path(spp=400, max_depth=10_000, jitter=False).render(scene, camera(size=4, focal=6))
    assert_means(picture.rgb[..., 0], picture.variance[..., 0], 0.7)


def test_white_furnace_of_surfaces():
    """A white matt or clear ball in a constant environment vanishes; with a glossy one no energy is gained."""
    for material, exact in ((materials.lambert(1.0), True), (materials.dielectric(1.5), True),
                            (materials.blinn_phong(0.5, 0.4, 20), False)):  # fmt: skip
        scene = Scene(
            shapes=[surfaces.sphere(0, (0, 0, 0), 0.9)], materials=[material],
            lights=[lights.environment(0.5)], opaque_sky=True,
        )  # fmt: skip
        picture = Path(spp=300, max_depth=1000, jitter=False).render(scene, camera(size=6, focal=9))
        if exact:
            assert_means(picture.rgb[..., 0], picture.variance[..., 0], 0.5)
        else:
            assert picture.rgb.mean() < 0.5


def test_emission_is_the_furnace_of_an_absorbing_medium():
    """A medium that glows like its surroundings cannot be seen (integrators without scattering)."""
    m = lumps(sigma_t=4.0, Le=0.8)
    scene = Scene(medium=m, lights=[lights.environment(0.8)], opaque_sky=True)
    for integrator in (Emission(), March(beams=1), Path(spp=200, jitter=False)):
        picture = integrator.render(scene, camera(size=4, focal=6))
        variance = picture.variance if picture.variance is not None else 0.0
        assert_means(picture.rgb, variance, 0.8, bias=1e-4)


def test_quad_light_found_by_both_ways_agrees_with_quadrature():
    """Next-event estimation and surface sampling share a lamp; their weights must add up to one."""
    scene = Scene(
        shapes=[surfaces.plane(0, (0, 0, 0), (0, 0, 1))],
        materials=[materials.lambert(0.5)],
        lights=[lights.quad((-0.5, -0.5, 1.0), (0, 1.0, 0), (1.0, 0, 0), 3.0)],
    )
    c = Camera(1, 1, 50.0, look_at((0.0, -2.0, 0.7), (0.3, 0.2, 0.0)))
    picture = Path(spp=60_000, max_depth=1, jitter=False).render(scene, c)
    want, _ = integrate.dblquad(
        lambda y, x: 3.0 * 0.5 / np.pi / ((x - 0.3) ** 2 + (y - 0.2) ** 2 + 1.0) ** 2, -0.5, 0.5, -0.5, 0.5
    )
    assert_means(picture.rgb[0, 0, 0], picture.variance[0, 0, 0], want)


def test_colour_does_not_leak_and_energy_does_not_grow():
    m = lumps(sigma_t=(2.0, 8.0, 1.0), albedo=(1.0, 0.5, 0.0), phase=HG)
    scene = Scene(medium=m, lights=[lights.environment((1.0, 1.0, 0.0))], opaque_sky=True)
    picture = Path(spp=600, max_depth=1000, jitter=False).render(scene, camera(size=4, focal=6))
    assert_means(picture.rgb[..., 0], picture.variance[..., 0], 1.0)
    assert picture.rgb[..., 1].max() < 1.0 and picture.rgb[..., 2].max() == 0.0


def test_alpha_of_the_path_tracer_is_the_opacity():
    m = lumps(sigma_t=3.0, albedo=0.9)
    scene = Scene(medium=m._replace(step=0.005), lights=[lights.directional(SUN, 1.0)])
    c, n = camera(size=8), 3000
    exact = March().render(scene, c).alpha
    traced = Path(spp=n, max_depth=1, jitter=False).render(scene, c).alpha
    assert_means(traced, exact * (1 - exact) / n, exact, bias=1e-4)


def test_no_lights_is_black_with_a_warning():
    scene = Scene(medium=lumps(sigma_t=3.0, albedo=0.9))
    for integrator in (March(), Path(spp=2), Preview()):
        with pytest.warns(RenderWarning, match="no lights"):
            picture = integrator.render(scene, camera())
        assert picture.rgb.max() == 0.0 and picture.alpha.max() > 0.5


def test_pictures_do_not_depend_on_threads_or_repetition():
    scene = Scene(medium=lumps(sigma_t=3.0, albedo=0.9), lights=[lights.environment(1.0)])
    a, b = (Path(spp=3).render(scene, camera(), seed=4).rgb for _ in range(2))
    assert np.array_equal(a, b) and not np.array_equal(a, Path(spp=3).render(scene, camera(), seed=5).rgb)
