"""Mitsuba 3 as an independent oracle: transmittance, single scattering and multiple scattering of a lumpy cloud.

Run where ``pip install mitsuba`` has been done; ``scalar_rgb`` needs no LLVM.
"""

import numpy as np
import pytest

from data_synth import Camera, March, Path, lights, look_at, media, phase
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install mitsuba")

N, SIGMA, SIZE, FOV = 16, 6.0, 8, 40.0
EYE, SUN = (0.4, -3.4, 0.9), np.array([0.6, -0.3, 0.74])


def density():
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, N)] * 3, indexing="ij")
    r = np.sqrt(x * x + y * y + z * z)
    return np.clip(1.1 - r + 0.4 * np.sin(4 * x) * np.cos(5 * y + z), 0, 1).astype(np.float32)


def ours(albedo):
    return Scene(
        medium=media.grid(density(), (-1,) * 3, (1,) * 3, SIGMA, albedo, phase=phase.henyey_greenstein(0.4))._replace(
            step=0.01
        ),
        lights=[lights.directional(SUN, 5.0)],
    )


def camera():
    return Camera(SIZE, SIZE, 0.5 * SIZE / np.tan(np.radians(FOV / 2)), look_at(EYE))


def theirs(albedo, max_depth, spp, seed):
    """(H, W) red channel: the mean of spp samples a pixel, box filter."""
    mi.set_variant("scalar_rgb")
    t = mi.ScalarTransform4f
    # their samples stand at cell centres of [0, 1]^3, ours at the box's corners: the grid is stretched by N / (N - 1)
    stretch = t().scale(2.0 * N / (N - 1)).translate([-0.5, -0.5, -0.5])
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": max_depth, "rr_depth": 1000, "hide_emitters": True},
        "sensor": {
            "type": "perspective", "fov": FOV, "to_world": t().look_at(origin=EYE, target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": spp, "seed": seed},
        },
        "sun": {"type": "directional", "direction": (-SUN / np.linalg.norm(SUN)).tolist(), "irradiance": 5.0},
        "cube": {
            "type": "cube", "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous", "albedo": albedo, "scale": SIGMA,
                "phase": {"type": "hg", "g": 0.4},
                "sigma_t": {
                    "type": "gridvolume", "to_world": stretch, "wrap_mode": "clamp",
                    "grid": mi.VolumeGrid(np.ascontiguousarray(density().transpose(2, 1, 0)[..., None])),
                },
            },
        },
    })  # fmt: skip
    return np.array(mi.render(scene, seed=seed))[..., 0]


@pytest.mark.parametrize("albedo, depth", [(0.9, 1), (0.95, 64)])
def test_cloud_has_mitsuba_s_radiance(albedo, depth):
    runs = np.array([theirs(albedo, depth + 1, 200, seed) for seed in range(6)])
    mean, variance = runs.mean(axis=0), runs.var(axis=0, ddof=1) / len(runs)
    picture = Path(spp=2000, max_depth=depth).render(ours(albedo), camera())
    # a variance estimated from 6 runs is uncertain: compare picture means, and pixels by the pooled variance
    pooled = np.full_like(variance, variance.mean()) + picture.variance[..., 0]
    total = np.sqrt(pooled.sum()) / pooled.size
    assert abs(picture.rgb[..., 0].mean() - mean.mean()) < 4.5 * total
    if depth == 1:
        marched = March(side=4).render(ours(albedo), camera()).rgb[..., 0]
        assert_means(mean.mean(), total**2, marched.mean(), bias=2e-3 * marched.mean())
