"""Splats as a model: a wall that is known, lenses, backgrounds, far cameras, the near plane, files."""

import dataclasses
import json

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.clouds import PointModel
from nerfvol.errors import InputError
from nerfvol.kernels.splat_state import SplatState
from nerfvol.splats.io import load_splats, save_splats
from nerfvol.splats.points import PointCloud
from nerfvol.splats.splats import Splats
from nerfvol.views import OctreeModel, SplatModel, depth_range, surface_depth, unit_normal

SLOPE = np.array([[0.1, 0.0, 0.02], [0.02, 0.0, -0.1], [-0.07, 0.0, 0.06]])
"""Of the wall's colours by place."""
PLACE = np.array([500.0, -20.0, 30.0])
"""The middle of the wall."""


def wall(y=0.0, half=4.0, step=0.03, colour=None, seed=0) -> Splats:
    """A wall across the y axis: discs in the plane, closed, of colours that change evenly along it."""
    at = np.arange(-half, half, step)
    x, z = (a.ravel() for a in np.meshgrid(at, at))
    means = np.stack([x, np.full(len(x), y), z], 1)
    colours = 0.5 + means @ SLOPE.T if colour is None else np.tile(colour, (len(x), 1))
    order = np.random.default_rng(seed).permutation(len(x))
    n = len(x)
    scales = np.tile(np.log([step, 1e-4, step]), (n, 1))
    sh = ((colours - 0.5) / 0.28209479177387814)[:, :, None]
    quats = np.tile((1.0, 0, 0, 0), (n, 1))
    return Splats(means[order], scales, quats, np.full(n, 6.0), sh[order], PLACE)


