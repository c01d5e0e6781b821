"""Microflakes of any distribution in plain Python (NUMBA_DISABLE_JIT=1; test_plain.py runs it), alone and in SpongeCake."""

import numpy as np
import pytest

from data_synth import (
    Camera,
    Path,
    fresnel,
    lights,
    look_at,
    lookups,
    media,
    microflakes,
    phase,
    pool,
    sggx,
    spongecake,
    surfaces,
)
from data_synth.errors import InputError
from data_synth.materials import null, refracted
from data_synth.microflakes import GLOSSY, REFRACTIVE, Normals
from data_synth.rng import new_rng
from data_synth.scene import Scene
from tests.data_synth.kernels import SphereGrid, unit
from tests.fixtures.hypothesis_tests import assert_histogram, assert_means

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
AXIS = unit(0.3, -0.2, 0.8)
S = sggx.check_sggx(np.array([[0.9, 0.1, -0.2], [0.1, 0.5, 0.1], [-0.2, 0.1, 0.6]]))
WO, WI = unit(0.3, -0.5, 0.8), unit(-0.7, 0.1, 0.2)


def closed(m):
    return np.array([sggx.normal_density(tuple(S), tuple(v)) for v in m])


TABLES = {
    "SGGX": microflakes.tabulated(closed, 32),
    "Beckmann": microflakes.beckmann(AXIS, 0.5, 32),
    "GGX": microflakes.ggx(AXIS, 0.5, 32),
    "facing": microflakes.trigonometric(AXIS, 8, resolution=32),
    "fibre": microflakes.trigonometric(AXIS, 6, fibre=True, resolution=32),
}


SECOND = {name: microflakes.together([TABLES["facing"], TABLES[name]]) for name in ("Beckmann", "fibre")}


def normals(name):
    return Normals(spongecake.FLAKES, TABLES[name], 0)


@pytest.mark.parametrize("name", TABLES)
def test_projected_area_is_the_integral_over_normals(name):
    """On another grid than the table's own. What is left is the bilinear error of D and sigma, h^2/8 times the second
    derivative: h = pi/64, and sigma'' / sigma stays below 4 for roughness 1/2."""
    grid, n = SphereGrid(16, 16, 3), normals(name)
    D = np.array([microflakes.normal_density(n, tuple(m)) for m in grid.directions])
    for w in (WO, WI, unit(0.1, 0.9, -0.4)):
        area = grid.integrate(np.maximum(grid.directions @ np.array(w), 0) * D)
        assert microflakes.projected_area(n, w) == pytest.approx(area, rel=3e-3)
    assert (D >= 0).all() and D.max() > 0


def test_tables_are_scaled_as_they_say():
    """Facing flakes seen along their axis project to 1, whatever the roughness: that is what Beckmann and GGX are."""
    for name in ("Beckmann", "GGX"):
        assert microflakes.projected_area(normals(name), AXIS) == pytest.approx(1.0, rel=5e-3)
    for name in ("facing", "fibre"):
        assert TABLES[name].sigma.max() == pytest.approx(1.0)
    across = unit(*np.cross(AXIS, (1, 0, 0)))
    assert (
        microflakes.projected_area(normals("facing"), across)
        < 0.5
        < microflakes.projected_area(normals("fibre"), across)
    )
    # |cos|^n integrates over max(cos, 0) to 2 pi / (n + 2) on its axis, and D is (n + 2) / 2 pi there
    assert microflakes.normal_density(normals("facing"), AXIS) == pytest.approx(10 / (2 * np.pi), rel=2e-2)


