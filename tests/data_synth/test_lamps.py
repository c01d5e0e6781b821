"""Quad lights are one thing: what a ray that runs into one sees is what shadow rays and beams make of it."""

import numpy as np
import pytest
from scipy import integrate

from data_synth import Camera, DeepShadow, March, Path, lights, look_at, materials, media, phase, surfaces
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means

SKY = np.array([0.7, 0.4, 0.2])


def camera(eye, target, size=3, focal=6.0):
    return Camera(size, size, focal, look_at(eye, target))


def lumps(resolution=17, **kwargs):
    def rho(x, y, z):
        return np.clip(1.1 - np.sqrt(x * x + y * y + z * z) + 0.3 * np.sin(5 * x) * np.cos(6 * y + z), 0, 1)

    return media.from_function(rho, (-1, -1, -1), (1, 1, 1), resolution, **kwargs)


def lamp(z=1.3, radiance=SKY, **back):
    """3 x 3 at height z, shining down."""
    return lights.quad((-1.5, -1.5, z), (0, 3.0, 0), (3.0, 0, 0), radiance, **back)


WHITE = {"sigma_t": 5.0, "albedo": 1.0, "phase": phase.henyey_greenstein(0.4)}
FURNACES = {
    "above a cloud": {"medium": lumps(**WHITE), "lights": [lamp()]},
    "two above a cloud": {"medium": lumps(**WHITE), "lights": [lamp(), lamp(1.6)]},
    "above a floor": {
        "shapes": [surfaces.plane(0, (0, 0, -1), (0, 0, 1))], "materials": [materials.lambert(1.0)], "lights": [lamp()],
    },
    "above a bounded ball": {  # the way to the lamp is cut in two by the boundary
        "medium": media.homogeneous((-1,) * 3, (1,) * 3, **WHITE), "bounded": True, "lights": [lamp()],
        "shapes": [surfaces.sphere(0, (0, 0, 0), 0.9)], "materials": [materials.null()],
    },
    "above a ball of glass": {
        "medium": media.homogeneous((-1,) * 3, (1,) * 3, **WHITE), "bounded": True, "lights": [lamp()],
        "shapes": [surfaces.sphere(0, (0, 0, 0), 0.9)], "materials": [materials.dielectric(1.3)],
    },
    "of flakes": {
        "medium": lumps(sigma_t=5.0, albedo=1.0, phase=phase.microflakes(np.diag([1.0, 1.0, 0.2]), diffuse=True)),
        "lights": [lamp()],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", FURNACES)
def test_furnaces_with_a_lamp(name):
    """A lamp as bright as the sky changes nothing: all that is white disappears."""
    scene = Scene(opaque_sky=True, **FURNACES[name])
    scene.lights = [lights.environment(SKY), *scene.lights]
    picture = Path(spp=1500, jitter=False).render(scene, camera((0.1, -3.0, 0.2), (0, 0, -0.2)))
    assert_means(picture.rgb, picture.variance, SKY)


def test_furnace_with_a_lamp_in_the_medium():
    """Clear from behind, a lamp within the medium disappears as well; with a black back it would take light away."""
    scene = Scene(
        medium=lumps(**WHITE), opaque_sky=True,
        lights=[lights.environment(SKY), lights.quad((-0.4, -0.5, 0.1), (0, 0.9, 0), (0.8, 0, 0), SKY, back="clear")],
    )  # fmt: skip
    c = camera((0.1, -3.0, 0.2), (0, 0, -0.2))
    picture = Path(spp=1500, jitter=False).render(scene, c)
    assert_means(picture.rgb, picture.variance, SKY)
    scene.lights[1] = lights.quad((-0.4, -0.5, 0.1), (0, 0.9, 0), (0.8, 0, 0), SKY)
    assert Path(spp=1500, jitter=False).render(scene, c).rgb.mean() < 0.99 * SKY.mean()


@pytest.mark.parametrize("back", ["black", "clear"])
def test_lamps_are_seen(back):
    """From the front: radiance, alpha 1, distance. From behind: black and opaque, or not there."""
    scene = Scene(lights=[lights.quad((-1, -1, 1.0), (0, 2.0, 0), (2.0, 0, 0), SKY, back=back)])
    for integrator in (March(), Path(spp=3, jitter=False), DeepShadow(resolution=4)):
        front = integrator.render(scene, camera((0, 0.1, -1), (0, 0, 1), size=1))
        assert np.allclose(front.rgb, SKY) and front.alpha == 1.0
        assert front.distance == pytest.approx(np.hypot(2.0, 0.1) * 1.0)
        behind = integrator.render(scene, camera((0, 0.1, 3), (0, 0, 1), size=1))
        assert behind.rgb.max() == 0.0 and behind.alpha == (back == "black")


def form(x, y, z, n):
    """Irradiance per radiance at (x, y, z) with normal n from the lamp [-0.5, 0.5]^2 at height 1 that shines down."""

    def kernel(v, u):
        to = np.array([u - x, v - y, 1.0 - z])
        return max(to[2], 0.0) * max(to @ n, 0.0) / (to @ to) ** 2

    return integrate.dblquad(kernel, -0.5, 0.5, -0.5, 0.5, epsabs=1e-7)[0]


@pytest.mark.parametrize(
    "point, normal", [((0.3, 0.2, 0.0), (0, 0, 1)), ((0.9, 0.1, 0.5), (-1, 0, 0)), ((0.2, 0.1, 1.4), (0, 0, -1))]
)
def test_lamps_shine_with_the_cosine_and_not_backwards(point, normal):
    """Below, beside and behind a lamp: marched beams, maps and paths against quadrature."""
    p, n = np.array(point), np.array(normal, float)
    scene = Scene(
        shapes=[surfaces.plane(0, p, n)], materials=[materials.lambert((0.9, 0.5, 0.1))],
        lights=[lights.quad((-0.5, -0.5, 1.0), (0, 1.0, 0), (1.0, 0, 0), (3.0, 2.0, 1.0))],
    )  # fmt: skip
    want = np.array([0.9 * 3, 0.5 * 2, 0.1]) / np.pi * form(*p, n)
    c = camera(p + 0.2 * n + (0.01, 0.02, 0.01), p, size=1, focal=50.0)
    for integrator in (March(beams=900), DeepShadow(beams=900, resolution=4)):
        # 30 x 30 midpoints of a kernel that is smooth on the scale of 1/30
        assert np.allclose(integrator.render(scene, c).rgb[0, 0], want, rtol=2e-3, atol=1e-12)
    picture = Path(spp=4000, max_depth=1, jitter=False).render(scene, c)
    assert_means(picture.rgb, picture.variance, want)


def test_lamps_throw_shadows():
    """A lamp keeps the sun from what looks into its face, and with a black back from what looks at that as well."""

    def scene(shines, back):
        # As wide as to shade the floor wherever a scattered path may come to it.
        edges = [(0, 4e4, 0), (4e4, 0, 0)] if shines == "down" else [(4e4, 0, 0), (0, 4e4, 0)]
        return Scene(
            medium=media.grid(np.ones((9, 9, 9)), (-1, -1, -0.9), (1, 1, 0.9), (0.3, 0.5, 0.8), (0.9, 0.6, 0.3)),
            shapes=[surfaces.plane(0, (0, 0, -1), (0, 0, 1))], materials=[materials.lambert(0.5)],
            lights=[lights.directional((0, 0, 1), 2.0), lights.quad((-2e4, -2e4, 1.5), *edges, 0.0, back)],
        )  # fmt: skip

    c = camera((0.1, -3.0, 0.2), (0, -1.0, -1.0))
    for integrator in (March(beams=1), Path(spp=50), DeepShadow(beams=1), DeepShadow(beams=1, resolution=6)):
        for shines, back in (("down", "black"), ("down", "clear"), ("up", "black")):
            assert integrator.render(scene(shines, back), c).rgb.max() == 0.0
        assert integrator.render(scene("up", "clear"), c).rgb.min() > 1e-3