def expected(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What the wall looks like: distances (h, w) along the rays and colours."""
    lens = camera.intrinsics
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    origin, directions = camera.rays_at(np.stack([x, y], -1).reshape(-1, 2))
    t = (PLACE[1] - origin[1]) / directions[:, 1]
    colours = 0.5 + (origin + t[:, None] * directions - PLACE) @ SLOPE.T
    return t.reshape(lens.height, lens.width), colours.reshape(lens.height, lens.width, 3)


def camera_at(lens: Intrinsics, eye=(-1.0, -3.0, 0.4)) -> Camera:
    return Camera(lens, look_at(PLACE + eye, PLACE + (0.1, 0, -0.1)))


PINHOLE = Intrinsics(64, 48, 60.0, 62.0, 33.0, 22.5)
LENSES = {
    "pinhole": PINHOLE, "barrel": dataclasses.replace(PINHOLE, k1=-0.18, k2=0.04),
    "pincushion": dataclasses.replace(PINHOLE, k1=0.12, k2=0.02, p1=0.004),
    "fisheye": Intrinsics(64, 48, 58.0, 58.0, 32.0, 24.0, k1=0.03, fisheye=True),
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_a_wall_is_where_it_is_through_any_lens(compiled, name):
    """Distances along the rays and colours, pixel by pixel. Where a wall is seen aslant the nearer discs come first, so that
    it appears nearer by a share of their width: 0.7 %."""
    camera = camera_at(LENSES[name])
    distance, colours = expected(camera)
    picture = SplatModel(wall()).render(camera, (0, 0, 0), ("rgb", "depth", "median_depth", "opacity", "normal"))
    assert picture["opacity"].min() > 0.99
    np.testing.assert_allclose(picture["median_depth"], distance, rtol=9e-3)
    np.testing.assert_allclose(surface_depth(picture), distance, rtol=9e-3)
    np.testing.assert_allclose(picture["rgb"], colours, atol=1.2e-2)
    np.testing.assert_allclose(unit_normal(picture), np.broadcast_to([0.0, -1, 0], colours.shape), atol=2e-3)
    assert np.abs(picture["rgb"] - colours).mean() < 6e-3
    behind = camera_at(LENSES[name], (-1.0, 3.0, 0.4))  # normals are turned to whoever looks
    assert unit_normal(SplatModel(wall()).render(behind, outputs=("normal",)))[..., 1].min() > 0.99


def test_a_lens_changes_the_picture_as_it_should(compiled):
    """The bounds above tell lenses apart: a pinhole's picture is no barrel's."""
    camera = camera_at(LENSES["barrel"])
    as_pinhole = SplatModel(wall()).render(camera_at(PINHOLE), outputs=("rgb", "median_depth"))
    distance, colours = expected(camera)
    assert np.abs(as_pinhole["rgb"] - colours).max() > 0.02
    assert np.abs(as_pinhole["median_depth"] / distance - 1).max() > 0.015


def test_the_background_is_the_one_asked_for_or_the_models_own_or_white(compiled):
    away = Camera(PINHOLE, look_at(PLACE + (0, -3, 0), PLACE + (0, -9, 0)))
    for splats in (wall(step=0.5), wall().select([])):
        for metadata, asked, colour in [
            ({}, None, (1, 1, 1)), ({"background": [0.1, 0.2, 0.3]}, None, (0.1, 0.2, 0.3)),
            ({"background": [0.1, 0.2, 0.3]}, (0.9, 0, 0), (0.9, 0, 0)),
        ]:  # fmt: skip
            model = SplatModel(splats, metadata)
            for lens in LENSES.values():
                shown = model.render(dataclasses.replace(away, intrinsics=lens), asked, ("rgb", "opacity", "depth"))
                np.testing.assert_allclose(shown["rgb"], np.broadcast_to(colour, shown["rgb"].shape), atol=1e-6)
                assert not shown["opacity"].any() and not shown["depth"].any()


def test_a_half_transparent_wall_shows_the_background(compiled):
    splats = wall()
    splats.logits[:] = -3.0
    picture = SplatModel(splats).render(camera_at(PINHOLE), (0, 0, 1), ("rgb", "opacity"))
    black = SplatModel(splats).render(camera_at(PINHOLE), (0, 0, 0))
    assert 0.05 < picture["opacity"].mean() < 0.95
    added = (1 - picture["opacity"])[..., None] * np.array([0, 0, 1])
    np.testing.assert_allclose(picture["rgb"] - black["rgb"], added, atol=2e-4)


def test_a_model_of_nothing(compiled, tmp_path):
    model = SplatModel(wall().select([]))
    assert model.describe()["splats"] == 0 and np.isfinite(model.aabb()).all()
    model.save(tmp_path / "none.safetensors")
    assert SplatModel.load(tmp_path / "none.safetensors").packed.n == 0
    near, far = depth_range(model, [camera_at(PINHOLE)])
    assert 0 <= near <= far


def test_an_unknown_storage_is_one_sentence_from_every_model(tmp_path, sphere_octree):
    """Splats have one storage; a wrong name is still a mistake."""
    points = PointModel(PointCloud(np.eye(3), np.full((3, 3), 0.5, np.float32)))
    for model in (OctreeModel(sphere_octree), SplatModel(wall(step=1.0)), points):
        with pytest.raises(InputError, match="storage should be float32, float16, compact or mapped, got 'int3'"):
            model.save(tmp_path / "a.safetensors", "int3")
    assert not (tmp_path / "a.safetensors").exists()


@pytest.mark.parametrize("far", [3.0, 100.0, 3000.0])
def test_what_is_before_hides_what_is_behind_however_far_the_camera(compiled, far):
    """Through a telescope; the kernels order depths over 16 octaves behind the near plane alone."""
    red, blue = wall(0.0, 1.0, 0.1, (1.0, 0, 0)), wall(0.4, 1.0, 0.1, (0, 0, 1.0))
    both = dataclasses.replace(blue, **{
        name: np.concatenate([getattr(blue, name), getattr(red, name)])
        for name in ("means", "log_scales", "quats", "logits", "sh")
    })  # fmt: skip
    lens = Intrinsics(24, 24, 16.0 * far, 16.0 * far, 12.0, 12.0)
    camera = Camera(lens, look_at(PLACE - (0, far, 0), PLACE))
    assert SplatModel(both).render(camera)["rgb"][12, 12, 0] > 0.95
    camera = Camera(lens, look_at(PLACE + (0, far, 0), PLACE))
    assert SplatModel(both).render(camera)["rgb"][12, 12, 2] > 0.95


def test_what_is_nearer_than_near_is_not_drawn(compiled):
    red, blue = wall(0.0, 1.0, 0.1, (1.0, 0, 0)), wall(1.0, 1.0, 0.1, (0, 0, 1.0))
    both = dataclasses.replace(blue, **{
        name: np.concatenate([getattr(blue, name), getattr(red, name)])
        for name in ("means", "log_scales", "quats", "logits", "sh")
    })  # fmt: skip
    camera = Camera(PINHOLE, look_at(PLACE - (0, 2.0, 0), PLACE))
    for near, colour in [(None, 0), (1.9, 0), (2.1, 2), (2.9, 2)]:
        shown = SplatModel(both, {} if near is None else {"near": near}).render(camera)["rgb"][22, 33]
        assert shown[colour] > 0.95, (near, shown)
    assert SplatModel(both, {"near": 3.1}).render(camera)["rgb"].min() > 0.999  # neither


def test_without_a_near_plane_it_follows_the_size_of_the_model(compiled):
    """In any unit, and with a few splats far away, a camera as near as a hundredth of the size sees what is before it."""
    for unit in (1e-6, 1.0, 1e6):
        splats = wall(0.0, 1.0, 0.05, (1.0, 0, 0))
        means = splats.means * unit
        means[:3] = [[0, 1e4 * unit, 0]] * 3
        small = dataclasses.replace(splats, means=means, log_scales=splats.log_scales + np.float32(np.log(unit)))
        small = dataclasses.replace(small, origin=np.zeros(3))
        camera = Camera(PINHOLE, look_at((0, -0.01 * unit, 0), (0, 0, 0)))
        assert SplatModel(small).render(camera, (0, 0, 0))["rgb"][22, 33, 0] > 0.9


@pytest.mark.parametrize("near", [0, -1.0, "close", [1], float("nan"), float("inf"), True, {}])
def test_a_near_plane_that_is_none_is_refused(tmp_path, near):
    with pytest.raises(InputError, match="near must be a positive number"):
        SplatModel(wall(step=1.0), {"near": near})
    if isinstance(near, float) and not np.isfinite(near):
        return  # no JSON
    path = tmp_path / "a.safetensors"
    save_splats(path, wall(step=1.0), {"near": near})
    with pytest.raises(InputError, match="a.safetensors: splats: near must be"):
        SplatModel.load(path)


@pytest.mark.parametrize("mode", ["mip", "plain"])
def test_saved_and_loaded_it_is_the_same_to_the_bit(compiled, tmp_path, mode):
    rng = np.random.default_rng(0)
    splats = dataclasses.replace(wall(step=0.3), mode=mode, origin=np.array([1e6 + 1 / 3, -2 / 7, 1e-9]))
    splats = dataclasses.replace(splats, sh=rng.normal(0, 0.3, (splats.n, 3, 9)).astype(np.float32))
    splats = dataclasses.replace(splats, quats=rng.normal(size=(splats.n, 4)).astype(np.float32))
    model = SplatModel(splats, {"background": [0.25, 0.5, 0.75], "near": 0.03125, "note": {"a": [1, "é"]}})
    model.save(tmp_path / "a.safetensors")
    again = SplatModel.load(tmp_path / "a.safetensors")
    assert again.metadata == model.metadata and json.dumps(again.describe()) == json.dumps(model.describe())
    for field in dataclasses.fields(Splats):
        a, b = getattr(again.splats, field.name), getattr(splats, field.name)
        assert a == b if isinstance(a, str) else a.dtype == b.dtype and a.tobytes() == b.tobytes(), field.name
    camera = Camera(PINHOLE, look_at(splats.origin + (0, -3, 0), splats.origin))
    names = ("rgb", "depth", "median_depth", "opacity", "normal")
    for name, picture in model.render(camera, outputs=names).items():
        assert picture.tobytes() == again.render(camera, outputs=names)[name].tobytes(), name
    assert load_splats(tmp_path / "a.safetensors")[0].n == splats.n


def test_a_model_of_packed_splats_shares_them(compiled):
    """What a trainer draws is what it trains."""
    splats = wall(step=0.3)
    state = SplatState(splats)
    model = SplatModel(state.packed)
    assert model.packed.params is state.params
    np.testing.assert_array_equal(model.splats.means, splats.means)


def test_the_box_leaves_out_what_is_far_but_little(compiled):
    """Of 71,289 splats a hundred are far out: the box is the wall's, three deviations wide."""
    splats = wall()
    means = splats.means.copy()
    means[:100] += np.float32(1e5)
    low, high = SplatModel(dataclasses.replace(splats, means=means)).aabb() - PLACE
    assert (low > (-4.5, -0.1, -4.5)).all() and (high < (4.5, 0.1, 4.5)).all()
    assert (low < (-3.7, 0.0, -3.7)).all() and (high > (3.7, 0.0, 3.7)).all()
