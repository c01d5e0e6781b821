"""Clouds in plain Python (NUMBA_DISABLE_JIT=1; test_plain.py runs it): detail below the voxel, weather, rain, preview."""

import numpy as np
import pytest
from PIL import Image

from data_synth import clouds, detail, lookups, media, noise, phase, pool, trackers, transmittance, volumes, weather
from data_synth.errors import InputError
from data_synth.march import Lighting, preview_energy, preview_source
from data_synth.rng import new_rng
from data_synth.shadowmap import none
from tests.fixtures.hypothesis_tests import assert_sample_mean

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
SIDE = 18  # samples: more than a brick
EROSION = 0.4


@pytest.fixture(scope="module")
def textures():
    """Smooth random textures of the right kind, made in no time; the real ones take minutes without a compiler."""
    rng = np.random.default_rng(3)
    base, fine = (np.kron(rng.random((4, 4, 4, c)), np.ones((2, 2, 2, 1))).astype(np.float32) for c in (4, 3))
    base[..., 0] = 0.5 + 0.5 * base[..., 0]
    return noise.CloudTextures(base, fine, noise.curl_texture(8, 0))


@pytest.fixture(scope="module")
def medium(textures):
    shape = np.random.default_rng(1).random((SIDE,) * 3)
    d = detail.detail(textures, (3.0, 2.0, 5.0), EROSION, 2)
    return media.grid(np.clip(1.6 * shape - 0.1, 0, 1), (-1, 0, 2), (1, 3, 3), 1.0, detail=d)


def points(m, n):
    """Random points of the box and the number of the brick that holds each."""
    u = np.random.default_rng(5).random((n, 3))
    brick = (u * np.array(m.cells)).astype(int) // media.BRICK
    return np.array(m.lo) + u * (np.array(m.hi) - m.lo), np.ravel_multi_index(brick.T, m.bricks)


def densities(m, where):
    return np.array([lookups.density(m, tuple(p)) for p in where])


def test_the_bounds_of_a_brick_hold_for_the_eroded_density(medium):
    """They bound the coarse one, of which erosion takes at most (1 - s) e / (1 - e); and they are not far off."""
    where, brick = points(medium, 3000)
    rho = densities(medium, where)
    assert (rho <= medium.brick_max[brick]).all() and (rho >= medium.brick_min[brick]).all()
    coarse = densities(medium._replace(detail=detail.NONE), where)
    assert (rho <= coarse).all() and (rho >= detail.least(medium.detail, coarse) - 1e-12).all()
    assert rho.mean() < 0.95 * coarse.mean()


def test_a_lower_bound_above_zero_is_eroded_too(textures):
    m = media.grid(np.full((9, 9, 9), 0.7), (0, 0, 0), (1, 1, 1), detail=detail.detail(textures, (3, 3, 3), EROSION, 1))
    rho = densities(m, np.random.default_rng(0).random((500, 3)))
    assert m.brick_min[0] == pytest.approx(0.5) and m.brick_min[0] <= rho.min() < rho.max() <= m.brick_max[0]


