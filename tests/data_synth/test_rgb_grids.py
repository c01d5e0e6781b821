"""Media whose coefficients are RGB grids: each channel against its closed form, in transmittance, pictures and furnaces."""

import numpy as np
import pytest

from data_synth import (
    Camera,
    Emission,
    InputError,
    March,
    Path,
    channels,
    lights,
    look_at,
    media,
    phase,
    sample_transmittance,
)
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means

BOX = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
SLOPES = np.array([0.2, 1.0, 6.0])  # a factor of 30 between channels
SUN = lights.directional((-0.9, -0.4, 0.1), (3.0, 2.0, 1.0))  # from behind the eye


def ramps(n: int = 11) -> np.ndarray:
    """Extinctions that rise along x, y and z each, so that no channel is another's multiple."""
    at = np.linspace(0, 1, n)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    return np.stack([SLOPES[0] * (1 + x), SLOPES[1] * (0.2 + y), SLOPES[2] * (0.1 + z)], -1)


def depths(o, d) -> np.ndarray:
    """Of a ray from side to side: a linear extinction has its mean in the middle of the chord."""
    o, d = np.array(o), np.array(d)
    near, far = (-1 - o) / d, (1 - o) / d
    t0, t1 = np.minimum(near, far).max(), np.maximum(near, far).min()
    x, y, z = (o + 0.5 * (t0 + t1) * d + 1) / 2
    return (t1 - t0) * np.array([SLOPES[0] * (1 + x), SLOPES[1] * (0.2 + y), SLOPES[2] * (0.1 + z)])


RAY = (-3.0, 0.3, -0.2), tuple(np.array([1.0, 0.07, 0.12]) / np.linalg.norm([1.0, 0.07, 0.12]))


def camera(size=1, eye=(-3.0, 0.3, -0.2)):
    return Camera(size, size, 50.0, look_at(eye, np.array(eye) + 5 * np.array(RAY[1])))


@pytest.mark.parametrize("method", ["regular", "ratio", "residual", "delta"])
def test_transmittance_of_each_channel_is_its_closed_form(method):
    medium, want = channels.rgb_grid(ramps(), *BOX), np.exp(-depths(*RAY))
    assert want.max() / want.min() > 20
    n = 1 if method == "regular" else 20000
    found = sample_transmittance(medium, *RAY, method=method, n=n, seed=4)
    if method == "regular":
        np.testing.assert_allclose(found[0], want, rtol=1e-6)  # samples are float32
    else:
        assert_means(found.mean(0), found.var(0, ddof=1) / n, want, bias=1e-7)


def test_glow_and_alpha_of_pictures():
    """What absorbs and glows with 1 shows 1 - T of its own channel; alpha is their mean."""
    scene = Scene(medium=channels.rgb_grid(ramps(), *BOX, 0.0, (1.0, 0.5, 2.0)))
    T, Le = np.exp(-depths(*RAY)), np.array([1.0, 0.5, 2.0])
    marched = Emission().render(scene, camera())
    np.testing.assert_allclose(marched.rgb[0, 0], Le * (1 - T), rtol=2e-3)  # midpoint steps
    assert marched.alpha[0, 0] == pytest.approx(1 - T.mean(), rel=2e-3)
    traced = [Path(spp=2000, jitter=False).render(scene, camera(), seed=k) for k in range(20)]
    rgb = np.array([p.rgb[0, 0] for p in traced])
    assert_means(rgb.mean(0), rgb.var(0, ddof=1) / len(rgb), Le * (1 - T), bias=1e-5)
    alpha = np.array([p.alpha[0, 0] for p in traced])
    assert_means(alpha.mean(0), alpha.var(0, ddof=1) / len(alpha), 1 - T.mean(), bias=1e-5)


def test_white_furnace():
    medium = channels.rgb_grid(ramps(), *BOX, 1.0, phase=phase.henyey_greenstein(0.5))
    sky = (0.7, 0.4, 0.2)
    p = Path(spp=1500).render(Scene(medium=medium, lights=[lights.environment(sky)], opaque_sky=True), camera(4))
    assert_means(p.rgb, np.maximum(p.variance, 1e-10), sky, bias=1e-5)


