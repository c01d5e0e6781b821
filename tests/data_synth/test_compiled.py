"""The path tracer's core in C++ against the textbook version, closed forms and furnaces, in every written channel.

It computes in single precision: where a mean is exact by construction it must be so within ROUNDING.
"""

import importlib
import itertools

import numpy as np
import pytest
from scipy import stats

from data_synth import (
    Camera,
    Path,
    compiled,
    integrators,
    lights,
    look_at,
    materials,
    media,
    parts,
    phase,
    sample_transmittance,
    surfaces,
)
from data_synth.parts import Part
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means, sidak

pytestmark = pytest.mark.skipif(compiled.core() is None, reason="the extension was not built")

ROUNDING = 1e-5  # a hundred roundings of 6e-8 along a path
SIGMA, ALBEDO = np.array([0.5, 1.5, 4.0]), (0.95, 0.6, 0.3)
SUN, SKY = lights.directional((0.5, -0.7, 0.6), (3.0, 2.0, 1.0)), lights.sky((0.3, 0.5, 1.0), 0.7, (0.1, 0.2, 0.3))


def camera(eye=(0.3, -3.0, 0.7), target=(0, 0, 0), size=4, focal=5.0):
    return Camera(size, size, focal, look_at(eye, target))


def lumps(shape=(17, 19, 21), seed=0, scale=1.0, **kwargs):
    """Sparse and rough, with bricks that are cut by the box and others that are empty."""
    rng = np.random.default_rng(seed)
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in shape], indexing="ij")
    rho = np.clip(1.2 - 1.3 * np.sqrt(x * x + y * y + z * z) + 0.5 * rng.standard_normal(shape), 0, None)
    return media.grid(rho, (-1.0 * scale,) * 3, (1.0 * scale,) * 3, **kwargs)


def attribute(shape=(17, 19, 21)):
    return np.random.default_rng(9).random(shape)


TABLE = [(0.9, 0.2, 0.5), (0.1, 0.8, 0.95), (0.5, 0.5, 0.2)]
SCENES = {
    "grey grid, sun": (lumps(sigma_t=8.0, albedo=0.98, phase=phase.henyey_greenstein(0.7)), [SUN]),
    "coloured grid, sun and sky": (lumps(sigma_t=SIGMA, albedo=ALBEDO, phase=phase.two_lobes(0.8, -0.4, 0.7)), [SUN, SKY]),
    "glowing grid with tables, Rayleigh": (
        lumps(sigma_t=4.0, albedo=TABLE, Le=TABLE[::-1], attribute=attribute(), phase=phase.rayleigh()), [SKY]),
    "coloured homogeneous, two lights": (
        media.homogeneous((-1,) * 3, (1,) * 3, SIGMA, ALBEDO, 0.2, phase.henyey_greenstein(-0.5)), [SUN, SKY]),
    "exponential": (media.exponential((-1,) * 3, (1,) * 3, 0.4, SIGMA, ALBEDO, phase=phase.henyey_greenstein(0.3)), [SUN, SKY]),
    "points in and beside it": (
        lumps(sigma_t=SIGMA, albedo=ALBEDO, phase=phase.henyey_greenstein(0.4)),
        [lights.point((0.2, 0.1, 0.3), 1.5), lights.point((2.0, -1.0, 1.0), (9.0, 7.0, 5.0)), SKY]),
    "no lights": (lumps(sigma_t=3.0, albedo=0.5, Le=(1.0, 0.5, 0.2)), []),
    "dark grey grid": (lumps(sigma_t=8.0, albedo=0.4, phase=phase.henyey_greenstein(0.3)), [SUN, SKY]),
    "thick and coloured, sun behind it": (
        lumps(sigma_t=8 * SIGMA, albedo=ALBEDO, phase=phase.isotropic()), [lights.directional((0.1, 1, -0.2), 9)]),
}  # fmt: skip


def channels(scene, textbook, spp, runs, max_depth=None, view=None):
    """(runs, H, W, 8): every channel of pictures with different seeds; the last three: the variance of a path."""
    path, out = Path(spp=spp, max_depth=max_depth, textbook=textbook), []
    for seed in range(runs):
        p = path.render(scene, view or camera(), seed=(7000 if textbook else 0) + seed)
        out.append(np.concatenate([p.rgb, p.alpha[..., None], p.distance[..., None], spp * p.variance], axis=-1))
    return np.array(out)


