"""Scans through transfer functions in plain Python (NUMBA_DISABLE_JIT=1; test_plain.py runs it)."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from data_synth import Camera, look_at, lookups, raycast, scenes, transfer, volumes
from data_synth.errors import InputError
from data_synth.integrators import Emission, March, RayCast
from data_synth.scene import Scene
from data_synth.scenes.volumes import TISSUE

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # of uint64, which is meant to wrap
PEAK = np.array([[0, 0, 1, 0, 0], [0.5, 0, 1, 0, 0], [0.515, 1, 0.8, 0.1, 0.3], [0.53, 0, 0, 1, 0], [1, 0, 0, 0, 1.0]])
SMOOTH = np.array([[0, 0, 1, 0, 0], [0.3, 0.2, 1, 0.5, 0], [0.6, 0.9, 0, 1, 0.5], [1, 0.1, 0, 0.2, 1.0]])
SIGMA = 30.0
ALONG = ((-1.0, 0.43, 0.52), (1.0, 0.0, 0.0))


def ramp(points, n=9, slope=1.0):
    """v = slope x in the unit cube."""
    v = np.broadcast_to(slope * np.linspace(0, 1, n)[:, None, None], (n, n, n))
    return raycast.classified(v, (0, 0, 0), (1, 1, 1), points, SIGMA)


def seen(c, ray, integrated=False, finer=1, gradient=0.0, shading="none"):
    """(L, alpha) of a ray, steps cut by ``finer``."""
    c = c._replace(values=c.values._replace(step=c.values.step / finer))
    L, alpha, _ = raycast.cast(ray, (c.values, raycast.table_of(c, integrated, gradient, shading)))
    return np.array(L), alpha


def test_a_surface_thinner_than_a_step_is_there():
    """Opacity of a ramp is 1 - exp(-sigma integral of o dv), 0.015 here, whatever the steps; midpoints of 8 steps miss it."""
    c = ramp(PEAK)
    want = 1 - np.exp(-SIGMA * 0.015)
    L, alpha = seen(c, ALONG, integrated=True)
    assert alpha == pytest.approx(want, rel=2e-3)  # the peak is met by 1024 nodes, 15 of them in its slopes
    assert seen(c, ALONG)[1] < 0.1 * want
    fine, opaque = seen(c, ALONG, finer=128)
    assert opaque == pytest.approx(want, rel=1e-2)
    assert L == pytest.approx(fine, rel=2e-2)


def test_pre_integration_is_post_classification_in_the_limit(monkeypatch):
    """Steps of a cell against 64 in each: what is left of pre-integration is v's cubic in a cell, none along an edge's ramp."""
    monkeypatch.setattr(raycast, "OPAQUE", 0.0)
    c = ramp(SMOOTH)
    want = seen(c, ALONG, finer=64)[0]
    errors = [np.abs(seen(c, ALONG, integrated=i)[0] - want).max() for i in (True, False)]
    assert errors[0] < 1e-4 and errors[1] > 20 * errors[0]
    # a ray that comes out of the dark end meets the colours in the other order
    back = ((2.0, 0.43, 0.52), (-1.0, 0.0, 0.0))
    assert seen(c, back, integrated=True)[0] == pytest.approx(seen(c, back, finer=64)[0], abs=1e-4)
    assert np.abs(seen(c, back, integrated=True)[0] - want).max() > 0.05


def test_the_table_has_the_functions_themselves_on_its_diagonal():
    c = ramp(SMOOTH)
    pre = raycast.pre_integrated(c.points, 0.7)
    own = np.stack([np.interp(np.linspace(0, 1, raycast.COARSE), SMOOTH[:, 0], SMOOTH[:, k]) for k in range(1, 5)], -1)
    assert np.allclose(np.diagonal(pre).T, own, atol=2e-3)
    assert np.allclose(pre[..., 0], pre[..., 0].T) and not np.allclose(pre[..., 1], pre[..., 1].T, atol=0.01)


def test_mean_opacity_of_a_step_is_the_integral_of_its_function():
    """Of few nodes, between which the table's own lie: the midpoint rule at 1/4000 of the step."""
    points = np.random.default_rng(3).random((6, 4))
    pre = raycast.pre_integrated(points, 0.5)[..., 0]
    ends = np.linspace(0, 1, raycast.COARSE)
    for i, j in ((0, 255), (10, 37), (200, 90), (30, 31), (77, 76)):
        v = ends[i] + (np.arange(4000) + 0.5) / 4000 * (ends[j] - ends[i])
        assert pre[i, j] == pytest.approx(np.interp(v, np.linspace(0, 1, 6), points[:, 0]).mean(), rel=1e-6)