def test_a_tabulated_sggx_is_sggx():
    n, flat = normals("SGGX"), Normals(tuple(S), microflakes.EMPTY, -1)
    grid = SphereGrid(5, 5, 2)
    for k, w in enumerate(map(tuple, grid.directions)):
        assert microflakes.projected_area(n, w) == pytest.approx(microflakes.projected_area(flat, w), rel=2e-3)
        assert microflakes.normal_density(n, w) == pytest.approx(microflakes.normal_density(flat, w), rel=1e-2)
        if k % 10 == 0:
            table, own = (
                phase.evaluate(p, 0.0, WO, w, None) for p in (phase.microflakes(TABLES["SGGX"]), phase.microflakes(S))
            )
            assert table == pytest.approx(own, rel=1.5e-2)
    ggx, surface = normals("GGX"), Normals(tuple(sggx.surface(AXIS, 0.5)), microflakes.EMPTY, -1)
    assert microflakes.projected_area(ggx, WI) == pytest.approx(microflakes.projected_area(surface, WI), rel=3e-3)


def test_opposite_normals_are_one_flake_whatever_the_values_say():
    values = np.random.default_rng(0).random((5, 8))
    n = Normals(spongecake.FLAKES, microflakes.tabulated(values), 0)
    for m in (unit(np.cos(0.3), np.sin(0.3), 0.0), unit(0.2, -0.7, 0.4), unit(-1, 0.1, 1e-9)):
        back = tuple(-x for x in m)
        assert microflakes.normal_density(n, m) == pytest.approx(microflakes.normal_density(n, back), rel=1e-6)
        assert microflakes.projected_area(n, m) == pytest.approx(microflakes.projected_area(n, back), rel=1e-6)
    pole = [microflakes.normal_density(n, unit(1e-9 * np.cos(a), 1e-9 * np.sin(a), 1.0)) for a in range(6)]
    assert np.ptp(pole) < 1e-6


@pytest.mark.parametrize("name", ["Beckmann", "fibre"])
def test_visible_normals_and_mirrored_directions_follow_their_densities(name):
    n, ph, count = Normals(spongecake.FLAKES, SECOND[name], 1), phase.microflakes(TABLES[name]), 1500
    grid, rng = SphereGrid(8, 6, 3), new_rng(1, 0)
    D = np.array([microflakes.normal_density(n, tuple(m)) for m in grid.directions])
    seen = grid.per_bin(np.maximum(grid.directions @ np.array(WO), 0) * D)
    drawn = np.array([microflakes.sample_visible_normal(n, WO, rng) for _ in range(count)])
    assert (drawn @ np.array(WO) > 0).all()
    assert_histogram(grid.histogram(drawn), count * seen / seen.sum())
    f = grid.per_bin(np.array([phase.evaluate(ph, 0.0, WO, tuple(w), rng) for w in grid.directions]))
    assert f.sum() == pytest.approx(1.0, rel=1e-2)
    drawn = np.array([phase.sample(ph, 0.0, WO, rng) for _ in range(count)])
    assert_histogram(grid.histogram(drawn), count * f / f.sum())


@pytest.mark.parametrize("name", TABLES)
def test_reciprocity(name):
    ph = phase.microflakes(TABLES[name])
    there = phase.evaluate(ph, 0.0, WO, WI, None) * phase.projected_area(ph, 0.0, WO)
    back = phase.evaluate(ph, 0.0, WI, WO, None) * phase.projected_area(ph, 0.0, WI)
    assert there == pytest.approx(back, rel=1e-12) and there > 0


