"""Grids of albedo, Le, g and S, and density functions, in plain Python: test_plain.py runs this file as plain_paths.py. Their
furnaces, and what they are beside detail and other media, are in plain_combined.py.

The reference for single scattering and glow along a ray is quadrature of the equation with the formulas that filled the grids;
formulas are linear in x, y and z, so that trilinear interpolation is exact.
"""

import math

import numba
import numpy as np
import pytest

from data_synth import (
    Camera,
    DeepShadow,
    Emission,
    InputError,
    March,
    Path,
    RenderWarning,
    channels,
    lights,
    look_at,
    lookups,
    media,
    phase,
    sample_transmittance,
    sggx,
)
from data_synth.channels import Channels
from data_synth.rng import new_rng
from data_synth.scene import Scene
from tests.data_synth.kernels import SphereGrid, unit
from tests.fixtures.hypothesis_tests import assert_histogram, assert_means

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
BOX = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
SIGMA = np.array([0.5, 1.0, 2.0])
SUN = np.array([3.0, 2.0, 1.0])
Y, Z = 0.3, -0.4  # of the ray, which goes along x
EYE = (-3.0, Y, Z)


def at(formula, n=5):
    """A formula of (x, y, z) at the vertices of a grid over the box."""
    axes = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    value = formula(*axes)
    return (
        np.stack(np.broadcast_arrays(*value), axis=-1) if isinstance(value, tuple) else np.broadcast_to(value, (n,) * 3)
    )


def albedo(x, y, z):
    return 0.5 + 0.4 * x, 0.5 + 0.3 * y + 0.1 * x, 0.6 - 0.3 * z


def glow(x, y, z):
    return 1.0 - 0.5 * x, 2.0 + x + 0.5 * z, 1.0 + 0.9 * y


def bend(x, y, z):
    return 0.1 + 0.5 * x + 0.2 * y


def hg(g, cosine):
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def along_the_ray():
    """(glow, single scattering of a sun behind the eye, of cosine -1 with the g of ``bend``, with g 0) by quadrature."""
    x, w = np.polynomial.legendre.leggauss(60)
    s = x[:, None] + 1
    a, e = (np.stack(np.broadcast_arrays(*f(x, Y, Z)), axis=-1) for f in (albedo, glow))
    thin = w[:, None] * SIGMA * np.exp(-SIGMA * s)
    back = thin * np.exp(-SIGMA * s) * a * SUN
    return (
        (thin * (1 - a) * e).sum(axis=0),
        (back * hg(bend(x, Y, Z), -1.0)[:, None]).sum(axis=0),
        back.sum(axis=0) / (4 * np.pi),
    )


def pixel(eye=EYE):
    return Camera(1, 1, 50.0, look_at(eye, (0.0, eye[1], eye[2])))


BEHIND = [lights.directional((-1.0, 0.0, 0.0), tuple(SUN))]


def lit(medium, **kwargs):
    return Scene(medium=medium, lights=BEHIND, **kwargs)


def medium(n=5, step=0.05, **grids):
    return media.grid(np.ones((n,) * 3), *BOX, tuple(SIGMA), **grids)._replace(step=step)


def of_channels(**grids):
    made = channels.rgb_grid(np.broadcast_to(SIGMA, (5, 5, 5, 3)), *BOX, **grids)
    return made.with_step(0.05)


def test_nothing_here_is_compiled():
    assert numba.config.DISABLE_JIT  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


@pytest.mark.parametrize("make", [medium, of_channels])
def test_two_colour_fields_that_know_nothing_of_each_other(make):
    """Glow and scattering, each with its own dependence on place, by every integrator; a march is of second order."""
    emitted, bent, _ = along_the_ray()
    m = make(albedo=at(albedo), Le=at(glow), g=at(bend))
    dark = make(albedo=at(albedo), g=at(bend))
    for integrator, own, want in ((Emission(), m, emitted), (March(), m, emitted + bent), (March(), dark, bent)):
        off = np.abs(integrator.render(lit(own), pixel()).rgb[0, 0] - want)
        half = own.with_step(0.025) if isinstance(own, Channels) else own._replace(step=0.025)
        fine = np.abs(integrator.render(lit(half), pixel()).rgb[0, 0] - want)
        assert off.max() < (2.0 * 0.05) ** 2 / 3 * want.max()  # h^2 / 24 of J'' and 2 sigma J', J' at most 2 sigma J
        assert (fine < 0.26 * off + 1e-7).all()
    for depth, scene, want in ((0, lit(m), emitted), (1, lit(dark), bent)):
        picture = Path(spp=250, jitter=False, max_depth=depth, textbook=True).render(scene, pixel())
        assert_means(picture.rgb, picture.variance, want)


