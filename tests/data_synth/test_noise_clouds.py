"""Noise textures and cloud densities: ranges, tiling, seeds, and that the parameters do what they say."""

import numpy as np
import pytest

from data_synth import clouds, detail, media, noise, scenes, volumes
from data_synth.errors import InputError
from data_synth.jit import kernel


@pytest.fixture(scope="module")
def textures():
    return noise.make_textures(seed=1, base=32, detail=16, curl=32)


def test_textures_fill_their_range(textures):
    for t in (textures.base, textures.detail):
        assert t.min() >= 0.0 and t.max() <= 1.0 and t.std() > 0.05
    assert np.abs(textures.curl).max() == pytest.approx(1.0)
    assert (textures.base[..., 0] >= textures.base[..., 1] - 1e-6).all()  # Perlin-Worley lies above its Worley


@pytest.mark.parametrize("name", ["base", "detail", "curl"])
def test_textures_tile(textures, name):
    """The step over the seam is like the steps inside."""
    t = getattr(textures, name)
    for axis in range(t.ndim - 1):
        steps = np.abs(np.diff(t, axis=axis, append=np.take(t, [0], axis=axis))).max(
            axis=tuple(a for a in range(t.ndim) if a != axis)
        )
        assert steps[-1] <= 1.3 * steps[:-1].max()


def test_perlin_repeats_after_one_unit_and_has_no_seam():
    @kernel
    def along(out, start):
        for k in range(len(out)):
            t = start + k / 200.0
            out[k] = noise.perlin(t, 0.3 + t, 0.7 - t, 5, 3)

    first, second = np.empty(400), np.empty(200)
    along(first, 0.0)
    along(second, 1.0)
    assert np.allclose(first[200:], second, atol=1e-9) and np.allclose(first[:200], second, atol=1e-9)
    assert np.abs(np.diff(first)).max() < 0.12  # slope below 24 per unit: continuous over the lattice and the seam


def test_curl_noise_has_no_divergence():
    flow = noise.curl_texture(64, 3).astype(float)
    k = np.fft.fftfreq(64) * 64
    divergence = np.fft.fft2(flow[..., 0]) * k[:, None] + np.fft.fft2(flow[..., 1]) * k[None, :]
    assert np.abs(divergence).max() < 1e-3 * np.abs(np.fft.fft2(flow[..., 0])).max()


def test_seeds_repeat_and_differ():
    a, b, c = (noise.make_textures(s, 16, 8, 8).base for s in (1, 1, 2))
    assert np.array_equal(a, b) and not np.allclose(a, c, atol=0.05)


def test_cache_gives_the_same_textures(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = noise.cloud_textures(5, 16)
    assert len(list((tmp_path / "data_synth").iterdir())) == 1
    again = noise.cloud_textures(5, 16)
    assert all(np.array_equal(x, y) for x, y in zip(first, again, strict=True))


@pytest.mark.parametrize("kind", clouds.TYPES)
def test_clouds_are_fractions_that_grow_with_coverage(textures, kind):
    shape = (24, 24, 24)
    amounts = []
    for coverage in (0.0, 0.5, 1.0):
        rho = clouds.cloud(kind, shape, coverage, textures=textures)
        assert rho.min() >= 0.0 and rho.max() <= 1.0 and np.isfinite(rho).all()
        amounts.append(rho.mean())
    assert amounts[0] == 0.0 < amounts[1] < amounts[2]
    assert rho[:, :, 0].max() == 0.0 and rho[0].max() == 0.0  # nothing touches the floor or a side of the box


def test_types_stand_as_tall_as_their_names(textures):
    def top(kind):
        rho = clouds.cloud(kind, (24, 24, 48), 1.0, textures=textures)
        return np.flatnonzero(rho.mean(axis=(0, 1)) > 0.01).max()

    assert top("stratus") < top("cumulonimbus") and top("cumulus") <= top("cumulonimbus")


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match="coverage"):
        clouds.cloud("cumulus", (4, 4, 4), 1.5)
    with pytest.raises(InputError, match="type"):
        clouds.cloud("cirrus", (4, 4, 4))


def test_other_lights_leave_a_scene_its_exposure():
    """Pictures of one scene under several lights can be compared, however dark they are; --exposure is there to change it."""
    own, other = scenes.make("stratus", resolution=8), scenes.make("stratus", "panel", resolution=8)
    assert own.exposure == other.exposure != 1.0 and len(other.lights) == 1


def test_a_layer_of_stratus_has_tiles_by_scale_and_holes_by_erosion(textures, monkeypatch):
    """Two tiles along the layer repeat after half of it, detail and all; erosion takes away, never adds."""
    monkeypatch.setattr(clouds, "cloud_textures", lambda seed: textures)

    def layer(**parameters):
        return media.dense(scenes.make("stratus", resolution=49, coverage=0.9, **parameters).medium)

    flat = slice(6, 43)  # where the layer's edge is no nearer than 0.12 of its side
    tiled, other = (layer(scale=scale)[:, flat] for scale in (2.0, 1.6))
    assert np.allclose(tiled[6:19], tiled[30:43], atol=1e-5) and 0.1 < tiled[6:43].mean() < 0.9
    assert np.abs(other[6:19] - other[30:43]).mean() > 0.01
    bare, worn = layer(erosion=0.0), layer(erosion=0.7)
    assert (worn <= bare + 1e-6).all() and 0.05 < worn.mean() < 0.95 * bare.mean()


def test_the_clouds_of_a_landscape_are_carved_and_end_before_the_box_does():
    """Of what would be solid without erosion noise takes a third to most away; of a shape that is 1 just behind its rim it
    takes hardly any."""
    m = scenes.make("cloudscape", resolution=48).medium
    shape, rho = media.dense(m), volumes.sampled(m)
    solid = detail.most(m.detail, shape) == 1.0
    assert solid.sum() > 1000 and 0.3 < (rho[solid] < 0.1).mean() < 0.9 and (rho[solid] > 0.9).mean() > 0.1
    assert shape[[0, -1]].max() == shape[:, [0, -1]].max() == 0 < shape.max()