def assert_alike(a, b, alpha=1e-4):
    """Welch's t-test of every channel of every pixel and of every channel's picture mean, Sidak over all of them."""
    for x, y in ((a, b), (a.mean(axis=(1, 2)), b.mean(axis=(1, 2)))):
        u, v = x.var(axis=0, ddof=1) / len(x), y.var(axis=0, ddof=1) / len(y)
        off = np.abs(x.mean(axis=0) - y.mean(axis=0))
        exact = u + v < (ROUNDING * 1e-2) ** 2
        assert (off[exact] < ROUNDING * (1 + y.mean(axis=0)[exact])).all()
        freedom = (u + v) ** 2 / (u**2 / (len(x) - 1) + v**2 / (len(y) - 1) + 1e-300)
        t = off[~exact] / np.sqrt((u + v)[~exact])
        limit = stats.t.isf(0.5 * sidak(alpha, max(t.size, 1)), freedom[~exact])
        assert (t <= limit).all(), f"t = {t.max():.2f} of {t.size}, limit there {limit[np.argmax(t)]:.2f}"


DEPTHS = [("grey grid, sun", 0), ("points in and beside it", 1), ("glowing grid with tables, Rayleigh", 2)]


@pytest.mark.parametrize("name, depth", [*itertools.product(SCENES, (None,)), *DEPTHS])
def test_it_agrees_with_the_textbook(name, depth):
    medium, lit = SCENES[name]
    scene = Scene(medium=medium, lights=lit)
    assert compiled.unknown(scene.world()) == ""
    # A path of the textbook costs five times as much as one of the core: 2.6 of the core's for each is the least work for
    # the noise of both together.
    assert_alike(channels(scene, False, 200, 60, depth), channels(scene, True, 115, 40, depth))


def test_directions_after_rayleigh_scattering():
    """From below, under a sky that is bright above alone: cosines drawn without 1 + cos^2 miss by some per cent."""
    medium = media.homogeneous((-1,) * 3, (1,) * 3, 1.0, 1.0, phase=phase.rayleigh())
    scene, view = Scene(medium=medium, lights=[lights.sky(1.0, 0.0, 0.0)]), camera((0, 1e-9, -3))
    assert_alike(channels(scene, False, 300, 60, 1, view), channels(scene, True, 115, 40, 1, view))


@pytest.mark.parametrize("opaque", [False, True])
def test_it_agrees_from_inside_and_with_an_opaque_sky(opaque):
    medium, lit = SCENES["coloured grid, sun and sky"]
    scene, view = Scene(medium=medium, lights=lit, opaque_sky=opaque), camera((0.2, -0.1, 0.3), (1, 1, 0.2), focal=2.0)
    assert_alike(channels(scene, False, 260, 40, view=view), channels(scene, True, 110, 40, view=view))


def lit_once(colours, o, d, g, sigma, n=(24, 64, 64)):
    """Light of a sky scattered once along the ray o + t d through the box of side 2 around 0, by quadrature over the ray, d_z
    (= s |s|, so that the sky is smooth in pieces) and azimuth."""
    (u, wu), (v, wv) = (np.polynomial.legendre.leggauss(k) for k in n[:2])
    ends = np.sort([(-1 - o) / d, (1 - o) / d], axis=0)
    t0, t1 = ends[0].max(), ends[1].min()
    breaks = np.array([-1.0, -(0.125**0.5), 0.0, 1.0])
    half, middle = 0.5 * np.diff(breaks), 0.5 * (breaks[:-1] + breaks[1:])
    s, ws = (half[:, None] * v + middle[:, None]).ravel(), (half[:, None] * wv).ravel()
    z, wz = s * np.abs(s), 2 * np.abs(s) * ws
    a = 2 * np.pi * (np.arange(n[2]) + 0.5) / n[2]
    w = np.stack(
        np.broadcast_arrays(
            np.sqrt(1 - z * z)[:, None] * np.cos(a), np.sqrt(1 - z * z)[:, None] * np.sin(a), z[:, None]
        ),
        -1,
    )
    sky = np.array([lights.sky_radiance(lights.sky(*colours), (0, 0, height)) for height in z])
    total = 0.0
    for t, wt in zip(0.5 * (t1 - t0) * u, 0.5 * (t1 - t0) * wu, strict=True):
        t += 0.5 * (t1 - t0)
        p = o + (t0 + t) * d
        out = np.where(w > 0, (1 - p) / w, (-1 - p) / w).min(-1)
        f = lobe(g, w @ d) * np.exp(-sigma * (t + out)) * sigma * wt * 2 * np.pi / n[2]
        total = total + (f[..., None] * (wz[:, None] * sky)[:, None]).sum((0, 1))
    return total