def test_bricks_bound_the_opacity_between_samples():
    """A peak that no sample has is between them: o of the interpolated value, not o of samples interpolated."""
    v = np.random.default_rng(0).choice([0.2, 0.9], (12, 12, 12))
    c = raycast.classified(v, (0, 0, 0), (1, 1, 1), PEAK, SIGMA)
    u = np.random.default_rng(1).random((2000, 3))
    found = np.array([lookups.at_value(c.points, raycast.value(c.values, tuple(11 * p)), 0) for p in u])
    brick = np.ravel_multi_index(((u * 11).astype(int) // 8).T, c.values.bricks)
    assert found.max() > 0.5 and (found <= c.values.brick_max[brick]).all()
    even = raycast.classified(np.full((9, 9, 9), 0.59), (0, 0, 0), (1, 1, 1), SMOOTH, SIGMA)
    assert even.values.brick_max[0] >= lookups.at_value(even.points, 0.59, 0) - 1e-6
    empty = raycast.classified(np.full((12, 12, 12), 0.4), (0, 0, 0), (1, 1, 1), PEAK, SIGMA)
    assert empty.values.brick_max[0] == 0.0  # and is skipped


def test_opacity_by_gradient_shows_surfaces_alone():
    flat = np.array([[0, 0.1, 1, 1, 1], [1, 0.1, 1, 1, 1.0]])
    full = 1 - np.exp(-SIGMA * 0.1)
    assert seen(ramp(flat), ALONG)[1] == pytest.approx(full)
    assert seen(ramp(flat, slope=0.0), ALONG, gradient=0.05)[1] == 0.0
    # a ramp changes by 1/8 of the range from voxel to voxel, at the two faces of the box by half of that
    half = seen(ramp(flat), ALONG, gradient=0.25)[1]
    assert -np.log(1 - half) == pytest.approx(0.5 * SIGMA * 0.1 * (1 - 0.5 / 8), rel=0.05)
    assert seen(ramp(flat), ALONG, gradient=0.05)[1] == pytest.approx(full, rel=1e-9)


@pytest.mark.parametrize("shading", ["lambert", "phong"])
def test_shading_is_by_the_angle_between_gradient_and_ray(shading):
    flat = np.array([[0, 0.4, 0.5, 0.2, 0.1], [1, 0.4, 0.5, 0.2, 0.1]])
    angle = 0.5
    tilted = ((-0.2, 0.1, 0.5), (np.cos(angle), np.sin(angle), 0.0))
    for ray, cosine in ((ALONG, 1.0), (tilted, np.cos(angle))):
        plain, lit = (seen(ramp(flat), ray, shading=s)[0] for s in ("none", shading))
        alpha = seen(ramp(flat), ray)[1]
        gloss = raycast.SPECULAR * cosine**raycast.EXPONENT if shading == "phong" else 0.0
        want = plain * (raycast.AMBIENT + raycast.DIFFUSE * cosine) + alpha * gloss
        assert lit == pytest.approx(want, rel=1e-6)
    assert seen(ramp(flat, slope=0.0), ALONG, shading=shading)[0] == pytest.approx(seen(ramp(flat), ALONG)[0])


def test_a_step_that_sticks_out_of_the_box_counts_by_what_is_inside():
    """One opacity in three bricks, from any distance: the closed form of the chord, its colour and its mean depth. Steps that
    reach across two bricks count once."""
    points = np.array([[0, 0.03, 0.2, 0.5, 0.8], [1.0] * 5])
    c = raycast.classified(np.zeros((25, 9, 9)), (0, 0, 0), (3, 1, 1), points, SIGMA)
    sigma = 0.03 * SIGMA
    alpha = 1 - np.exp(-3 * sigma)
    for integrated in (False, True):
        table = raycast.table_of(c, integrated, 0.0, "none")
        for start in (1.0, 1.03, 1.11, 0.4):
            L, opacity, far = raycast.cast(((-start, 0.4, 0.5), (1.0, 0.0, 0.0)), (c.values, table))
            assert opacity == pytest.approx(alpha, rel=1e-5)
            assert L == pytest.approx(alpha * np.array([0.2, 0.5, 0.8]), rel=1e-5)
            # the mean of t along the chord; midpoints of 1/8 are off by sigma / 12 of their square
            assert far == pytest.approx(start * alpha + alpha / sigma - 3 * np.exp(-3 * sigma), rel=2e-3)


@pytest.mark.parametrize("integrated", [False, True])
def test_a_gap_between_two_bodies_leaves_no_trace(integrated):
    """Two bodies with empty bricks between them, whose steps the ray passes over: each has its own closed form."""
    v = np.zeros((33, 9, 9))
    v[1:6], v[27:] = 1.0, 1.0
    c = raycast.classified(v, (0, 0, 0), (4, 1, 1), np.array([[0, 0, 1, 1, 1], [1, 0.1, 1, 1, 1.0]]), SIGMA)
    assert (c.values.brick_max == 0).any()
    alpha = seen(c, ((-1.03, 0.4, 0.5), (1.0, 0.0, 0.0)), integrated=integrated, finer=8)[1]
    # ramps of a cell on both sides of the first body and before the second are half a cell each
    assert -np.log(1 - alpha) == pytest.approx(0.1 * SIGMA / 8 * (4 + 1 + 5 + 0.5), rel=1e-3)


def test_a_ray_that_comes_out_of_empty_bricks_begins_with_the_value_there():
    """Opacity is in the last of four bricks alone, from its first step on: 1 - exp(-sigma integral of o dv)."""
    band = np.ones((6, 5))
    band[:, :2] = [[0, 0], [0.76, 0], [0.765, 0.1], [0.9, 0.1], [0.905, 0], [1, 0]]
    c = ramp(band, n=33)
    assert (c.values.brick_max.reshape(c.values.bricks)[:3] == 0).all()
    assert -np.log(1 - seen(c, ALONG, integrated=True)[1]) == pytest.approx(0.014 * SIGMA, rel=1e-2)


def test_several_rays_a_pixel_are_the_mean_of_their_places():
    """2 x 2 rays of a pixel of one colour that changes across it, and their opacity and distance, against four pixels."""
    scene = scenes.make("phantom", resolution=14)
    assert isinstance(scene, Scene)
    fine, coarse = (scene.viewpoints.camera(-50.0, 20.0, n, n) for n in (6, 3))
    one, four = RayCast().render(scene, fine), RayCast(side=2).render(scene, coarse)
    for name in ("rgb", "alpha", "distance"):
        each = getattr(one, name)
        mean = (each[0::2, 0::2] + each[1::2, 0::2] + each[0::2, 1::2] + each[1::2, 1::2]) / 4
        assert np.allclose(getattr(four, name), mean, atol=1e-12) and np.ptp(each) > 0.1


def test_gradients_of_cells_that_are_no_cubes():
    x, y, z = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9), np.linspace(0, 1, 9), indexing="ij")
    c = raycast.classified(0.1 + 0.3 * x + 0.2 * y + 0.4 * z, (0, 0, 0), (1, 2, 4), SMOOTH, SIGMA)
    assert raycast.gradient_at(c.values, (3.3, 4.1, 4.9)) == pytest.approx((0.3, 0.1, 0.1), rel=1e-5)
    assert raycast.value(c.values, (4.0, 2.0, 6.0)) == pytest.approx(0.1 + 0.15 + 0.05 + 0.3, rel=1e-6)


