"""OpenVDB files in blocks: what comes without a dense array is what the dense array holds, sample by sample."""

import numpy as np
import pytest

from data_synth import InputError, RenderWarning, blackbody, media, scene_file, scenes, truth, volumes
from data_synth.bricks import Sparse, bricks, cut_to
from data_synth.scene import Scene
from data_synth.vdb import read_blocks, read_vdb
from data_synth.vdb_tree import Tree
from data_synth.vdb_write import SparseGrid, write_grids
from data_synth.volumes import open_volume, read_volume
from tests.fixtures.real import real_data


def blocks(seed=0, n=9, size=(37, 20, 50), channels=()):
    """Blocks at corners that are no multiples of 8, some of them over the edge, none over another."""
    rng = np.random.default_rng(seed)
    at = 8 * np.array(list(np.ndindex(6, 4, 8))) + np.array([-3, -5, -1])
    at = at[(at < np.array(size)).all(axis=1)]
    corner = at[rng.choice(len(at), min(n, len(at)), replace=False)]
    n = len(corner)
    values = rng.random((n, 8, 8, 8, *channels), np.float32)
    return Sparse(corner, np.where(rng.random((n, 8, 8, 8, *[1] * len(channels))) < 0.7, values, 0), size)


@pytest.mark.parametrize("seed", range(4))
def test_blocks_are_cut_into_the_bricks_of_the_dense_array(seed):
    """Unaligned blocks, edges of the grid, faces that bricks share; numbers and vectors."""
    size = [(37, 20, 50), (9, 9, 17), (8, 16, 33), (2, 25, 41)][seed]
    sparse, colour = blocks(seed, size=size), blocks(seed, size=size, channels=(3,))
    one, other = bricks(sparse), bricks(sparse.dense())
    assert one.counts == other.counts and len(one.kept)
    for a, b in zip(one[1:], other[1:], strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(sparse.upright().dense(), sparse.dense()[:, :, ::-1].transpose(0, 2, 1))
    whole = colour.dense()
    padded = np.pad(whole, [(0, 8), (0, 8), (0, 8), (0, 0)])
    found = cut_to(colour, one.kept).reshape(-1, 9, 9, 9, 3)
    for brick, k in zip(found, one.kept, strict=True):
        a, b, c = 8 * np.array(np.unravel_index(k, one.counts))
        assert np.array_equal(brick, padded[a : a + 9, b : b + 9, c : c + 9])


def voxels(rng, low, high, n):
    return np.unique(rng.integers(low, high, (n, 3)), axis=0)


def fire(path, seed=0):
    """A file of density, temperature in kelvin, colour and velocity, each in a box of its own."""
    rng = np.random.default_rng(seed)
    body = voxels(rng, (-20, 3, 5), (12, 40, 30), 4000)
    hot = voxels(rng, (-9, -3, 5), (9, 20, 25), 800)
    grids = [
        SparseGrid("vel", body, np.ones((len(body), 3)), (0.1,) * 3),
        SparseGrid("temperature", hot, 300 + 1700 * rng.random(len(hot)), (0.1,) * 3),
        SparseGrid("Cd", body, rng.random((len(body), 3)), (0.1,) * 3),
        SparseGrid("density", body, 0.1 + 3 * rng.random(len(body)), (0.1,) * 3),
    ]
    write_grids(path, grids, half=False)
    return path, {g.name: g for g in grids}


def test_a_file_in_blocks_is_the_file_as_an_array(tmp_path):
    path, _ = fire(tmp_path / "a.vdb")
    for name in ("density", "temperature", "Cd"):
        found, dense = read_blocks(path, name), read_vdb(path, name)
        assert found is not None and np.array_equal(found.first, dense.first)
        assert np.array_equal(found.volume.dense(), dense.values)


def test_a_real_file_in_blocks():
    folder = real_data("volumes")
    found = read_blocks(folder / "smoke.vdb")
    with np.load(folder / "smoke_dense_f32.npz") as dense:
        assert found is not None and np.array_equal(found.volume.dense(), dense["density"])


@pytest.mark.parametrize("background", [0.0, 0.5])
def test_tiles(background):
    """Constant tiles beside leaves, in part outside of nothing else; a background that is not 0 stays dense."""
    tree = Tree.__new__(Tree)
    tree.channels, tree.background = 1, np.float32(background)
    rng = np.random.default_rng(0)
    tree.leaves = [np.array([8, 0, 16]), np.array([136, 8, 0])]
    tree.values, tree.active = rng.random((2, 512), np.float32), rng.random((2, 512)) < 0.1
    tree.boxes = [(np.array([0, 0, 0]), 8, 2.0), (np.array([0, 128, 0]), 128, 3.0)]
    tree.r = type("R", (), {"data": bytes(10**7)})()
    (first, volume), (same, dense) = tree.sparse(), tree.dense()
    assert np.array_equal(first, same) and dense.shape == volume.shape
    stored = np.where(dense == background, 0, dense) if background else dense
    assert np.array_equal(volume.dense()[stored != 0], stored[stored != 0]) and (
        background or (volume.dense() == dense).all()
    )


def test_grids_of_one_file_by_what_they_mean(tmp_path):
    """Cd times the albedo, temperature as a black body, at every sample where there is density; velocity is named."""
    path, grids = fire(tmp_path / "fire.vdb")
    with pytest.warns(RenderWarning, match="took density as density, Cd as colour, temperature as heat, not vel"):
        volume = open_volume(path)
    coords, temperature = grids["density"].coords, grids["temperature"]
    first = coords.min(axis=0)
    assert np.array_equal(volume.density.dense()[tuple((coords - first).T)], grids["density"].values.astype(np.float32))
    assert np.array_equal(volume.colour.dense()[tuple((coords - first).T)], grids["Cd"].values.astype(np.float32))
    hottest = float(np.float32(temperature.values.max()))
    own = {tuple(c): v for c, v in zip(temperature.coords, temperature.values, strict=True)}
    # the hottest of those that lie in the density's box is 1
    inside = {
        c: v
        for c, v in own.items()
        if all(a <= x < b for a, x, b in zip(first, c, coords.max(axis=0) + 1, strict=True))
    }
    heat = volume.heat.dense()
    assert volume.hottest == pytest.approx(hottest) and len(inside) > 100
    assert all(heat[tuple(np.array(c) - first)] == pytest.approx(v / hottest, rel=1e-6) for c, v in inside.items())
    assert np.allclose(volume.glow(2000.0, 3.0)[-1], 3.0 * blackbody.glow(hottest, 2000.0))
    with pytest.warns(RenderWarning, match="temperature as heat"):
        scene = scenes.make("explosion", volume=str(path), heat=3.0, kelvin=2000.0)
    assert isinstance(scene, Scene) and isinstance(scene.medium, media.Medium)
    known = truth.described(scene)["medium0"]
    assert known["albedo"] == "grid"
    at = media.dense_of(scene.medium, scene.medium.fields, 0, 3)
    x, y, z = (coords - first).T
    ny = volume.density.size[2]
    assert np.allclose(at[x, ny - 1 - z, y], 0.35 * grids["Cd"].values, atol=1e-6)
    hot = media.dense_of(scene.medium, scene.medium.attributes)[..., 0]
    assert np.array_equal(hot[x, ny - 1 - z, y], heat[x, y, z])
    with pytest.warns(RenderWarning, match="not vel, temperature|not vel, .*temperature"):
        smoke = scenes.make("smoke", volume=str(path))
    assert isinstance(smoke, Scene) and truth.described(smoke)["medium0"]["albedo"] == "grid"


def test_scene_files_take_colour_and_temperature(tmp_path):
    fire(tmp_path / "fire.vdb")
    (tmp_path / "s.yaml").write_text(
        "medium: {volume: {file: fire.vdb, albedo: [1, 0.5, 0.2], kelvin: 1800, heat: 2}}\n"
    )
    with pytest.warns(RenderWarning, match="temperature as heat"):
        m = scene_file.load(tmp_path / "s.yaml").medium
    assert isinstance(m, media.Medium) and m.columns.albedo >= 0 and m.Le.max() > 0 and m.attributes.size > 1
    assert np.array_equal(
        media.dense(m), np.float32(1) * read_volume(f"{tmp_path / 'fire.vdb'}:density")[0] / m_largest(tmp_path)
    )
    (tmp_path / "cold.yaml").write_text("medium: {volume: {file: 'fire.vdb:density', kelvin: 1800}}\n")
    with pytest.raises(InputError, match="temperature or flame"):
        scene_file.load(tmp_path / "cold.yaml")


def m_largest(folder):
    return np.float32(read_volume(f"{folder / 'fire.vdb'}:density")[0].max())


def test_flame_is_the_part_that_burns(tmp_path):
    c = voxels(np.random.default_rng(0), 0, 12, 300)
    grids = [SparseGrid("density", c, np.ones(len(c))), SparseGrid("flames", c, np.linspace(0, 2, len(c)))]
    write_grids(tmp_path / "f.vdb", grids, half=False)
    with pytest.warns(RenderWarning, match="flames as heat"):
        volume = open_volume(tmp_path / "f.vdb")
    assert volume.burns and volume.hottest is None and volume.heat.max() == 1.0
    assert np.allclose(volume.glow(1500.0, 4.0), [[0.0] * 3, 4.0 * blackbody.glow(1500.0, 1500.0)])
    other = [SparseGrid("density", c, np.ones(len(c))), SparseGrid("flame", c, np.ones(len(c)), (2.0,) * 3)]
    write_grids(tmp_path / "g.vdb", other)
    with pytest.warns(RenderWarning, match="flame lies on another"), pytest.warns(RenderWarning, match="not flame"):
        assert open_volume(tmp_path / "g.vdb").heat is None


def test_two_voxels_far_apart_are_little_in_blocks_and_too_far_is_said(tmp_path):
    far = np.array([[0, 0, 0], [900, 900, 900]])
    write_grids(tmp_path / "far.vdb", [SparseGrid("density", far, np.ones(2))])
    found = read_blocks(tmp_path / "far.vdb")
    assert found is not None and found.volume.size == (901, 901, 901) and len(found.volume.blocks) == 2
    m = media.grid(found.volume, (0,) * 3, (900,) * 3)
    assert m.samples.sum() == 2.0 and len(m.samples) == 2 * 9**3
    write_grids(tmp_path / "too.vdb", [SparseGrid("density", far * 5, np.ones(2))])
    with pytest.raises(InputError, match="4501x4501x4501 apart, .* GiB as blocks"):
        read_blocks(tmp_path / "too.vdb")


def test_truth_of_large_media_stays_in_bricks(tmp_path, monkeypatch):
    """density.vdb has the voxels of the dense array, and truth.npz what makes them."""
    volume = blocks(3)
    m = media.grid(volume, (0,) * 3, (3.6, 1.9, 4.9), 2.0)
    volumes.write_density(m, tmp_path)
    want = read_vdb(tmp_path / "density.vdb")
    monkeypatch.setattr(volumes, "LARGE", 1000)
    (tmp_path / "large").mkdir()
    with pytest.warns(RenderWarning, match="density.npz would be a dense array"):
        Scene(medium=m).write_truth(tmp_path / "large")
    found = read_vdb(tmp_path / "large" / "density.vdb")
    assert np.array_equal(found.values, want.values) and np.array_equal(found.first, want.first)
    with np.load(tmp_path / "large" / "truth.npz") as stored:
        assert np.array_equal(stored["medium0_samples"], m.samples) and "medium0_density" not in stored.files
    assert not (tmp_path / "large" / "density.npz").exists()