@pytest.mark.parametrize(
    "colours", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), ((0.1, 0.2, 0.9), 0.8, (0.3, 0.2, 0))]
)
@pytest.mark.parametrize("way", [(0.3, 0.6, -0.8), (-0.2, 0.5, 0.1), (0.1, -0.3, 0.9)])
def test_single_scattering_of_uneven_skies(colours, way):
    """Against quadrature, seen from above, the side and below: black halves, each of the three parts alone, and all."""
    d = np.array(way) / np.linalg.norm(way)
    o, sigma, g = 0.1 - 4 * d, 0.8, 0.5
    medium = media.homogeneous((-1,) * 3, (1,) * 3, sigma, 1.0, phase=phase.henyey_greenstein(g))
    scene, view = Scene(medium=medium, lights=[lights.sky(*colours)]), Camera(1, 1, 10.0, look_at(o, o + d))
    want = lit_once(colours, o, d, g, sigma)
    rough = np.abs(want - lit_once(colours, o, d, g, sigma, (16, 40, 40))).max()
    assert rough < 1e-3 * want.max()
    a, b = (Path(spp=40_000, max_depth=1, jitter=False).render(scene, view, seed=seed) for seed in (1, 2))
    assert_means(a.rgb, a.variance, want, bias=rough + ROUNDING)
    assert_means(a.rgb - b.rgb, a.variance + b.variance, 0.0)


WHITE = [
    lumps(sigma_t=5.0, albedo=1.0, phase=phase.isotropic()),
    lumps(sigma_t=SIGMA, albedo=1.0, phase=phase.henyey_greenstein(0.9)),
    lumps(sigma_t=5.0, albedo=1.0, phase=phase.rayleigh()),
    media.homogeneous((-1,) * 3, (1,) * 3, SIGMA, 1.0, phase=phase.two_lobes(0.9, -0.9, 0.4)),
    media.exponential((-1,) * 3, (1,) * 3, 0.3, SIGMA, 1.0, phase=phase.henyey_greenstein(-0.6)),
]


@pytest.mark.parametrize(
    "name", [] if compiled.core() is None else importlib.import_module("_nerfvol_kernels").available_isas()
)
@pytest.mark.parametrize("medium", WHITE)
def test_white_furnace(medium, name):
    """What loses nothing disappears in a constant sky, on every instruction set."""
    kernels = importlib.import_module("_nerfvol_kernels")
    before = kernels.isa()
    try:
        assert kernels.set_isa(name)
        p = Path(spp=4000).render(
            Scene(medium=medium, lights=[lights.environment((0.7, 0.4, 0.2))], opaque_sky=True), camera()
        )
    finally:
        kernels.set_isa(before)
    assert_means(p.rgb, np.maximum(p.variance, ROUNDING**2), (0.7, 0.4, 0.2), bias=ROUNDING)
    assert (p.alpha == 1.0).all()


def test_isothermal_furnace():
    """As bright inside as outside: any albedo disappears."""
    medium = lumps(sigma_t=SIGMA, albedo=TABLE, attribute=attribute(), Le=0.5, phase=phase.henyey_greenstein(0.6))
    p = Path(spp=4000).render(Scene(medium=medium, lights=[lights.environment(0.5)], opaque_sky=True), camera())
    assert_means(p.rgb, p.variance, 0.5, bias=ROUNDING)