def test_emission_of_a_scan_shows_its_colours():
    """Nothing glows in it, and yet it is not black: what a viewer of scans shows; alpha is that of marching, to its steps."""
    scene = scenes.make("phantom", resolution=14)
    assert (
        isinstance(scene, Scene) and not np.any(scene.medium.Le) and {"emission", "raycast"} <= set(scene.integrators)
    )
    camera = scene.viewpoints.camera(-50.0, 20.0, 7, 7)
    picture, cast = (i.render(scene, camera) for i in (Emission(), RayCast()))
    assert np.array_equal(picture.rgb, cast.rgb) and picture.rgb.mean() > 0.03
    scene.lights = scene.lights[:1]  # marching lays beams over a sky by compiled code
    assert abs(picture.alpha - March(mode=3).render(scene, camera).alpha).mean() < 0.05
    assert (picture.distance / np.maximum(picture.alpha, 1e-9))[picture.alpha > 0.5] == pytest.approx(4.0, abs=1.2)
    assert RayCast(shading="phong").render(scene, camera).rgb.mean() < cast.rgb.mean()


TEXT = "# bone\n-400 0 1 0 0\n200 0.5 1 0.5 0\n520 1 1 1 1\n"
FORMS = {
    "t.txt": TEXT,
    "t.csv": "value,opacity,red,green,blue\n-400,0,1,0,0\n200,0.5,1,0.5,0\n520,1,1,1,1\n",
    "rows.json": json.dumps([[-400, 0, 1, 0, 0], [200, 0.5, 1, 0.5, 0], [520, 1, 1, 1, 1]]),
    "named.json": json.dumps({"points": [
        {"value": -400, "opacity": 0, "colour": [1, 0, 0]}, {"value": 200, "opacity": 0.5, "color": [1, 0.5, 0]},
        {"value": 520, "opacity": 1, "colour": [1, 1, 1]},
    ]}),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMS)
