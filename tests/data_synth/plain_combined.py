"""Media that are several things at once, in plain Python (NUMBA_DISABLE_JIT=1; test_plain.py runs it): detail below the grid
with grids of albedo, Le, g and S, which plain_fields.py tests one by one; flakes of every kind on a grid of S; furnaces of them
all; all of it in a scene of many media and in its truth."""

import numpy as np
import pytest

from data_synth import (
    Camera,
    Emission,
    Path,
    RenderWarning,
    compiled,
    detail,
    gather,
    lights,
    look_at,
    lookups,
    materials,
    media,
    microflakes,
    noise,
    phase,
    pool,
    sggx,
    surfaces,
    truth,
    volumes,
    weather,
)
from data_synth.march import Lighting, preview_energy, preview_source
from data_synth.rng import new_rng
from data_synth.scene import Scene
from data_synth.shadowmap import none
from data_synth.vdb import read_vdb
from tests.fixtures.hypothesis_tests import assert_means

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
BOX = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
N = 11  # samples: more than a brick
SKY = np.array([0.7, 0.4, 0.2])
RNG = np.random.default_rng(6)
DENSITY = np.clip(1.5 * RNG.random((N,) * 3), 0, 1)
ALBEDO, BEND = RNG.random((N, N, N, 3)), RNG.uniform(-0.8, 0.8, (N,) * 3)
FIBRES = np.stack([sggx.fibre(axis, 0.4) for axis in RNG.normal(size=(N**3, 3))]).reshape(N, N, N, 6)
WARM = {"albedo": ALBEDO, "Le": np.broadcast_to(SKY, (N, N, N, 3))}
WHITE = {"albedo": np.ones((N,) * 3)}


@pytest.fixture(scope="module")
def textures():
    rng = np.random.default_rng(3)
    base, fine = (np.kron(rng.random((4, 4, 4, c)), np.ones((2, 2, 2, 1))).astype(np.float32) for c in (4, 3))
    return noise.CloudTextures(base, fine, noise.curl_texture(6, 0))


@pytest.fixture(scope="module")
def fine(textures):
    return detail.detail(textures, (3.0, 2.0, 5.0), 0.6, 2)


def medium(fine, **grids):
    return media.grid(DENSITY, *BOX, (2.0, 1.5, 1.0), detail=fine, **grids)


def pixel():
    return Camera(1, 1, 50.0, look_at((-3.0, 0.3, -0.2), (0.0, 0.3, -0.2)))


@pytest.mark.parametrize("eroded, grids", [
    (False, {"g": BEND, **WARM}), (False, {"g": BEND, **WHITE}), (False, {"S": FIBRES, **WARM}),
    (False, {"S": FIBRES, **WHITE}), (True, {"g": BEND, **WARM}), (True, {"g": BEND, **WHITE}), (True, {"S": FIBRES, **WARM}),
    (True, {"S": FIBRES, "phase": phase.microflakes(np.eye(3), micro="glossy", roughness=0.9), **WHITE}),
    (True, {"S": FIBRES, "phase": phase.microflakes(np.eye(3), micro="refractive"), **WARM}),
    (True, {"phase": phase.microflakes(microflakes.beckmann((1, 0, 0), 0.5, 16)), **WARM}),
], ids=["g, warm", "g, white", "S, warm", "S, white", "g, warm, eroded", "g, white, eroded", "S, warm, eroded",
        "S glossy, white, eroded", "S refractive, warm, eroded", "table, warm, eroded"])  # fmt: skip
def test_furnaces(fine, eroded, grids):
    """What glows as the sky does, or loses nothing, is not seen, whatever varies in it and however its density is eroded."""
    own = medium(fine if eroded else None, **grids)
    scene = Scene(medium=own, opaque_sky=True, lights=[lights.environment(tuple(SKY))])
    picture = Path(spp=80, jitter=False, textbook=True).render(scene, pixel())
    assert_means(picture.rgb, picture.variance, SKY)


def test_glow_of_an_eroded_density_with_colours_of_its_own(fine):
    """The midpoint rule over the same line, 30 times as fine; the ray's own steps are off by their square."""
    m = medium(fine, **WARM)
    own, h = np.zeros(3), 2.0 / 3000
    T = np.ones(3)
    for k in range(3000):
        p = (-1.0 + (k + 0.5) * h, 0.3, -0.2)
        kept = np.exp(-h * lookups.density(m, p) * np.array(m.sigma_t))
        albedo = np.array(lookups.albedo_at(m, p, 0.0))
        own, T = own + T * (1 - kept) * (1 - albedo) * SKY, T * kept
    bare = Emission().render(Scene(medium=m._replace(detail=detail.NONE)), pixel()).rgb[0, 0]
    found = Emission().render(Scene(medium=m._replace(step=0.01)), pixel()).rgb[0, 0]
    assert np.abs(found / own - 1).max() < 2e-3 and (bare > 1.03 * found).all()