def test_deep_maps_read_the_fields_and_gathered_light_does_without_g():
    """A map of samples h apart and J between samples h apart are off by (sigma h)^2 / 8 of the brightest at most, each."""
    emitted, bent, even = along_the_ray()
    grey = media.grid(np.ones((17,) * 3), *BOX, 1.0, at(albedo, 17), at(glow, 17))._replace(step=0.02)
    x, w = np.polynomial.legendre.leggauss(60)
    a, e = (np.stack(np.broadcast_arrays(*f(x, Y, Z)), axis=-1) for f in (albedo, glow))
    thin = (w * np.exp(-(x + 1)))[:, None]
    want = (thin * ((1 - a) * e + np.exp(-(x + 1))[:, None] * a * SUN / (4 * np.pi))).sum(axis=0)
    gathered = DeepShadow().render(lit(grey), pixel()).rgb[0, 0]
    assert np.abs(gathered - want).max() < (0.125**2 / 4 + 1e-3) * want.max()
    m = medium(albedo=at(albedo), Le=at(glow), g=at(bend))
    mapped = DeepShadow(resolution=17).render(lit(m), pixel()).rgb[0, 0]
    assert np.abs(mapped - emitted - bent).max() < (2.0 * 0.125) ** 2 / 8 * bent.max() + 6e-3
    assert np.abs(bent / even - 1).max() > 0.3  # g matters


def test_a_further_medium_has_its_fields_too():
    m = medium(albedo=at(albedo), Le=at(glow), g=at(bend))
    scene = lit(None, media=[m])
    from data_synth import materials, surfaces

    scene.materials, scene.shapes = [materials.null(1)], [surfaces.box(0, *BOX)]
    for integrator in (March(), Path(spp=8, jitter=False, textbook=True)):
        first, second = (integrator.render(s, pixel()).rgb for s in (lit(m), scene))
        assert np.allclose(first, second, rtol=1e-9) and first.min() > 0


def varied(rng, n=3):
    """A medium of flakes that differ at every sample, some of them nearly flat."""
    axes = rng.normal(size=(n**3, 3))
    rows = [(sggx.fibre, sggx.surface)[k % 2](axis, 10.0 ** -(k % 4)) for k, axis in enumerate(axes)]
    S = np.stack(rows).reshape(n, n, n, 6)
    return media.grid(np.ones((n,) * 3), *BOX, S=S), S


def test_flakes_are_mixed_and_stay_positive():
    """S(x) is the trilinear mixture of the samples; its extinction has its majorant; nearly flat flakes survive rounding."""
    rng = np.random.default_rng(0)
    m, S = varied(rng)
    for p in rng.uniform(-1, 1, (300, 3)):
        u = p + 1.0
        i = np.minimum(u.astype(int), 1)
        f = u - i
        want = sum(np.prod(np.where(c, f, 1 - f)) * S[tuple(i + c)] for c in (np.array(c) for c in np.ndindex(2, 2, 2)))
        found = np.array(lookups.phase_at(m, tuple(p)).own)
        assert np.allclose(found, want, atol=1e-6)
        assert np.linalg.eigvalsh(sggx.matrices(found))[0] > 0
        d = unit(*rng.normal(size=3))
        assert 0 < lookups.extinction(m, tuple(p), d) <= m.flake_area
    long = np.broadcast_to(sggx.check_sggx(np.diag([4.0, 1.0, 0.25])), (2, 2, 2, 6))
    assert media.grid(np.ones((2,) * 3), *BOX, S=long).flake_area == pytest.approx(2.0, rel=1e-6)
    for axis in rng.normal(size=(40, 3)):  # 1e-8: less than single precision resolves
        flat = np.broadcast_to(sggx.surface(axis, 1e-4), (2, 2, 2, 6))
        own = lookups.phase_at(media.grid(np.ones((2,) * 3), *BOX, S=flat), (0.3, 0.2, 0.1)).own
        assert np.linalg.eigvalsh(sggx.matrices(np.array(own)))[0] > 0