def test_transfer_functions_in_every_form(tmp_path, name):
    (tmp_path / name).write_text(FORMS[name])
    assert np.array_equal(
        transfer.read(tmp_path / name), [[-400, 0, 1, 0, 0], [200, 0.5, 1, 0.5, 0], [520, 1, 1, 1, 1]]
    )


@pytest.mark.parametrize("name, text", [
    ("a.json", "{"), ("a.json", "3"), ("a.json", '{"points": [{"value": 1}]}'), ("a.json", "[[true, 0, 0, 0, 0]]"),
    ("a.json", '[[0, 0, "1", 0, 0]]'), ("a.csv", "value,opacity\n0,1\n"), ("a.csv", "0,1,1,1,1\n1,1,1,1\n"),
    ("a.txt", "0 0 1 1 1\n1 nan 1 1 1\n"), ("a.txt", "0 0 1 1 1\n1 1e999 1 1 1\n"), ("a.json", "[" * 100_000),
    ("a.txt", "0 0 1 1 1\n0 1 1 1 1\n"), ("a.txt", "0 0 1 1 1\n1 1.01 1 1 1\n"),
])  # fmt: skip
def test_what_is_no_transfer_function_is_one_sentence(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=rf"{name}: expected") as said:
        transfer.read(tmp_path / name)
    assert "\n" not in str(said.value) and len(str(said.value)) < 300


def test_a_transfer_function_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "LARGEST", 100)
    (tmp_path / "t.txt").write_text(TEXT + "# " + 100 * "x")
    with pytest.raises(InputError, match="at most"):
        transfer.read(tmp_path / "t.txt")


def test_the_window_leaves_out_air_and_metal():
    rng = np.random.default_rng(0)
    body = rng.normal(300, 60, 30_000).clip(1, 900)
    scan = np.concatenate([np.full(70_000, -1000.0), body, np.full(60, 30_000.0)])
    low, high = transfer.window(scan)
    assert -1000 <= low < -800 and 400 < high <= 900
    assert high == np.quantile(scan[scan > -1000], transfer.TOP, method="inverted_cdf")
    assert transfer.window(np.linspace(0, 1, 5000)) == (0.0, 1.0)  # no air: all of it
    assert transfer.window(np.zeros(10)) == (0.0, 0.0)


def test_the_real_scan_shows_something():
    """A stent: by the histogram's window some hundredths of the pixels are opaque, by the range of all values hardly any."""
    path = Path(os.environ.get("NERFVOL_DATA", "")) / "volumes" / "stent.npz"
    if not path.is_file():
        pytest.skip("NERFVOL_DATA has no volumes/stent.npz")
    scene = scenes.make("phantom", volume=str(path))
    camera = Camera(24, 12, 30.0, look_at((0, -4, 0.4), (0, 0, 0)))
    assert isinstance(scene, Scene)
    alpha = RayCast(integrated=False).render(scene, camera).alpha
    values, _ = volumes.read_volume(path)
    whole = scene.classified.values, values / values.max()
    scene.classified = raycast.classified(whole[1], whole[0].lo, whole[0].hi, TISSUE, scene.classified.sigma)
    before = RayCast(integrated=False).render(scene, camera).alpha
    assert (alpha > 0.5).mean() > 0.03 and alpha.mean() > 1.5 * before.mean()


def test_what_raycast_does_not_know_is_refused():
    with pytest.raises(InputError, match="has no transfer function"):
        RayCast().render(Scene(name="empty"), Camera(2, 2, 2.0, look_at((0, -3, 0), (0, 0, 0))))
    with pytest.raises(InputError, match="none, lambert, phong"):
        RayCast(shading="flat")
    with pytest.raises(InputError, match="from 0 on"):
        RayCast(gradient=-1.0)
