"""truth.npz: the numbers alone, read without data_synth, say where every medium is and what it does."""

from pathlib import Path

import numpy as np
import pytest

from data_synth import Options, channels, media, scene_file, scenes, truth
from data_synth.dataset import _provenance
from data_synth.scene import Scene
from data_synth.scenes.showcase import Showcase


def written(scene, tmp_path):
    scene.write_truth(tmp_path)
    with np.load(tmp_path / "truth.npz", allow_pickle=False) as stored:
        return dict(stored)


def vertices(truth):
    n = truth["number"].shape
    axes = [np.linspace(a, b, k) for a, b, k in zip(truth["number_lo"], truth["number_hi"], n, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@pytest.mark.parametrize("name", [n for n in scenes.SCENES if n != "showcase"])
def test_every_scene_has_its_truth(name, tmp_path):
    resolution = {"resolution": 16} if "resolution" in scenes.parameters_of(name) else {}
    scene = scenes.make(name, **resolution)
    assert isinstance(scene, Scene)
    truth = written(scene, tmp_path)
    assert len(truth["lights"]) == len(scene.lights) and len(truth["shapes"]) == len(scene.shapes)
    m = scene.medium
    assert ("medium0_kind" in truth) == (m is not None)
    if m is None:
        assert (truth["number"] == -1).all()
    else:
        assert (truth["number"] == 0).any() and tuple(truth["medium0_sigma_t"]) == m.sigma_t
        albedo = m.albedo if m.columns.albedo < 0 else media.dense_of(m, m.fields, m.columns.albedo, 3)
        assert np.array_equal(truth["medium0_albedo"], albedo) and np.array_equal(truth["medium0_Le"], m.Le)
        if m.kind == media.GRID:
            assert np.array_equal(truth["medium0_density"], media.dense(m))


def test_the_showcase_writes_its_haze(tmp_path):
    scene = Showcase(haze=3.0)
    truth = written(scene, tmp_path)
    x, y, z = (np.linspace(a, b, n) for a, b, n in zip(truth["lo"], truth["hi"], truth["density"].shape, strict=True))
    i, j, k = (int(np.argmin(abs(axis - at))) for axis, at in ((x, 0.62), (y, 0.0), (z, 0.28)))
    q = ((x[i] ** 2 + y[j] ** 2) ** 0.5 - 0.62) ** 2 + (z[k] - 0.28 - 0.2 * x[i] * y[j] / (x[i] ** 2 + y[j] ** 2)) ** 2
    ripple = 1 + 0.6 * np.sin(9 * x[i] + 3 * z[k]) * np.sin(8 * y[j] - 4 * z[k])
    want = 3.0 * ripple * (np.exp(-q / 0.13**2) - np.exp(-9.0))
    assert truth["density"][i, j, k] == pytest.approx(want, rel=1e-6) and truth["density"].max() < 3.0 * 1.6


def test_attributes_are_written_at_their_samples(tmp_path):
    a = np.random.default_rng(0).random((10, 11, 12)).astype(np.float32)
    scene = Scene(medium=media.grid(np.ones_like(a), (0, 0, 0), (1, 1, 1), attribute=a, Le=[[0.0] * 3, [1.0] * 3]))
    assert np.array_equal(written(scene, tmp_path)["medium0_attribute"], a)


def test_boundaries_say_which_medium_is_where(tmp_path):
    """A ball of ink in a ball of glass in a box of fog."""
    truth = written(scene_file.load(Path(__file__).parents[2] / "examples" / "scene.yaml"), tmp_path)
    p = vertices(truth)
    r = np.linalg.norm(p - (-0.4, -0.2, -0.25), axis=-1)
    want = np.where(r < 0.3, 1, np.where(r < 0.5, -1, 0))
    clear_cut = (abs(r - 0.3) > 1e-9) & (abs(r - 0.5) > 1e-9)
    assert np.array_equal(truth["number"][clear_cut], want[clear_cut]) and set(np.unique(want)) == {-1, 0, 1}
    assert truth["medium0_kind"] == "exponential" and truth["medium0_height"] == pytest.approx(0.5)
    assert truth["medium1_sigma_t"].tolist() == [6.0, 3.0, 0.8] and truth["medium0_phase"] == "henyey_greenstein"


def fog(x, y, z):
    return 0.5 + 0.25 * x


def test_grids_are_written_and_said(tmp_path):
    """Every grid comes back at its vertices, of one density and of channels; the description names each of them."""
    rng = np.random.default_rng(0)
    n = (4, 11, 9)
    given = {"albedo": rng.random((*n, 3)), "Le": rng.random((*n, 3)), "g": rng.uniform(-0.9, 0.9, n)}
    S = np.tile([1.0, 0.5, 0.25, 0.1, 0, 0], (*n, 1)) * rng.uniform(0.5, 1, (*n, 1))
    density, sigma = 0.1 + rng.random(n), 0.1 + rng.random((*n, 3))
    scene = Scene(
        medium=channels.rgb_grid(sigma, (0,) * 3, (1, 2, 3), **given),
        media=[
            media.grid(density, (0,) * 3, (1, 2, 3), **given),
            media.grid(density, (0,) * 3, (1, 2, 3), Le=density, S=S),
            media.procedural(fog, (0,) * 3, (1, 2, 3), np.ones((1, 2, 3))),
        ],
    )
    truth_of = written(scene, tmp_path)
    for k, density_of in ((0, sigma), (1, density)):
        for name, want in (
            ("density", density_of),
            ("albedo", given["albedo"]),
            ("Le", given["Le"]),
            ("g_grid", given["g"]),
        ):
            assert np.allclose(truth_of[f"medium{k}_{name}"], want, atol=1e-6), (k, name)
    assert np.allclose(truth_of["medium2_Le"][..., 0], density) and np.allclose(
        truth_of["medium2_S_grid"], S, atol=1e-6
    )
    assert "return 0.5 + 0.25 * x" in str(truth_of["medium3_source"]) and str(truth_of["medium3_function"]) == "fog"
    assert np.allclose(truth_of["medium3_density"][:, 0, 0], 0.5 + 0.25 * np.linspace(0, 1, 22))
    assert truth_of["medium3_majorant"].shape == (1, 2, 3)
    assert truth.described(scene) == {
        "medium0": {"kind": "rgb_grid", "density": [*n, 3], "albedo": "grid", "Le": "grid", "g": "grid"},
        "medium1": {"kind": "grid", "density": [*n], "albedo": "grid", "Le": "grid", "g": "grid"},
        "medium2": {"kind": "grid", "density": [*n], "Le": "grid", "S": "grid"},
        "medium3": {"kind": "function", "density": "the function fog"},
    }
    hot = Scene(medium=media.grid(density, (0,) * 3, (1, 2, 3), attribute=density / density.max()))
    assert truth.described(hot)["medium0"] == {"kind": "grid", "density": [*n], "attribute": "grid"}
    assert _provenance(scene, Options())["truth"] == truth.described(scene)
