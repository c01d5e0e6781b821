"""Pictures and gradients of the kernels against the float64 twin, and the twin against central differences."""

import functools

import numpy as np
import pytest
import torch

from nerfvol.kernels import splat_ops, splat_reference
from nerfvol.kernels.splat_reference import Parameters
from nerfvol.splats import packing
from tests.splats.scenes import BACKGROUND, random_image, random_splats, special_splats, view_of_cube

NAMES = ("means", "log_scales", "quats", "logits", "sh")
ALL = splat_ops.SplatOptions(BACKGROUND, 0.5, 0.7, 0.3, 0.02, 0.03, 3e-3, 0.0)
LOSSES = {
    "all": ALL,
    "squared": splat_ops.SplatOptions(BACKGROUND, early_stop_eps=0.0, weight_threshold=0.0),
    "l1": splat_ops.SplatOptions(BACKGROUND, 1.0, 0.0, early_stop_eps=0.0, weight_threshold=0.0),
    "ssim": splat_ops.SplatOptions(BACKGROUND, 0.0, 0.0, 1.0, early_stop_eps=0.0, weight_threshold=0.0),
    "threshold": splat_ops.SplatOptions(BACKGROUND, 0.3, 1.0, weight_threshold=0.02),
}


def by_name(splats, blocks) -> dict[str, np.ndarray]:
    rows = packing.from_blocks(blocks, splats.n)
    ends = np.cumsum([3, 3, 4, 1])
    return dict(zip(NAMES, np.split(rows, ends, axis=1), strict=True))


@functools.cache
def case(scene: str, basis: int, mode: str, loss: str):
    """Splats, view, image, and the twin's gradients and loss of them."""
    splats = special_splats(48, basis, basis, mode) if scene == "special" else random_splats(40, basis, 7, mode)
    view = view_of_cube()
    image = random_image(view, 1, 0.1 if scene == "special" else 0.02)
    p = Parameters.of(splats, requires_grad=True)
    parts = splat_reference.loss(p, view, image, LOSSES[loss], mode)
    return splats, view, image, torch.autograd.grad(parts.loss, p.tensors()), parts


def assert_gradients_agree(scene: str, basis: int, mode: str, loss: str, tolerance=1e-5):
    """Each number to ``tolerance`` of the largest in its group, the group's norm as well.

    Those of quaternions and of log-scales are made of the same products dL/dA * A; in a quaternion's they cancel as the splat
    comes near to a ball, so that the rounding of both is measured by the larger one.
    """
    splats, view, image, theirs, parts = case(scene, basis, mode, loss)
    ours, report = splat_ops.loss_gradient(splat_ops.SplatState(splats), view, image, LOSSES[loss])
    true = {name: b.numpy().reshape(splats.n, -1) for name, b in zip(NAMES, theirs, strict=True)}
    for name, a in by_name(splats, ours).items():
        b = true[name]
        scale = max(np.abs(b).max(), np.abs(true["log_scales"]).max() if name == "quats" else 0)
        assert np.abs(b).max() > 0, name
        assert np.abs(a - b).max() <= tolerance * scale, name
        assert np.linalg.norm(a - b) <= tolerance * np.linalg.norm(b), name
    assert report.loss == pytest.approx(parts.of_pixels, rel=1e-5)
    assert report.squared_error == pytest.approx(parts.squared_error, rel=1e-5)


@pytest.mark.parametrize("mode", ["mip", "plain"])
@pytest.mark.parametrize("basis", [1, 4, 9, 16])
def test_gradients_of_all_parameters(isa, basis, mode):
    assert_gradients_agree("special", basis, mode, "all")


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_of_each_term(isa, loss):
    assert_gradients_agree("random", 4, "mip", loss)


def test_the_special_scene_is_special():
    """Every clamp acts on some splat, and some pixels end early, so that the gradients above pass through all of them."""
    splats, view = special_splats(48, 4, 4, "mip"), view_of_cube()
    f = splat_reference.project(Parameters.of(splats), view, "mip")
    t = splats.means.astype(float) @ view.rotation.T + view.translation
    u = t[:, 0] / t[:, 2]
    centre, field = (view.width / 2 - view.cx) / view.fx, view.width / (2 * view.fx)
    assert (np.abs(u - centre) > 1.3 * field).any()
    rho = f.opacity / torch.sigmoid(torch.tensor(splats.logits).double())
    assert (rho < 0.00501).any() and (rho > 0.9).any()
    assert (f.colour == 0).any()
    alphas = [tile.alpha for tile in splat_reference.tiles(f, view)]
    assert any((a == 0.99).any() for a in alphas)
    assert any((splat_reference.weights(a, 0.0)[1] < 1e-3).any() for a in alphas)


@pytest.mark.parametrize("mode", ["mip", "plain"])
def test_the_twin_against_central_differences(mode):
    """Along random directions in each group of parameters, away from the clamps."""
    splats, view = random_splats(24, 4, 11, mode, size=0.3), view_of_cube(32, 32)
    options = splat_ops.SplatOptions(BACKGROUND, 0.0, 1.0, 0.3, 0.02, 0.03, 0.0, 0.0)
    image = random_image(view, 3)
    p = Parameters.of(splats, requires_grad=True)
    gradients = splat_reference.gradients(p, view, image, options, mode)
    rng = np.random.default_rng(0)
    h = 1e-7
    for k, g in enumerate(gradients):
        direction = torch.from_numpy(rng.normal(size=tuple(g.shape)))
        ends = []
        for sign in (h, -h):
            moved = [a.detach() + sign * direction if i == k else a.detach() for i, a in enumerate(p.tensors())]
            ends.append(float(splat_reference.loss(Parameters(*moved), view, image, options, mode).loss))
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(float((g * direction).sum()), rel=3e-4), NAMES[k]