def test_contrast_makes_a_crisp_rim_within_its_bounds(textures):
    """min(c rho, 1) of the same erosion without contrast; bounds of bricks and the pool of media know of it."""
    rng = np.random.default_rng(4)
    shape = np.clip(1.2 * rng.random((10, 10, 10)) - 0.2, 0, 1)
    plain, crisp = (
        media.grid(shape, (0, 0, 0), (1, 1, 1), detail=detail.detail(textures, (3, 3, 3), 0.8, 2, c))
        for c in (1.0, 6.0)
    )
    where = rng.random((1500, 3))
    rho, brick = densities(crisp, where), np.ravel_multi_index(((where * 9).astype(int) // 8).T, crisp.bricks)
    assert np.allclose(rho, np.minimum(6.0 * densities(plain, where), 1.0))
    assert (rho <= crisp.brick_max[brick]).all() and (rho >= crisp.brick_min[brick]).all() and rho.max() == 1.0
    assert crisp.max_density == crisp.brick_max.max() == 1.0
    air = media.homogeneous((0, 0, 0), (1, 1, 1))
    assert np.array_equal(densities(pool.medium_at(pool.pool([air, crisp]), 1), where), rho)
    with pytest.raises(InputError, match="contrast"):
        detail.detail(textures, (1, 1, 1), 0.3, contrast=0.5)


@pytest.mark.parametrize("method", [trackers.DELTA, trackers.RATIO, trackers.RESIDUAL])
def test_trackers_are_unbiased_below_the_voxel(medium, method):
    """Against the midpoint rule at 1/40 of a cell. A majorant that is none would bias them."""
    ray = ((-1.0, 0.4, 2.2), tuple(np.array([2.0, 1.9, 0.5]) / np.linalg.norm([2.0, 1.9, 0.5])))
    length = float(np.linalg.norm([2.0, 1.9, 0.5]))
    t = (np.arange(2400) + 0.5) / 2400 * length
    thickness = densities(medium, np.array(ray[0]) + t[:, None] * np.array(ray[1])).mean() * length * medium.sigma_t[0]
    coarse = medium._replace(detail=detail.NONE)
    assert thickness < 0.9 * trackers.thickness(coarse, ray, 0.0, length, trackers.REGULAR, None)
    rng = new_rng(7, 0)
    drawn = np.array([trackers.transmittance(medium, ray, 0.0, length, method, True, rng)[0] for _ in range(300)])
    assert_sample_mean(drawn, np.exp(-thickness))


def test_a_cell_holds_more_than_a_polynomial(medium):
    """Trilinear density along a line in a cell is a cubic; what detail adds is not, at any distance."""
    line = np.array([0.0, 1.45, 2.48]) + np.linspace(0, 0.05, 60)[:, None] * np.array([1.0, 1.0, 0.4])
    for m, smooth in ((medium._replace(detail=detail.NONE), True), (medium, False)):
        rho = densities(m, line)
        left = rho - np.polyval(np.polyfit(np.arange(60), rho, 3), np.arange(60))
        assert (np.abs(left).max() < 1e-6) == smooth


def test_detail_at_the_samples_is_what_baking_makes(textures):
    shape = (7, 6, 5)
    baked = clouds.cloud("cumulus", shape, 0.95, 1.0, EROSION, textures=textures)
    bare = clouds.cloud("cumulus", shape, 0.95, 1.0, 0.0, textures=textures)
    m = media.grid(bare, (-1, 0, 2), (1, 3, 3), detail=clouds.detail_of(textures, 1.0, EROSION))
    assert 0 < baked.sum() < bare.sum()
    assert np.allclose(volumes.sampled(m), baked, atol=1e-6) and not np.allclose(media.dense(m), baked, atol=0.01)
    assert np.allclose(volumes.sampled(m, 2)[::2, ::2, ::2], baked, atol=1e-6)


def test_octaves_are_finer_and_their_mean_keeps_its_range(textures):
    one, three = (detail.detail(textures, (1, 1, 1), 0.5, n) for n in (1, 3))
    at = np.random.default_rng(2).random((400, 3))
    values = np.array([[detail.noise_at(d, *p) for p in at] for d in (one, three)])
    assert values.min() >= 0 and values.max() <= 1
    finer = detail.detail(textures, (4, 4, 4), 0.5, 1)
    finest = detail.detail(textures, (16, 16, 16), 0.5, 1)
    parts = np.array([[detail.noise_at(d, *p) for p in at] for d in (one, finer, finest)])
    assert np.allclose(values[1], np.array([1, 0.4, 0.16]) @ parts / 1.56)


def test_noise_is_wispy_and_pushed_at_the_base_and_upside_down_at_the_top(textures):
    """Under curl noise that is (1/2, -1/4) everywhere: at z = 0 the noise itself, from a place as far off; at z = 1 its
    complement, from where it is asked for; halfway there at z = 1/16."""
    d = detail.detail(textures, (1, 1, 1), 0.5)
    noise_alone = d.values[: d.n**3]
    steady = np.broadcast_to(np.array([0.5, -0.25], np.float32), (4, 4, 2)).ravel()
    d = d._replace(values=np.concatenate([noise_alone, steady]), p=4)
    texture = noise_alone.reshape((d.n,) * 3 + (1,))
    for x, y in np.random.default_rng(7).random((20, 2)):
        dx, dy = 0.5 * detail.CURL_SHIFT, -0.25 * detail.CURL_SHIFT
        assert detail.noise_at(d, x, y, 0.0) == pytest.approx(
            noise.texture_at(texture, x + dx, y + dy, 0.0, 0), abs=1e-6
        )
        assert detail.noise_at(d, x, y, 1.0) == pytest.approx(1 - noise.texture_at(texture, x, y, 1.0, 0), abs=1e-6)
        assert detail.noise_at(d, x, y, 1 / 16) == pytest.approx(0.5, abs=1e-6)


def test_a_medium_of_many_keeps_its_detail(medium):
    many = pool.pool([media.homogeneous((0, 0, 0), (1, 1, 1)), medium, media.homogeneous((0, 0, 0), (1, 1, 1))])
    where, _ = points(medium, 50)
    assert np.array_equal(densities(pool.medium_at(many, 1), where), densities(medium, where))
    assert pool.medium_at(many, 2).detail.octaves == 0


def test_what_cannot_be_eroded_is_refused(textures, medium):
    d = detail.detail(textures, (1, 1, 1), 0.3)
    with pytest.raises(InputError, match=r"in \[0, 1\], got 2"):
        media.grid(np.full((2, 2, 2), 2.0), (0, 0, 0), (1, 1, 1), detail=d)
    with pytest.raises(InputError, match="erosion"):
        detail.detail(textures, (1, 1, 1), 1.0)
    with pytest.raises(InputError, match="octaves"):
        detail.detail(textures, (1, 1, 1), 0.3, 9)
    with pytest.raises(InputError, match="no polynomial"):
        transmittance.sample_transmittance(medium, (0, 0, 0), (0, 0, 1), method="regular")


def test_a_weather_map_says_where_clouds_are(textures):
    """West half clear, a stratus south, a cumulonimbus north: only the latter reaches the top of the layer."""
    over = np.zeros((2, 2, 3), np.float32)
    over[1, :, 0] = 1.0
    over[1, 1, 1] = 1.0
    over[1, 0, 2] = 0.8
    flat = textures._replace(base=np.ones_like(textures.base))
    cloud, rain = weather.landscape(over, (5, 5, 21), textures=flat)
    assert not cloud[0].any() and cloud[4].any()
    heights = [np.flatnonzero(cloud[4, j] > 0.1) / 20 for j in (0, 4)]
    assert heights[0].max() < 0.75 < 0.9 <= heights[1].max()
    assert rain[4, 0].max() == pytest.approx(0.8) and rain[4, 0, 0] == pytest.approx(0.8)
    assert (np.diff(rain[4, 0]) <= 0).all() and rain[4, 0, -1] == 0 and not rain[4, 4].any()
    assert rain[4, 2, 0] == pytest.approx(0.4)  # bilinear in between


def test_types_are_mixed_between_their_neighbours():
    kinds = (clouds.STRATUS, clouds.CUMULUS, clouds.CUMULONIMBUS)
    for h in (0.05, 0.1, 0.3, 0.6, 0.9):
        low, middle, tall = (clouds.height_gradient(kind, h) for kind in kinds)
        for kind, want in (
            (0, low),
            (0.2, 0.6 * low + 0.4 * middle),
            (0.5, middle),
            (0.8, 0.4 * middle + 0.6 * tall),
            (1, tall),
        ):
            assert weather.mixed_gradient(kind, h) == pytest.approx(want, abs=1e-12)


def test_a_picture_is_a_weather_map_with_north_up(tmp_path):
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[0, 2] = (255, 51, 102)  # north-east
    Image.fromarray(pixels).save(tmp_path / "map.png")
    over = weather.read(tmp_path / "map.png")
    assert over.shape == (3, 2, 3) and np.allclose(over[2, 1], (1.0, 0.2, 0.4)) and over.sum() == pytest.approx(1.6)
    (tmp_path / "no.png").write_text("nothing")
    with pytest.raises(InputError, match=r"no\.png: expected a picture of coverage"):
        weather.read(tmp_path / "no.png")
    with pytest.raises(InputError, match=r"in \[0, 1\]"):
        weather.landscape(np.full((2, 2, 3), 2.0), (4, 4, 4))


def test_a_map_of_noise_covers_what_it_was_told(textures):
    for coverage in (0.0, 0.3, 0.8):
        over = weather.generated(coverage, 0.5, textures=textures)
        assert over.min() >= 0 and over.max() <= 1 and over[..., 2].max() <= 0.5
        share = (over[..., 0] > 0).mean()
        assert abs(share - coverage) <= 1 / 16  # of the 16 values that this base noise has in a plane


def test_rain_is_dark_in_preview_and_truth(textures):
    """r of L = e^-(d r) HG powder in the one, a lower albedo in the other."""
    m = media.homogeneous((0, 0, 0), (1, 1, 1), 3.0, phase=phase.henyey_greenstein(0.3))
    p, up = (0.5, 0.5, 0.1), (0.0, 0.0, 1.0)
    lighting = Lighting(0, none(), np.zeros(0, np.float32), rain=2.5)
    dry, damp, wet = (preview_source(m, p, up, up, a, lighting, new_rng(0, 0)) for a in (0.0, 0.5, 1.0))
    d = 3.0 / 3.0  # a third of the height
    assert wet / dry == pytest.approx(np.exp(-1.5 * d)) and damp / dry == pytest.approx(np.exp(-0.75 * d))
    over = np.zeros((2, 2, 3), np.float32) + np.array([1.0, 0.5, 1.0], np.float32)
    _, rain = weather.landscape(over, (3, 3, 9), textures=textures)
    assert rain[1, 1, 0] == 1 and rain[1, 1, -1] == 0
    from data_synth.scenes import landscape

    assert landscape.WET < landscape.DRY


@pytest.mark.parametrize("d", [0.0, 0.1, 1.0, 4.0])
def test_preview_is_the_published_formula(d):
    """2 e^-d (1 - e^-2d): black at d = 0, 0.0366 at d = 4; the soft one never as dark."""
    want = 2 * np.exp(-d) * (1 - np.exp(-2 * d))
    assert preview_energy(d, 1.0, False) == pytest.approx(want, abs=1e-15)
    assert preview_energy(d, 2.0, False) == pytest.approx(want * np.exp(-d), abs=1e-15)
    assert preview_energy(d, 1.0, True) > preview_energy(d, 1.0, False)
    assert preview_energy(4.0, 1.0, False) == pytest.approx(0.0366, abs=1e-4)