@pytest.mark.parametrize("kind", ["grid", "homogeneous"])
def test_alpha_is_the_closed_form(kind):
    black = {"sigma_t": SIGMA, "albedo": 0.0, "Le": 1.0}
    box = ((-1, -0.5, -0.25), (1, 0.5, 0.25))
    medium = media.grid(np.ones((10, 9, 21)), *box, **black) if kind == "grid" else media.homogeneous(*box, **black)
    c = camera((0.0, -3.0, 0.0), size=1)
    runs = [Path(spp=500, jitter=False).render(Scene(medium=medium), c, seed=k) for k in range(200)]
    T = np.exp(-SIGMA)  # through the middle: 1 u
    for values, want in (([p.rgb[0, 0] for p in runs], 1 - T), ([p.alpha[0, 0] for p in runs], 1 - T.mean())):
        values = np.array(values)
        assert_means(values.mean(axis=0), values.var(axis=0, ddof=1) / len(values), want, bias=ROUNDING)


def lobe(g, cosine):
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1)])
def test_single_scattering_of_two_suns_for_odd_parameters(size, scale):
    """Colour, alpha and distance against quadrature: mean cosines of +-0.9, albedo 0, 1 and of each colour, pictures of one
    row, one column and one pixel, thousandfold scales."""
    c = Camera(*size, 12.0, look_at((0.3 * scale, -4 * scale, 0.4 * scale), (0.05 * scale, 0, 0.1 * scale)))
    i, j = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    d = np.stack([(i - size[0] / 2) / 12, -(j - size[1] / 2) / 12, -np.ones_like(i)], -1) @ c.c2w[:3, :3].T
    o, d = c.c2w[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)
    ends = np.sort([(-scale - o) / d, (scale - o) / d], axis=0)
    t0, t1 = ends[0].max(-1), ends[1].min(-1)
    length, sigma = (t1 - t0)[..., None], np.array([0.3, 0.6, 1.2]) / scale
    T = np.exp(-sigma * length)
    far = (t0[..., None] * (1 - T) + (1 - (1 + sigma * length) * T) / sigma).mean(-1)
    towards, E = np.array([[0.4, -0.8, 0.9], [-0.7, 0.2, 0.5]]), np.array([[5.0, 4, 3], [1, 2, 3]])
    suns = list(zip(towards / np.linalg.norm(towards, axis=1, keepdims=True), E, strict=True))
    for albedo, g in itertools.product((0.0, 1.0, (0.1, 0.9, 0.5)), (-0.9, 0.9)):
        want, n = np.zeros((*t0.shape, 3)), 200
        for t in (t0 + (k + 0.5) / n * (t1 - t0) for k in range(n)):
            p = o + t[..., None] * d
            for w, E in suns:
                out = np.where(w > 0, (scale - p) / w, (-scale - p) / w).min(-1)
                both = np.exp(-sigma * (t - t0 + out)[..., None]) * sigma * length / n
                want += both * albedo * E * lobe(g, d @ w)[..., None]
        m = media.homogeneous((-scale,) * 3, (scale,) * 3, sigma, albedo, phase=phase.henyey_greenstein(g))
        scene = Scene(medium=m, lights=[lights.directional(*sun) for sun in suns])
        picture = Path(spp=3000, max_depth=1, jitter=False).render(scene, c, seed=3)
        # the midpoint rule is off by (3 / 200)^2 / 24 of what it adds up, single precision by less
        assert_means(picture.rgb, picture.variance + (2e-5 * want) ** 2, want)
        # alpha is in [0, 1] and t within the box's diagonal, 3.5: bounds of their standard deviations
        assert np.abs(picture.alpha - (1 - T).mean(-1)).max() < 5 * 0.5 / 3000**0.5
        assert np.abs(picture.distance - far).max() < 5 * 2.9 * scale / 3000**0.5


def test_every_pixel_of_a_rough_grid_is_its_closed_form():
    """Few large cells without any symmetry, whose every corner counts: 1 - T of each pixel's ray, cell by cell."""
    rho = np.random.default_rng(5).random((4, 3, 5)) ** 3
    medium = media.grid(rho, (-1.0, -0.8, -1.2), (1.0, 1.0, 1.1), 3.0, 0.0, 1.0)
    c = camera((1.0, -3.0, 0.7), size=5, focal=8.0)
    p = Path(spp=30_000, jitter=False).render(Scene(medium=medium), c)
    want = np.empty((5, 5, 3))
    for j, i in np.ndindex(5, 5):
        d = c.c2w[:3, :3] @ [(i + 0.5 - 2.5) / 8, -(j + 0.5 - 2.5) / 8, -1.0]
        want[j, i] = 1 - sample_transmittance(medium, (1.0, -3.0, 0.7), d / np.linalg.norm(d), method="regular")[0]
    assert want.std() > 0.1
    assert_means(p.rgb, p.variance, want, bias=ROUNDING)