def test_a_medium_of_many_keeps_all_that_it_has(fine):
    """Each between two others that have what it lacks."""

    def wave(x, y, z):
        return 0.5 + 0.25 * x

    table = phase.microflakes(microflakes.ggx((0, 0, 1), 0.4, 8), microflakes.ggx((1, 0, 0), 0.4, 8), micro="glossy")
    many = [
        medium(fine, S=FIBRES, phase=phase.microflakes(np.eye(3), micro="refractive", ior=1.3), **WARM),
        media.procedural(wave, *BOX, np.ones((1, 2, 3)), Le=0.5, phase=table),
        media.grid(DENSITY, *BOX, g=BEND, attribute=DENSITY), medium(fine, phase=table, albedo=ALBEDO),
        media.exponential(*BOX, 0.7, (1.0, 2.0, 3.0), 0.5, phase=phase.two_lobes(0.7, -0.4, 0.3)),
    ]  # fmt: skip
    together = pool.pool(many)

    def same(a, b):
        if isinstance(a, tuple):
            return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
        return np.array_equal(a, b)

    for k, m in enumerate(many):
        got = pool.medium_at(together, k)
        assert [name for name in m._fields if not same(getattr(m, name), getattr(got, name))] == []
        for p in RNG.uniform(-1, 1, (5, 3)):
            d = p / np.linalg.norm(p)
            assert lookups.extinction(got, tuple(p), tuple(d)) == lookups.extinction(m, tuple(p), tuple(d))


def test_the_fast_ways_leave_it_to_the_others(fine, monkeypatch):
    sun = [lights.directional((0, 0, 1), 1.0)]
    plain = media.grid(DENSITY, *BOX)
    assert gather.possible(Scene(medium=plain, lights=sun).world())
    assert compiled.unknown(Scene(medium=plain, lights=sun).world()) == ""
    for m, why in (
        (media.grid(DENSITY, *BOX, detail=fine), "detail below the grid"),
        (media.grid(DENSITY, *BOX, g=BEND), "grids of albedo, Le, g or S"),
    ):
        world = Scene(medium=m, lights=sun).world()
        assert not gather.possible(world) and compiled.unknown(world) == why
    lamp, ball = lights.point((0, 0, 3), 1.0), surfaces.sphere(0, (0, 0, 0), 0.8)
    for scene in (
        Scene(medium=media.grid(DENSITY, *BOX, (1.0, 2.0, 3.0)), lights=sun), Scene(medium=plain, lights=[*sun, lamp]),
        Scene(medium=media.grid(DENSITY, *BOX, phase=phase.microflakes(np.diag([1.0, 1.0, 0.3]))), lights=sun),
        Scene(medium=plain, bounded=True, shapes=[ball], materials=[materials.null()], lights=sun),
        Scene(medium=media.homogeneous(*BOX), lights=sun),
    ):  # fmt: skip
        assert not gather.possible(scene.world())
    formula = media.procedural(lambda x, y, z: 1.0, *BOX, 1.0)
    assert compiled.unknown(Scene(medium=formula, lights=sun).world()) == "a density function"
    with monkeypatch.context() as patch:
        patch.setattr(gather, "is_large", lambda m: True)
        assert not gather.possible(Scene(medium=plain, lights=sun).world())
    thin = media.grid(DENSITY, *BOX, albedo=ALBEDO)
    assert gather.possible(Scene(medium=thin, lights=sun).world())


def test_preview_of_a_landscape_scatters_as_the_place_does(textures, fine):
    """A weather map's cloud with a grid of g, in rain: 2 e^-(d r) powder times HG with g of the place."""
    over = np.ones((2, 2, 3), np.float32)
    cloud, rain = weather.landscape(over, (N,) * 3, textures=textures)
    m = media.grid(cloud, *BOX, 4.0, g=BEND, attribute=rain, detail=fine)
    lighting, up = Lighting(0, none(), np.zeros(0, np.float32), rain=3.0), (0.0, 0.0, 1.0)
    smooth, seen = m._replace(columns=media.NOTHING), set()
    for p in RNG.uniform(-0.9, 0.9, (8, 3)):
        a, g = lookups.attribute(m, tuple(p)), lookups.phase_at(m, tuple(p)).g1
        ratio = (1 - g * g) / (1 + g * g + 2 * g) ** 1.5  # to isotropic, of light that turns back
        even = preview_source(smooth, tuple(p), up, up, a, lighting, new_rng(0, 0))
        assert preview_source(m, tuple(p), up, up, a, lighting, new_rng(0, 0)) == pytest.approx(ratio * even)
        seen.add(round(g, 6))
        assert abs(g) <= 0.8
    assert len(seen) == 8 and preview_energy(0.0, 1.0, False) == 0


def test_truth_tells_of_grids_and_detail_and_large_ones_are_eroded(fine, tmp_path, monkeypatch):
    m = medium(fine, g=BEND, **WARM)
    scene = Scene(medium=m)
    truth.write(scene, tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz") as stored:
        assert {"medium0_density", "medium0_albedo", "medium0_g_grid", "medium0_noise", "medium0_tiles"} <= set(
            stored.files
        )
    told = truth.described(scene)["medium0"]
    assert told["albedo"] == told["g"] == "grid" and "2 octaves" in str(told["detail"])
    monkeypatch.setattr(volumes, "LARGE", 100)
    with pytest.warns(RenderWarning, match=r"density\.npz would be"):
        volumes.write_density(m, tmp_path)
    found = read_vdb(tmp_path / "density.vdb")
    want = volumes.sampled(m) * np.float32(m.sigma_t[1])
    i, j, k = (slice(a, a + n) for a, n in zip(found.first, found.values.shape, strict=True))
    assert np.allclose(found.values, want[i, j, k], atol=1e-5) and found.values.sum() == pytest.approx(want.sum())
    assert want.sum() < 0.9 * (DENSITY * m.sigma_t[1]).sum()
    truth.write(scene, tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz") as stored:  # in bricks, which say nothing without the noise
        assert {"medium0_fields", "medium0_noise"} <= set(stored.files) and "medium0_density" not in stored.files