@functools.cache
def pictured(mode: str, eps: float):
    splats, view = special_splats(60, 9, 21, mode), view_of_cube(90, 61)
    return splats, view, splat_reference.render(Parameters.of(splats), view, BACKGROUND, eps, mode)


@pytest.mark.parametrize("mode", ["mip", "plain"])
@pytest.mark.parametrize("eps", [0.0, 1e-2])
def test_pictures(isa, mode, eps):
    splats, view, theirs = pictured(mode, eps)
    ours = splat_ops.render_splats(splats, view, BACKGROUND, eps, splat_ops.OUTPUTS)
    for name in splat_ops.OUTPUTS:
        assert ours[name].dtype == np.float32
        assert np.abs(ours[name] - theirs[name].numpy()).max() < 2e-5, name
    few = splat_ops.render_splats(splats, view, BACKGROUND, eps)
    assert list(few) == ["rgb"] and np.array_equal(few["rgb"], ours["rgb"])


def test_depth_of_a_wall_is_the_distance_along_the_ray(isa):
    """A wide opaque splat in a plane that faces the camera: depth = z times the ray's length, wherever the pixel is."""
    splats, view = random_splats(1, 1, 0), view_of_cube(64, 48)
    splats.means[0] = -view.rotation.T @ view.translation + 2.0 * view.rotation[2]
    splats.log_scales[:], splats.logits[:] = np.log(5.0), 12.0
    out = splat_ops.render_splats(splats, view, outputs=("depth", "median_depth", "opacity"))
    x = (np.arange(64) + 0.5 - view.cx) / view.fx
    y = (np.arange(48) + 0.5 - view.cy) / view.fy
    distance = 2 * np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    assert np.abs(out["median_depth"] - distance).max() < 1e-5
    assert np.abs(out["depth"] - distance * out["opacity"]).max() < 1e-5


# ------------------------------------------------------------------ the camera's motion
@pytest.mark.parametrize("mode", ["mip", "plain"])
@pytest.mark.parametrize("basis", [1, 4, 9, 16])
def test_gradient_in_the_camera_s_motion(isa, basis, mode):
    """Through means, covariances and the direction of the colours; every clamp acts on some splat."""
    splats, view, image, _, _ = case("special", basis, mode, "all")
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    parts = splat_reference.loss(Parameters.of(splats), view, image, ALL, mode, motion)
    (true,) = torch.autograd.grad(parts.loss, motion)
    state = splat_ops.SplatState(splats)
    report = splat_ops.train_step(state, view, image, ALL, splat_ops.SplatRates(*[0.0] * 6), motion=True)
    ours = np.array(report.motion)
    # A sum over 48 splats of gradients that are right to 1e-5 of the largest each, which may cancel.
    for part in (slice(0, 3), slice(3, 6)):
        assert np.abs(ours[part] - true.numpy()[part]).max() <= 1e-4 * np.abs(true.numpy()[part]).max()
    assert splat_ops.loss_gradient(splat_ops.SplatState(splats), view, image, ALL)[1].motion == report.motion
    assert splat_ops.train_step(state, view, image, ALL, splat_ops.SplatRates()).motion is None


@pytest.mark.parametrize("mode", ["mip", "plain"])
def test_the_twin_s_motion_against_central_differences(mode):
    splats, view = random_splats(24, 4, 11, mode, size=0.3), view_of_cube(32, 32)
    options = splat_ops.SplatOptions(BACKGROUND, 0.0, 1.0, 0.3, 0.02, 0.03, 0.0, 0.0)
    image = random_image(view, 3)
    p, motion = Parameters.of(splats), torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (true,) = torch.autograd.grad(splat_reference.loss(p, view, image, options, mode, motion).loss, motion)
    for k in range(6):
        ends = []
        for h in (1e-7, -1e-7):
            step = torch.zeros(6, dtype=torch.float64)
            step[k] = h
            ends.append(float(splat_reference.loss(p, view, image, options, mode, step).loss))
        assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(
            float(true[k]), rel=3e-4, abs=1e-4 * float(true.abs().max())
        ), k


def test_a_moved_view_is_a_moved_scene():
    """Turning the camera's axes by w about a point and shifting them by v shows the same as the inverse motion of the scene."""
    view = view_of_cube()
    motion = torch.tensor([0.1, -0.2, 0.05, 0.3, 0.1, -0.2], dtype=torch.float64)
    rotation, translation, eye = splat_reference.moved(view, motion)
    t = torch.tensor([0.4, 0.2, 2.0], dtype=torch.float64)  # in the axes before
    x = torch.tensor(view.rotation.T) @ (t - torch.tensor(view.translation))
    w = motion[:3].numpy()
    angle = np.linalg.norm(w)
    k = np.cross(w / angle, np.eye(3)).T
    turn = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    np.testing.assert_allclose((rotation @ x + translation).numpy(), turn @ t.numpy() + motion[3:].numpy(), atol=1e-12)
    np.testing.assert_allclose((rotation @ eye + translation).numpy(), 0, atol=1e-12)