@pytest.mark.parametrize("eye", [(-3, 0, 0), (3, 0, 0), (0, -3, 0), (0, 3, 0), (1e-9, 0, 3), (0, 1e-9, -3)])
@pytest.mark.parametrize("lo", [-1.0, 0.0])
def test_rays_along_edges_between_bricks(eye, lo):
    """From every side along the lines where bricks meet, and along an edge of the box: no brick is missed."""
    medium = media.grid(np.ones((17, 17, 17)), (lo,) * 3, (1.0,) * 3, 2.0, 0.0, 1.0)
    c = camera(eye, size=1, focal=1e6)
    p = Path(spp=20000, jitter=False).render(Scene(medium=medium), c)
    if lo < 0:
        assert_means(p.rgb, p.variance, 1 - np.exp(-4.0), bias=ROUNDING)
    else:  # rounding decides whether an edge is inside
        assert (
            p.rgb.max() < 1e-9 or abs(p.rgb[0, 0, 0] - (1 - np.exp(-2.0))) < 5 * np.sqrt(p.variance[0, 0, 0]) + ROUNDING
        )


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_and_place_do_not_matter(scale):
    far = np.array([300.0, -200.0, 100.0]) * scale
    shape, sigma = (17, 19, 21), 6.0
    rho = media.dense(lumps(shape))
    scenes = {}
    for k, at in ((1.0, np.zeros(3)), (scale, far)):
        medium = media.grid(rho, at - k, at + k, sigma / k, 0.9, phase=phase.henyey_greenstein(0.5))
        near = lights.point(at + k * np.array([1.5, -1.0, 0.5]), 4.0 * k * k)
        scenes[k] = Scene(medium=medium, lights=[SUN, near]), camera(at + k * np.array([0.3, -3.0, 0.7]), at)
    a, b = (channels(scene, False, 200, 40, view=view) for scene, view in scenes.values())
    b[..., 4] /= scale
    assert_alike(a, b)


def test_pictures_do_not_depend_on_threads_or_bands(monkeypatch):
    kernels = importlib.import_module("_nerfvol_kernels")
    medium, lit = SCENES["points in and beside it"]
    scene, view, before = Scene(medium=medium, lights=lit), camera(size=37, focal=40.0), kernels.get_threads()
    pictures = []
    try:
        for threads, paths in ((1, 1 << 20), (5, 1 << 20), (2, 1)):
            kernels.set_threads(threads)
            monkeypatch.setattr(compiled, "PATHS_AT_ONCE", paths)
            pictures.append(Path(spp=3).render(scene, view, seed=5))
    finally:
        kernels.set_threads(before)
    for p in pictures[1:]:
        for name in ("rgb", "alpha", "distance", "variance"):
            assert np.array_equal(getattr(p, name), getattr(pictures[0], name))


def test_seeds_pixels_and_paths_are_independent():
    """Neither neighbours of a picture, nor pictures of neighbouring seeds, nor those shifted by a pixel correlate."""
    medium = media.homogeneous((-1,) * 3, (1,) * 3, 1.0, 1.0)
    scene, view = Scene(medium=medium, lights=[SUN]), Camera(64, 64, 1e6, look_at((0, -3.0, 0.1)))
    a, b = (Path(spp=1, jitter=False).render(scene, view, seed=seed).rgb[..., 0].ravel() for seed in (3, 4))
    assert len(set(a)) > 0.5 * (a > 0).sum()
    pairs = [(a, b), (a[1:], b[:-1]), (a[:-1], b[1:]), (a[1:], a[:-1]), (a[64:], a[:-64])]
    for x, y in pairs:
        # of n pairs the correlation has a deviation of 1 / sqrt(n)
        assert abs(np.corrcoef(x, y)[0, 1]) * np.sqrt(x.size) < stats.norm.isf(0.5 * sidak(1e-4, len(pairs)))
    assert not np.array_equal(
        Path(spp=1).render(scene, view, seed=2**63).rgb, Path(spp=1).render(scene, view, seed=0).rgb
    )