@pytest.mark.parametrize(("micro", "a", "ior"), [(GLOSSY, 0.3, 1.5), (GLOSSY, 1.0, 1.5), (REFRACTIVE, 0.2, 1.8)])
def test_a_flake_keeps_all_light_and_is_reciprocal(micro, a, ior):
    m = AXIS
    first, second = microflakes.frame(m)
    u, turn = (np.arange(100) + 0.5) / 100, (np.arange(48) + 0.5) * 2 * np.pi / 48
    for co in (0.8, 0.2):
        wo = tuple(co * np.array(m) + np.sqrt(1 - co * co) * np.array(first))
        total = 0.0
        for side in (1.0, -1.0):
            for ui in u:
                flat = np.sqrt(ui) * (
                    np.cos(turn)[:, None] * np.array(first) + np.sin(turn)[:, None] * np.array(second)
                )
                for wi in flat + side * np.sqrt(1 - ui) * np.array(m):
                    total += microflakes.micro_density(micro, a, ior, m, wo, tuple(wi)) / np.sqrt(1 - ui)
        # the measure of the projected disc, du dphi / 2; edges of the blur in u are met to half a step of 1/100
        assert total * 0.5 * (2 * np.pi) / (100 * 48) == pytest.approx(1.0, abs=1 / 100 / a + 2e-3)
    rng = np.random.default_rng(0)
    for _ in range(200):
        wo, wi = (unit(*v) for v in rng.normal(size=(2, 3)))
        back = tuple(-x for x in m)
        mo, mi = (m if np.dot(m, w) > 0 else back for w in (wo, wi))
        there = microflakes.micro_density(micro, a, ior, mo, wo, wi) * abs(np.dot(m, wo))
        assert there == pytest.approx(
            microflakes.micro_density(micro, a, ior, mi, wi, wo) * abs(np.dot(m, wi)), rel=1e-9
        )


@pytest.mark.parametrize(("micro", "a"), [(GLOSSY, 0.4), (REFRACTIVE, 0.7)])
def test_light_leaves_a_flake_as_its_density_says(micro, a):
    grid, count, rng = SphereGrid(8, 8, 4), 2000, new_rng(2, 0)
    m, wo = (0.0, 0.0, 1.0), unit(0.5, 0.2, 0.6)
    p = grid.per_bin(np.array([microflakes.micro_density(micro, a, 1.6, m, wo, tuple(w)) for w in grid.directions]))
    drawn = np.array([microflakes.micro_sample(micro, a, 1.6, m, wo, rng) for _ in range(count)])
    assert_histogram(grid.histogram(drawn), count * p / p.sum())


def test_smooth_flakes_are_a_mirror_and_a_pane():
    """At a blur of 1e-6 light goes to the mirrored direction or straight on, R = 2F / (1 + F) of it mirrored."""
    m, wo, rng = (0.0, 0.0, 1.0), unit(0.5, 0.2, 0.6), new_rng(3, 0)
    mirrored = np.array([-wo[0], -wo[1], wo[2]])
    assert np.allclose(microflakes.micro_sample(GLOSSY, 1e-6, 1.5, m, wo, rng), mirrored, atol=1e-2)
    drawn = np.array([microflakes.micro_sample(REFRACTIVE, 1e-6, 1.5, m, wo, rng) for _ in range(4000)])
    up = drawn[:, 2] > 0
    # tails of the turn's Cauchy distribution reach far: 2 c / (1 - c) of width 1e-6
    assert np.median(np.abs(drawn[up] - mirrored).max(axis=1)) < 1e-5
    assert np.median(np.abs(drawn[~up] + np.array(wo)).max(axis=1)) < 1e-5
    F = refracted(m, wo, 1 / 1.5)[1]
    want = 2 * F / (1 + F)
    assert abs(up.mean() - want) < 4 * np.sqrt(want * (1 - want) / 4000)


def test_fresnel_of_glass_and_metal():
    for cosine in (1.0, 0.7, 0.1):
        for eta in (1.5, 1 / 1.5):
            wo = (np.sqrt(1 - cosine**2), 0.0, cosine)
            assert fresnel.reflectance(cosine, eta, 0.0) == pytest.approx(
                refracted((0, 0, 1), wo, 1 / eta)[1], abs=1e-12
            )
    eta, k = 0.2, 3.4
    assert fresnel.reflectance(1.0, eta, k) == pytest.approx(((eta - 1) ** 2 + k * k) / ((eta + 1) ** 2 + k * k))
    assert fresnel.reflectance(1e-9, eta, k) == pytest.approx(1.0) and fresnel.schlick(0.0, 0.3) == 1.0
    assert fresnel.schlick(1.0, 0.3) == 0.3


FURNACES = {
    "Beckmann, specular": phase.microflakes(TABLES["Beckmann"]),
    "fibre, glossy": phase.microflakes(TABLES["fibre"], micro="glossy", roughness=0.5),
    "SGGX, refractive": phase.microflakes(S, micro="refractive", roughness=0.2, ior=1.4),
}