@pytest.mark.parametrize("kind", ["g", "S"])
def test_sampling_at_a_varying_point(kind):
    """Normalised, chi-square of the samples, and reciprocal with the extinction."""
    rng = np.random.default_rng(1)
    n = 3
    S = np.stack([sggx.fibre(axis, 0.4) for axis in rng.normal(size=(n**3, 3))]).reshape(n, n, n, 6)
    m = media.grid(np.ones((n,) * 3), *BOX, g=at(bend, n) if kind == "g" else None, S=S if kind == "S" else None)
    p, wo = (0.37, -0.21, 0.55), unit(0.3, -0.5, 0.8)
    f = lookups.phase_at(m, p)
    sphere = SphereGrid(8, 8, 6)
    values = np.array([phase.evaluate(f, 0.0, wo, tuple(wi), None) for wi in sphere.directions])
    assert sphere.integrate(values) == pytest.approx(1.0, abs=2e-3)
    stream = new_rng(3, 0)
    drawn = np.array([phase.sample(f, 0.0, wo, stream) for _ in range(4000)])
    expected = sphere.per_bin(values)
    assert_histogram(sphere.histogram(drawn), expected * 4000 / expected.sum())
    for wi in (unit(*rng.normal(size=3)) for _ in range(20)):
        there = lookups.extinction(m, p, wo) * phase.evaluate(f, 0.0, wo, wi, None)
        assert there == pytest.approx(lookups.extinction(m, p, wi) * phase.evaluate(f, 0.0, wi, wo, None))
    if kind == "g":
        assert f.g1 == pytest.approx(bend(*p), abs=1e-6)


def test_fibres_of_one_density_are_not_taken_for_dust():
    """Their lowest extinction is not their density: residual tracking found e^-rho L for them, whatever their direction."""
    S = np.broadcast_to(sggx.fibre((1, 0, 0), 0.3), (9, 9, 9, 6))  # a whole brick: its lowest density is 1
    want = np.exp(-2.0 * 0.3 * SIGMA)  # along the fibres
    for made in (
        media.grid(np.ones((9,) * 3), *BOX, tuple(SIGMA), S=S),
        media.grid(np.ones((9,) * 3), *BOX, tuple(SIGMA), phase=phase.microflakes(sggx.fibre((1, 0, 0), 0.3))),
    ):
        m = made._replace(flake_area=1.0)  # which it is, but for rounding
        for method in ("residual", "ratio"):
            T = sample_transmittance(m, EYE, (1.0, 0.0, 0.0), method=method, n=300)
            assert_means(T.mean(axis=0), T.var(axis=0, ddof=1) / len(T), want, bias=1e-6)


@pytest.mark.parametrize("grids, message", [
    ({"g": np.ones((5,) * 3)}, r"g must be in \(-1, 1\)"), ({"g": np.zeros((4,) * 3)}, "g must have the density's samples"),
    ({"albedo": 2 * np.ones((5, 5, 5, 3))}, r"albedo must be in \[0, 1\]"), ({"Le": -np.ones((5,) * 3)}, "Le must be finite"),
    ({"Le": np.ones((5, 5, 5, 2))}, r"shape \(5, 5, 5\) or \(5, 5, 5, 3\), got \(5, 5, 5, 2\)"),
    ({"S": np.zeros((5, 5, 5, 6))}, "S must be positive definite"), ({"S": np.ones((5, 5, 5, 6))}, "S must be positive"),
    ({"g": np.zeros((5,) * 3), "phase": phase.rayleigh()}, "Henyey-Greenstein"),
    ({"S": np.tile([1.0, 1, 1, 0, 0, 0], (5, 5, 5, 1)), "phase": phase.rayleigh()}, "belongs to SGGX microflakes"),
    ({"S": np.tile([1.0, 1, 1, 0, 0, 0], (5, 5, 5, 1)), "g": np.zeros((5,) * 3)}, "got both"),
])  # fmt: skip
def test_grids_that_are_no_coefficients(grids, message):
    with pytest.raises(InputError, match=message):
        medium(**grids)