def test_the_same_as_a_grid_of_one_density():
    """Where extinctions are multiples of one density and albedo is one colour, an ordinary medium says the same."""
    sigma, albedo = np.array([2.0, 5.0, 9.0]), (0.9, 0.5, 0.2)
    rho = np.random.default_rng(1).random((9, 10, 11))
    grids = media.grid(rho, *BOX, sigma, albedo), channels.rgb_grid(rho[..., None] * sigma, *BOX, albedo)
    one, three = (March().render(Scene(medium=m, lights=[SUN]), camera(3)) for m in grids)
    np.testing.assert_allclose(three.rgb, one.rgb, rtol=2e-5)
    # a grey channel's ray ends where 1e-4 of its own light is left, a coloured one's where that is so of all
    np.testing.assert_allclose(three.alpha, one.alpha, atol=1e-4)
    np.testing.assert_allclose(three.distance, one.distance, rtol=1e-3)
    parts = [
        Path(spp=400, max_depth=3).render(Scene(medium=m, lights=[SUN]), camera(3), seed=k) for k, m in enumerate(grids)
    ]
    assert_means(parts[0].rgb, parts[0].variance + parts[1].variance, parts[1].rgb)


def test_albedo_of_each_channel_at_each_vertex():
    """Black where its albedo is 0, channel by channel."""
    albedo = np.zeros((5, 5, 5, 3))
    albedo[:, :, :2, 0] = albedo[:, :, 3:, 2] = 1.0  # red below, blue above
    medium = channels.rgb_grid(np.full((5, 5, 5, 3), 3.0), *BOX, albedo)
    seen = March().render(Scene(medium=medium, lights=[SUN]), Camera(1, 2, 1.5, look_at((-3.0, 0, 0), (0, 0, 0))))
    above, below = seen.rgb[0, 0], seen.rgb[1, 0]
    assert above[2] > 0.003 and below[0] > 0.003 and above[1] == below[1] == 0
    assert above[0] < 0.1 * below[0] and below[2] < 0.1 * above[2]


def test_channels_have_random_numbers_of_their_own():
    medium = channels.rgb_grid(np.full((3, 3, 3, 3), 1.0), *BOX, 0.5)
    far = Camera(24, 24, 1e5, look_at(RAY[0], (0.0, 0.5, 0.2)))  # all pixels the same ray
    p = Path(spp=4, jitter=False).render(Scene(medium=medium, lights=[SUN]), far)
    r, g, b = (p.rgb[..., c].ravel() for c in range(3))
    for x, y in ((r, g), (g, b), (r, b)):
        assert abs(np.corrcoef(x, y)[0, 1]) < 4.5 / np.sqrt(x.size)


def test_a_changed_scene_is_split_again():
    scene = Scene(medium=channels.rgb_grid(ramps(), *BOX, 0.5), lights=[SUN])
    before = March().render(scene, camera()).rgb
    scene.lights = [lights.directional((-0.9, -0.4, 0.1), (0.3, 0.2, 0.1))]
    np.testing.assert_allclose(March().render(scene, camera()).rgb, before / 10, rtol=1e-9)


def test_coefficients_and_truth(tmp_path):
    sigma_a, sigma_s = ramps(5), ramps(5)[::-1]
    scene = Scene(medium=channels.rgb_coefficients(sigma_a, sigma_s, *BOX, Le=(0.1, 0.2, 0.3)))
    scene.write_truth(tmp_path)
    with np.load(tmp_path / "truth.npz") as found:
        assert str(found["medium0_kind"]) == "rgb_grid"
        np.testing.assert_allclose(found["medium0_density"], sigma_a + sigma_s, rtol=1e-6)
        np.testing.assert_allclose(found["medium0_albedo"] * found["medium0_density"], sigma_s, rtol=1e-6)
        np.testing.assert_allclose(found["medium0_Le"], [[0.1, 0.2, 0.3]])
    with np.load(tmp_path / "density.npz") as found:
        np.testing.assert_allclose(found["density"], (sigma_a + sigma_s)[..., 1], rtol=1e-6)


@pytest.mark.parametrize("make, said", [
    (lambda: channels.rgb_grid(np.ones((3, 3, 3)), *BOX), "shape \\(nx, ny, nz, 3\\)"),
    (lambda: channels.rgb_grid(np.ones((3, 3, 3, 3)), *BOX, np.ones((3, 3, 3))), "the shape of sigma_t"),
    (lambda: channels.rgb_grid(np.ones((3, 3, 3, 3)), *BOX, 1.5), "in \\[0, 1\\]"),
    (lambda: channels.rgb_grid(-np.ones((3, 3, 3, 3)), *BOX), "not negative"),
    (lambda: channels.rgb_coefficients(np.ones((3, 3, 3, 3)), np.ones((3, 3, 4, 3)), *BOX), "one shape"),
    (lambda: channels.rgb_coefficients(np.ones((3, 3, 3, 3)), -np.ones((3, 3, 3, 3)), *BOX), "from 0 on"),
])  # fmt: skip
def test_what_is_no_such_medium(make, said):
    with pytest.raises(InputError, match=said):
        make()