@pytest.mark.parametrize("name", FURNACES)
def test_a_white_furnace(name):
    """A lossless ball under a sky of one brightness disappears, whatever its flakes."""
    ball = media.homogeneous((-1,) * 3, (1,) * 3, sigma_t=2.0, albedo=1.0, phase=FURNACES[name])
    scene = Scene(medium=ball, bounded=True, opaque_sky=True, shapes=[surfaces.sphere(0, (0, 0, 0), 0.8)], materials=[null()],
                  lights=[lights.environment(0.6)])  # fmt: skip
    picture = Path(spp=150, jitter=False).render(scene, Camera(1, 1, 50.0, look_at((0.1, -3.0, 0.2), (0.1, 0, 0.1))))
    assert_means(picture.rgb, picture.variance, np.full(3, 0.6))


def test_a_medium_of_many_keeps_its_flakes():
    air = media.homogeneous((0, 0, 0), (1, 1, 1))
    m = media.homogeneous((0, 0, 0), (1, 1, 1), phase=phase.microflakes(TABLES["fibre"], TABLES["GGX"], micro="glossy"))
    got = pool.medium_at(pool.pool([air, m, air]), 1)
    assert got.phase[5:8] == m.phase[5:8] and all(
        np.array_equal(a, b) for a, b in zip(got.phase.table, m.phase.table, strict=True)
    )
    assert lookups.extinction(got, (0.5,) * 3, WO) == phase.projected_area(m.phase, 0.0, WO) != 1.0
    assert phase.projected_area(m.phase, 1.0, WO) != phase.projected_area(m.phase, 0.0, WO)
    assert m.flake_area == m.phase.table.sigma.max()
    kind = np.broadcast_to(np.linspace(0, 1, 3)[:, None, None], (3, 3, 3))
    mixed = media.grid(np.ones((3, 3, 3)), (0, 0, 0), (1, 1, 1), phase=m.phase, attribute=kind)
    for x in (0.1, 0.9):
        assert lookups.extinction(mixed, (x, 0.5, 0.5), WO) == phase.projected_area(m.phase, np.float32(x), WO)


FACING = microflakes.beckmann((0, 0, 1), 0.5, 32)
CAKES = {
    "Beckmann, glass": spongecake.layer(0.6, FACING, 1.0, eta=1.5),
    "fibre, gold": spongecake.layer(0.9, TABLES["fibre"], 1.0, eta=(0.2, 0.4, 1.4), k=(3.4, 2.4, 1.9)),
    "SGGX, Schlick": spongecake.layer(0.4, sggx.fibre(unit(1, 0.3, 0.1), 0.5), (0.6, 0.3, 0.1), schlick=True),
}


@pytest.mark.parametrize("wi", [unit(-0.5, 0.6, 0.4), unit(0.1, 0.7, -0.6)])
def test_layers_agree_with_an_integral_over_depth(wi):
    """Of three layers: what reaches depth t of a layer, meets a flake that mirrors it, F of that, and leaves."""
    layers = spongecake.stack(list(CAKES.values()))
    wo, n = unit(0.4, -0.2, 0.7), 4000
    want, h = np.zeros(3), unit(*(np.array(wo) + wi))
    cosine = float(np.dot(h, wo))
    taus = layers.rows[:, 0]
    flakes = [Normals(spongecake.FLAKES, table, 0) for table in (FACING, TABLES["fibre"])]
    flakes.append(Normals(tuple(sggx.fibre(unit(1, 0.3, 0.1), 0.5)), microflakes.EMPTY, -1))
    slants = np.array([[microflakes.projected_area(s, w) / abs(w[2]) for w in (wo, wi)] for s in flakes])
    F = (
        [fresnel.reflectance(cosine, 1.5, 0.0)] * 3,
        [fresnel.reflectance(cosine, eta, k) for eta, k in ((0.2, 3.4), (0.4, 2.4), (1.4, 1.9))],
        [f + (1 - f) * (1 - cosine) ** 5 for f in (0.6, 0.3, 0.1)],
    )
    for k in range(3):
        t = (np.arange(n) + 0.5) / n * taus[k]
        legs = np.ones(n)
        for leg, w in enumerate((wo, wi)):
            others = slice(0, k) if w[2] > 0 else slice(k + 1, 3)
            within = t if w[2] > 0 else taus[k] - t
            legs = legs * np.exp(-taus[others] @ slants[others, leg]) * np.exp(-within * slants[k, leg])
        D = microflakes.normal_density(flakes[k], h)
        want += np.array(F[k]) * D / (4 * abs(wo[2] * wi[2])) * legs.mean() * taus[k]
    got = spongecake.evaluate(layers, 0, 3, wo, wi)
    assert got == pytest.approx(want, rel=1e-6) and min(got) > 0 and len(set(got)) == 3
    assert spongecake.evaluate(layers, 0, 3, wi, wo) == pytest.approx(got, rel=1e-9)


