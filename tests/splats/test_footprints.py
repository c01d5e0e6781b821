"""One splat in the picture: how much light it gets, what the low-pass filter is, and which blocks its lists hold."""

import functools

import numpy as np
import pytest
import torch

from nerfvol.kernels import splat_ops, splat_reference
from nerfvol.kernels.splat_reference import Parameters
from tests.splats.scenes import random_image, random_splats, straight_view

FOCAL = 1000.0


def one_splat(deviations, opacity: float, mode: str, angle: float = 0.4, at=(0.0, 0.0)):
    """Faces straight_view from distance 1; deviations in pixels along its axes, ``at``: pixels from the middle."""
    splats = random_splats(1, 1, 0, mode)
    splats.means[:] = (at[0] / FOCAL, at[1] / FOCAL, 1.0)
    splats.log_scales[:] = np.log([deviations[0] / FOCAL, deviations[1] / FOCAL, 1e-6])
    splats.quats[:] = (np.cos(angle / 2), 0, 0, np.sin(angle / 2))
    splats.logits[:] = np.log(opacity / (1 - opacity))
    return splats


@pytest.mark.parametrize("mode", ["mip", "plain"])
@pytest.mark.parametrize("deviations", [(0.2, 0.3), (0.5, 1.5), (3.0, 1.0), (8.0, 4.0)])
def test_the_light_of_a_splat(isa, deviations, mode):
    """Sum of alpha = 2 pi o' sqrt(det S) (1 - 1/(255 o')), averaged over places in the pixel."""
    view, opacity, sums = straight_view(96, 96, FOCAL), 0.6, []
    for at in np.random.default_rng(0).uniform(-0.5, 0.5, (24, 2)):
        splats = one_splat(deviations, opacity, mode, at=at)
        sums.append(splat_ops.render_splats(splats, view, outputs=("opacity",))["opacity"].sum())
    det = (deviations[0] ** 2 + 0.3) * (deviations[1] ** 2 + 0.3)
    own = deviations[0] * deviations[1]
    drawn = opacity * own / np.sqrt(det) if mode == "mip" else opacity
    expected = 2 * np.pi * drawn * np.sqrt(det) * (1 - 1 / (255 * drawn))
    assert np.mean(sums) == pytest.approx(expected, rel=0.02)
    if mode == "mip" and own > 1:  # whatever the filter is
        assert np.mean(sums) == pytest.approx(2 * np.pi * opacity * own, rel=0.05)


def test_the_filter_is_a_convolution(isa):
    """The footprint with the low-pass filter, against sub-samples of the footprint alone under a Gaussian of variance 0.3."""
    view, opacity, deviations, angle = straight_view(32, 32, FOCAL), 0.6, (1.5, 0.8), 0.4
    drawn = splat_ops.render_splats(one_splat(deviations, opacity, "mip", angle), view, outputs=("opacity",))["opacity"]
    steps = (np.arange(64) + 0.5) / 64 * 8 - 4
    kernel = np.exp(-(steps[:, None] ** 2 + steps[None] ** 2) / 0.6)
    kernel /= kernel.sum()
    c, s = np.cos(angle), np.sin(angle)
    for row, column in ((16, 16), (15, 14), (17, 18), (14, 17)):
        x = (column + 0.5 - 16 + steps)[None, :]
        y = (row + 0.5 - 16 + steps)[:, None]
        along, across = (c * x + s * y) / deviations[0], (c * y - s * x) / deviations[1]
        averaged = (opacity * np.exp(-(along**2 + across**2) / 2) * kernel).sum()
        assert drawn[row, column] == pytest.approx(averaged, abs=1e-3)


def ellipses(n: int, seed: int):
    """Random ellipses, from specks to needles across the picture, some beside it; so faint that no pixel ends."""
    splats = random_splats(n, 1, seed, "plain")
    rng = np.random.default_rng(seed)
    splats.means[:] = rng.uniform(-0.09, 0.09, (n, 3))
    splats.means[:, 2] = 1.0
    splats.log_scales[:] = np.log(np.exp(rng.uniform(np.log(0.05), np.log(25), (n, 3))) / FOCAL)
    splats.logits[:] = rng.uniform(-5.4, -3, n)
    return splats


def brute_force(splats, view):
    """Opacity of each pixel, pixels where rounding decides on some alpha, number of blocks with an alpha >= 1/255."""
    f = splat_reference.project(Parameters.of(splats), view, splats.mode)
    y, x = torch.meshgrid(torch.arange(view.height) + 0.5, torch.arange(view.width) + 0.5, indexing="ij")
    pixels = torch.stack([x.ravel(), y.ravel()], -1).double()
    passed, unsure, blocks = torch.ones(len(pixels)).double(), torch.zeros(len(pixels), dtype=torch.bool), 0
    for i in f.order.split(200):
        d = pixels[None] - f.centre[i][:, None]
        conic = torch.linalg.inv(f.covariance[i])
        q = (
            conic[:, :1, 0] * d[..., 0] ** 2
            + 2 * conic[:, :1, 1] * d[..., 0] * d[..., 1]
            + conic[:, 1:, 1] * d[..., 1] ** 2
        )
        alpha = f.opacity[i][:, None] * torch.exp(-q / 2)
        unsure |= ((alpha * 255 - 1).abs() < 1e-4).any(0)
        alpha[alpha < 1 / 255] = 0
        passed *= (1 - alpha).prod(0)
        inside = (alpha > 0).reshape(len(i), view.height // 4, 4, view.width // 4, 4)
        blocks += int(inside.any(4).any(2).sum())
    return 1 - passed.reshape(view.height, view.width).numpy(), unsure.reshape(view.height, view.width).numpy(), blocks


@functools.cache
def many_ellipses():
    """1,500 ellipses, a view whose rows and columns fill no tile, and the truth by brute force."""
    splats, view = ellipses(1500, 1), straight_view(152, 104, FOCAL)
    with torch.no_grad():
        return splats, view, *brute_force(splats, view)


def test_lists_hold_what_they_must_and_little_else(isa):
    """A missing block would lack opacity; a block too many is counted."""
    splats, view, opacity, unsure, blocks = many_ellipses()
    ours = splat_ops.render_splats(splats, view, early_stop_eps=0.0, outputs=("opacity",))["opacity"]
    assert np.abs(ours - opacity)[~unsure].max() < 2e-5 and unsure.mean() < 0.2
    options = splat_ops.SplatOptions(early_stop_eps=0.0)
    report = splat_ops.train_step(
        splat_ops.SplatState(splats), view, random_image(view, 0), options, splat_ops.SplatRates()
    )
    assert blocks <= report.blocks + 20
    assert report.blocks < 1.01 * blocks
