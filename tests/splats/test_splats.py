"""Splats as plain arrays and in blocks; what changes which splats there are."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.errors import InputError
from nerfvol.kernels import splat_ops
from nerfvol.kernels.splat_state import SplatState
from nerfvol.rotations import rotations
from nerfvol.splats import packing
from nerfvol.splats.splats import Splats, concatenate
from tests.splats.scenes import ORIGIN, random_image, random_splats, view_of_cube

FIELDS = ("means", "log_scales", "quats", "logits", "sh")


def assert_same(a: Splats, b: Splats) -> None:
    for name in (*FIELDS, "origin", "mode"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 100])
def test_packing_is_exact(n):
    splats = random_splats(n, 9, 1)
    packed = packing.pack(splats)
    assert packed.params.shape == (-(-n // 16), 38, 16)
    assert n == 0 or packed.params.ctypes.data % 64 == 0
    assert packed.sh_degree == splats.sh_degree == 2
    assert_same(packing.unpack(packed), splats)


def test_splats_in_free_lanes_are_not_seen(isa):
    out = splat_ops.render_splats(random_splats(3, 1, 0).select([]), view_of_cube(), outputs=("opacity",))
    assert not out["opacity"].any()
    state = SplatState(random_splats(17, 1, 0, size=0.5))
    view = view_of_cube()
    report = splat_ops.train_step(state, view, random_image(view, 0), splat_ops.SplatOptions(), splat_ops.SplatRates())
    assert report.visible <= 17 and not state.updates.reshape(-1)[17:].any()


@pytest.mark.parametrize("name,value,message", [
    ("means", np.full((5, 3), np.nan), "means must be finite, 5 rows"),
    ("sh", np.full((5, 3, 4), np.inf), "sh must be finite"),
    ("origin", (0, 0, np.inf), "origin must be finite"),
    ("quats", np.zeros((5, 4)), "quats must not be zero, 5 of 5"),
    ("quats", np.zeros((5, 3)), r"quats must have shape \(5, 4\)"),
    ("logits", np.zeros((5, 1)), "logits must have shape"),
    ("log_scales", np.zeros((4, 3)), "log_scales must have shape"),
    ("sh", np.zeros((5, 3, 5)), "sh must have shape"),
    ("mode", "smooth", "mode must be among"),
])  # fmt: skip
def test_validate_names_what_is_wrong(name, value, message):
    splats = random_splats(5, 4, 0)
    assert splats.validate() is splats
    arguments = {k: getattr(splats, k) for k in (*FIELDS, "origin", "mode")} | {name: value}
    with pytest.raises(InputError, match=message):
        Splats(**arguments).validate()


def test_select_concatenate_and_degrees():
    a, b = random_splats(7, 4, 1), random_splats(5, 1, 2)
    b.origin = ORIGIN + (1.0, 0.0, -2.0)
    both = concatenate([a, b])
    assert both.n == 12 and both.sh_degree == 1 and np.array_equal(both.origin, a.origin)
    assert np.allclose(both.means[7:] + both.origin, b.means + b.origin, atol=1e-6)
    assert_same(a.concatenate(b).select(np.arange(12) < 7), a)
    assert np.array_equal(a.with_sh_degree(3).with_sh_degree(1).sh, a.sh) and not a.with_sh_degree(2).sh[..., 4:].any()
    with pytest.raises(InputError, match="different modes"):
        concatenate([a, random_splats(1, 1, 0, "plain")])


def test_aabb_holds_three_deviations():
    s = random_splats(40, 1, 3)
    low, high = s.aabb()
    sphere = np.random.default_rng(0).normal(size=(2000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = np.einsum("nij,npj->npi", rotations(s.quats), 3 * np.exp(s.log_scales)[:, None] * sphere[None])
    points = (points + s.means[:, None] + s.origin).reshape(-1, 3)
    assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()
    assert np.allclose(points.min(0), low, atol=0.02) and np.allclose(points.max(0), high, atol=0.02)


def test_a_camera_and_its_view_see_the_same_pixels():
    camera = Camera(Intrinsics(64, 48, 70, 66, 30, 25), look_at((4, 3, 2.5), ORIGIN))
    s = random_splats(30, 1, 4)
    view = splat_ops.view_of(camera, s.origin)
    t = s.means @ view.rotation.T + view.translation
    ours = t[:, :2] / t[:, 2:] * (view.fx, view.fy) + (view.cx, view.cy)
    assert np.abs(ours - camera.project(s.means + s.origin)).max() < 1e-4
    assert np.allclose(view.eye + s.origin, camera.position)
    with pytest.raises(InputError, match="pinhole"):
        splat_ops.view_of(Camera(Intrinsics(64, 48, 70, 66, 30, 25, k1=0.1), camera.c2w), s.origin)


def trained_state(n: int = 50) -> SplatState:
    state, view = SplatState(random_splats(n, 4, 8)), view_of_cube()
    for k in range(2):
        splat_ops.train_step(state, view, random_image(view, k), splat_ops.SplatOptions(), splat_ops.SplatRates())
    return state


def rows_of(state: SplatState) -> np.ndarray:
    """(n, everything): all arrays of the state side by side."""
    arrays = [getattr(state, name) for name in SplatState.ARRAYS]
    blocks = [a if a.ndim == 3 else a[:, None] for a in arrays]
    return np.concatenate([packing.from_blocks(b, state.n) for b in blocks], axis=1)


def test_gather_and_prune_keep_everything_of_a_splat():
    state = trained_state()
    rows = rows_of(state)
    index = np.random.default_rng(0).permutation(50)[:37]
    state.gather(index)
    assert state.n == 37 and np.array_equal(rows_of(state), rows[index])
    assert (state.params[-1, packing.LOGIT, 37 % 16 :] == packing.UNSEEN).all()
    keep = rows[index, 10] > 0
    state.prune(keep)
    assert np.array_equal(rows_of(state), rows[index][keep])
    state.check()
    with pytest.raises(ValueError, match="indices"):
        state.gather([0, 50])


def test_split():
    state = trained_state()
    before, rows = state.splats(), rows_of(state)
    second, chosen = packing.from_blocks(state.second, 50), [3, 20, 49]
    state.split(chosen)
    after, places = state.splats(), [3, 21, 51]
    assert state.n == 53
    others = np.delete(rows_of(state), [p + k for p in places for k in (0, 1)], axis=0)
    assert np.array_equal(others, np.delete(rows, chosen, axis=0))
    for old, place in zip(chosen, places, strict=True):
        longest = before.log_scales[old].argmax()
        axis = rotations(before.quats[old : old + 1])[0, :, longest]
        for k, sign in ((place, 0.6), (place + 1, -0.6)):
            expected = before.means[old] + sign * np.exp(before.log_scales[old, longest]) * axis
            assert np.allclose(after.means[k], expected, atol=1e-6)
            shrunk = before.log_scales[old] - np.log(1.7) * (np.arange(3) == longest)
            assert np.allclose(after.log_scales[k], shrunk, atol=1e-6)
            assert not packing.from_blocks(state.first, 53)[k].any()
            assert np.array_equal(packing.from_blocks(state.second, 53)[k], second[old] / 2)


def test_grow_draws_by_error():
    state = trained_state()
    state.per_splat("error")[:] = 0
    state.per_splat("error")[[5, 9, 30]] = (1.0, 2.0, 3.0)
    assert state.grow(2, np.random.default_rng(0)) == 2 and state.n == 52
    assert state.grow(20, np.random.default_rng(0)) == 5 and state.n == 57  # two pairs and the one that was left
    assert state.per_splat("error").max() == pytest.approx(3 * 0.3**2)
    state.per_splat("error")[:] = 0
    assert state.grow(3, np.random.default_rng(0)) == 0 and state.n == 57


def test_reorder_is_along_a_morton_curve():
    state = SplatState(random_splats(4000, 1, 9))
    state.params[0, :3, 0] = 1e6  # far away is no exception
    rows = np.sort(rows_of(state)[:, 0])
    state.reorder()
    assert np.array_equal(np.sort(rows_of(state)[:, 0]), rows)
    means = state.splats().means
    steps = np.linalg.norm(np.diff(means, axis=0), axis=1)
    assert np.median(steps) < 0.15  # 1.3 in random order
    order = np.random.default_rng(1).permutation(4000)
    box = (np.zeros(3), 1.0)
    state.reorder(*box)
    means = state.splats().means
    state.gather(order)
    state.reorder(*box)
    assert np.array_equal(state.splats().means, means)


def test_a_checkpoint_brings_everything_back():
    state = trained_state()
    again = SplatState.from_arrays({name: a.copy() for name, a in state.arrays().items()})
    assert (
        np.array_equal(rows_of(again), rows_of(state))
        and again.mode == state.mode
        and np.array_equal(again.origin, ORIGIN)
    )
    arrays = state.arrays() | {"first": state.first[:-1]}
    with pytest.raises(ValueError, match="first must be"):
        SplatState.from_arrays(arrays)