@pytest.mark.parametrize(("lo", "gap"), [(1.3, 0.0), (0.2, 1e-7), (2.0, 1e-5)])
def test_transmission_where_the_slants_meet(lo, gap):
    """Two points of Gauss's rule over the depth are exact to (tau gap)^4."""
    tau, t = 0.7, 0.5 + 0.5 / np.sqrt(3) * np.array([-1.0, 1.0])
    want = tau * np.mean(np.exp(-tau * (t * lo + (1 - t) * (lo + gap))))
    assert spongecake.depth_integral(tau, lo, lo + gap, False) == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(("names", "side"), [*((name, 1.0) for name in CAKES), (None, 1.0), (None, -1.0)])
def test_layers_of_any_flakes_are_sampled_by_their_pdf(names, side):
    """Each alone, and all three from above and below."""
    cakes = [CAKES[name] for name in ([names] if names else CAKES)]
    layers, wo, count, rng = spongecake.stack(cakes), unit(0.4, -0.2, 0.7 * side), 1500, new_rng(4, 0)
    grid, n = SphereGrid(8, 8, 4 if names else 3), len(cakes)
    expected = grid.per_bin(np.array([spongecake.pdf(layers, 0, n, wo, tuple(w)) for w in grid.directions]))
    drawn = [spongecake.sample(layers, 0, n, wo, rng) for _ in range(count)]
    scattered = np.array([w for w, straight in drawn if not straight])
    through = spongecake.attenuation(layers, 0, n, wo)
    assert expected.sum() == pytest.approx(1 - through, rel=1e-2)
    assert abs(len(scattered) / count - (1 - through)) < 4 * np.sqrt(through * (1 - through) / count)
    assert_histogram(grid.histogram(scattered), len(scattered) * expected / expected.sum())


@pytest.mark.parametrize("sentence", [
    (lambda: microflakes.tabulated(lambda m: m[:, 2]), "not negative"),
    (lambda: microflakes.tabulated(lambda m: m), "one number for each normal"),
    (lambda: microflakes.tabulated(np.ones((4, 3))), "even number of columns"),
    (lambda: microflakes.beckmann((0, 0, 1), 0.0), "roughness of a table"),
    (lambda: phase.microflakes(S, TABLES["GGX"]), "got both"),
    (lambda: phase.microflakes(S, micro="shiny"), "specular, diffuse, glossy, refractive"),
    (lambda: phase.microflakes(S, micro="refractive", ior=0.5), "ior"),
    (lambda: microflakes.together([TABLES["GGX"], microflakes.ggx(AXIS, 0.5, 16)]), "one resolution"),
    (lambda: spongecake.layer(1.0, S, 0.5, schlick=True, eta=1.5), "got both"),
    (lambda: spongecake.layer(1.0, S, 0.5, eta=0.0), "eta must be positive"),
])  # fmt: skip
def test_what_is_no_flake_is_refused(sentence):
    make, said = sentence
    with pytest.raises(InputError, match=said):
        make()
