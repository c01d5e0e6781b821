"""Scenes whose matter has directions: the fibres of the cloth follow its threads, a leaf has veins, fog thins with height."""

import numpy as np
import pytest

from data_synth import materials, media, scenes, sggx


def test_fibres_of_the_cloth_follow_their_threads():
    """Half a thread's width along the fibre the colour is that of the same thread, in a fold as well; it is not across, or down
    where the thread climbs."""
    m = scenes.cloth(resolution=96, threads=12).medium
    assert isinstance(m, media.Medium)
    rho, S, colour = (
        media.dense(m),
        media.dense_of(m, m.fields, m.columns.S, 6),
        media.dense_of(m, m.fields, m.columns.albedo, 3),
    )
    at = np.argwhere(rho > 0.9 * rho.max())
    at = at[np.random.default_rng(0).choice(len(at), 1000)]
    area, axes = np.linalg.eigh(sggx.matrices(S[tuple(at.T)].astype(float)))
    assert np.allclose(np.sqrt(area), [0.25, 1, 1], atol=1e-3)  # the roughness along the fibre, 1 across

    def stays(direction):
        same = []
        for step in (4, -4):  # voxels, of which a thread is 8 wide
            to = np.clip(np.rint(at + step * direction).astype(int), 0, np.array(rho.shape) - 1)
            same.append((colour[tuple(to.T)] == colour[tuple(at.T)]).all(axis=1) & (rho[tuple(to.T)] > 0))
        return np.mean(same)

    fibre = axes[..., 0]
    assert stays(fibre) > 0.9
    assert stays(fibre[:, [1, 0, 2]]) < 0.6 and stays(fibre * [1, 1, -1]) < 0.7


@pytest.mark.parametrize("leaves", [1, 7])
def test_every_triangle_of_a_sprig_has_a_material_and_every_leaf_its_veins(leaves):
    scene = scenes.leaf(leaves=leaves)
    assert scene.triangles is not None and len(scene.materials) == 2 + 3 * leaves
    assert set(scene.triangles[:, 0].astype(int)) == set(range(len(scene.materials)))
    rows = np.array(scene.materials)[1:]
    assert (rows[:, 0] == materials.SPONGECAKE).all() and rows[:, 12].max() == len(scene.layers)
    corners = scene.triangles[:, 1:4]
    assert (corners >= scene.aabb[0]).all() and (corners <= scene.aabb[1]).all()


def test_fog_thins_with_height_by_its_formula():
    m = scenes.fog(density=0.7, thinning=1.8).medium
    assert m.kind == media.EXPONENTIAL and m.base == -1.0 and m.falloff == pytest.approx(1.8) and m.hi[2] == 1.65
    even = scenes.fog(density=0.7).medium
    assert even.kind == media.HOMOGENEOUS and even.hi[2] == 0.5 and even.sigma_t == m.sigma_t == (0.7, 0.7, 0.7)