def test_means_of_seeds_scatter_as_their_variance_says():
    medium, lit = SCENES["grey grid, sun"]
    scene, view, runs = Scene(medium=medium, lights=lit), camera(size=1), 60
    p = [Path(spp=3000).render(scene, view, seed=seed) for seed in range(runs)]
    rgb = np.array([q.rgb[0, 0, 1] for q in p])
    chi2 = rgb.var(ddof=1) * (runs - 1) / np.mean([q.variance[0, 0, 1] for q in p])
    assert stats.chi2.ppf(5e-5, runs - 1) < chi2 < stats.chi2.isf(5e-5, runs - 1)


UNKNOWN = {
    "surfaces": Scene(medium=WHITE[0], shapes=[surfaces.plane(0, (0, 0, -2), (0, 0, 1))], materials=[materials.lambert(0.5)]),
    "area lights": Scene(medium=WHITE[0], lights=[lights.quad((0, 0, 2), (0, 1, 0), (1, 0, 0), 1.0)]),
    "microflakes": Scene(medium=lumps(phase=phase.microflakes(np.diag([1.0, 0.5, 0.2])))),
    "a mean cosine beyond 0.99": Scene(medium=lumps(phase=phase.henyey_greenstein(0.999))),
    "boundaries": Scene(medium=None, media=[WHITE[0]], lights=[SKY]),
}  # fmt: skip


@pytest.mark.parametrize("what", UNKNOWN)
@pytest.mark.filterwarnings("ignore::data_synth.RenderWarning")
def test_what_it_does_not_know_goes_to_the_textbook(what, monkeypatch):
    if what == "area lights":
        UNKNOWN[what].lights.append(SKY)
    known = compiled.unknown(UNKNOWN[what].world())
    assert known == ("surfaces" if what == "area lights" else what)
    monkeypatch.setattr(compiled, "trace", None)
    assert integrators.Path(spp=1).render(UNKNOWN[what], camera(size=2)).rgb.shape == (2, 2, 3)


def test_damaged_arrays_are_refused():
    scene = Scene(medium=WHITE[0], lights=[SUN])
    good = compiled._arrays(scene.world().medium)
    rest = {
        "lights": np.ascontiguousarray(scene.world().lights), "camera": np.zeros(16), "spp": 1, "max_depth": 1,
        "jitter": True, "opaque_sky": False, "seed": 0, "blocks": (0, 1), "first": 0, "out": np.zeros((1, 1, 8)),
    }  # fmt: skip
    compiled.core()(**good, **rest | {"camera": np.ones(16)})
    damaged = [
        ("offsets", good["offsets"] + 1), ("offsets", good["offsets"][:-1]), ("samples", good["samples"][:-1]),
        ("brick_max", good["brick_max"][1:]), ("albedo", np.zeros((0, 3))), ("whole", np.array([7, 0, 1, 1, 1])),
        ("whole", np.array([1, 0, 1, 1, 1])), ("attributes", np.zeros(3, np.float32)),
    ]  # fmt: skip
    for name, value in damaged:
        with pytest.raises(ValueError):
            compiled.core()(**good | {name: value}, **rest)
    with pytest.raises(ValueError):
        compiled.core()(**good, **rest | {"lights": np.full((1, 16), 2.0)})
    for blocks in ((0, 2), (1, 1), (-1, 1)):
        with pytest.raises(ValueError):
            compiled.core()(**good, **rest | {"blocks": blocks})


def test_parts_make_the_same_picture():
    """Bands of rows, and nodes of the tree of blocks, the last of them short."""
    scene, c, integrator = Scene(medium=WHITE[0], lights=[SUN]), camera(size=5), Path(spp=16 * 5 + 3)
    whole = integrator.render(scene, c, seed=3)
    cut = [Part(top, bottom, first, min(first + 2, 6)) for top, bottom in ((0, 2), (2, 5)) for first in (0, 2, 4)]
    sums = (integrator.sums(scene, c, 3, part) for part in cut)
    again = integrator.picture(parts.joined(cut, sums))
    for name in ("rgb", "alpha", "distance", "variance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