def fog(x, y, z):
    return math.exp(-(z + 1.0) / 0.5)


def wall(x, y, z):
    return 2.0


def hole(x, y, z):
    return -1.0 if x < 0 else math.nan


def test_a_density_function_is_what_its_formula_is():
    """The exponential atmosphere as a function against its closed form: T, glow, alpha and single scattering."""
    layers = np.exp(-np.arange(8) * 0.25 / 0.5).reshape(1, 1, 8)
    closed = media.exponential(*BOX, 0.5, tuple(SIGMA), 0.5, 1.0)
    m = media.procedural(fog, *BOX, layers, tuple(SIGMA), 0.5, 1.0, step=0.02)
    o, d = EYE, unit(1.0, 0.02, 0.15)
    exact = sample_transmittance(closed, o, d, method="closed")[0]
    for method in ("ratio", "residual", "delta"):
        T = sample_transmittance(m, o, d, method=method, n=1500)
        assert_means(T.mean(axis=0), T.var(axis=0, ddof=1) / len(T), exact)
    for integrator in (Emission(), March()):
        function, formula = (integrator.render(lit(x), pixel()) for x in (m, closed._replace(step=0.02)))
        assert np.allclose(function.rgb, formula.rgb, rtol=1e-9 if integrator == Emission() else 4e-4)
        assert np.allclose(function.alpha, formula.alpha) and np.allclose(function.distance, formula.distance)
    march = March().render(lit(closed._replace(step=0.005)), pixel()).rgb
    dark = m._replace(Le=np.zeros((1, 3)))
    bare = march - Emission().render(lit(closed._replace(step=0.005)), pixel()).rgb
    picture = Path(spp=400, jitter=False, max_depth=1, textbook=True).render(lit(dark), pixel())
    assert_means(picture.rgb, picture.variance, bare, bias=1e-4)


def test_what_is_above_the_majorant_is_counted_and_cut_off():
    m = media.procedural(wall, *BOX, 1.5, 1.0, step=0.1)
    for method in ("ratio", "march"):
        with pytest.warns(RenderWarning, match=r"above its majorant in \d+ look-ups or more, up to 1.33 times"):
            T = sample_transmittance(m, EYE, (1.0, 0.0, 0.0), method=method, n=300 if method == "ratio" else 1)
        assert_means(T.mean(axis=0), T.var(axis=0) / len(T), np.exp(-3.0))
    with pytest.warns(RenderWarning, match="negative or no number in 20 look-ups"):
        T = sample_transmittance(media.procedural(hole, *BOX, 1.0, 1.0, step=0.1), EYE, (1.0, 0.0, 0.0), method="march")
    assert (T == 1.0).all()
    with pytest.warns(RenderWarning, match="above its majorant"):
        March().render(lit(m), pixel())
    fine = media.procedural(fog, *BOX, 1.0)
    scene = lit(fine)
    before = scene.fingerprint()
    assert not fine.faults.any()
    fine.faults[0] = 1.0
    assert scene.fingerprint() == before  # what is counted changes no scene


@pytest.mark.parametrize("arguments, message", [
    ({"majorant": -1.0}, "majorant"), ({"majorant": math.nan}, "majorant"), ({"majorant": [1.0, 2.0]}, "majorant"),
    ({"majorant": 1.0, "step": 0.0}, "positive step"),
])  # fmt: skip
def test_majorants_that_are_none(arguments, message):
    with pytest.raises(InputError, match=message):
        media.procedural(fog, *BOX, **arguments)
    with pytest.raises(InputError, match="regular tracking"):
        sample_transmittance(media.procedural(fog, *BOX, 1.0), EYE, (1.0, 0.0, 0.0), method="regular")
