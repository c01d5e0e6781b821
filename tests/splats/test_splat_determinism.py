"""The same bits for any number of threads, for a resumed run and for a repeated one; order by depth, ties by index."""

import functools

import numpy as np
import pytest
import torch

from nerfvol.kernels import ops, splat_ops, splat_reference
from nerfvol.kernels.splat_reference import Parameters
from tests.splats.scenes import BACKGROUND, random_image, random_splats, straight_view, view_of_cube
from tests.splats.test_step import assert_same_bits, copy_of

OPTIONS = splat_ops.SplatOptions(BACKGROUND, 1.0, 0.0, 0.3)
RATES = splat_ops.SplatRates()


def trained(steps: int = 3, resume_at: int | None = None):
    """Enough splats for several chunks and ranges."""
    state, reports = splat_ops.SplatState(random_splats(6000, 4, 1, size=0.05)), []
    view = view_of_cube(200, 150)
    for k in range(steps):
        if k == resume_at:
            state = copy_of(state)
        reports.append(splat_ops.train_step(state, view, random_image(view, k, 0.05), OPTIONS, RATES))
    picture = splat_ops.render_splats(state.packed, view, outputs=splat_ops.OUTPUTS)
    return state, reports, picture


def test_the_same_bits_for_any_number_of_threads(isa, threads):
    runs = []
    for n in (1, 2, 3):
        threads(n)
        assert ops.get_threads() == n
        runs.append(trained())
    runs.append(trained(resume_at=2))
    for other in runs[1:]:
        assert_same_bits(runs[0][0], other[0])
        assert runs[0][1] == other[1]
        for name, image in runs[0][2].items():
            assert np.array_equal(image, other[2][name]), name


def test_the_floating_point_mode_is_left_as_it_was(compiled):
    trained(1)
    assert np.float32(1e-38) * np.float32(0.1) > 0


def flat_stack(depths, colours):
    """Wide, half transparent splats that face the camera at the given depths."""
    n = len(depths)
    splats = random_splats(n, 1, 0, "plain")
    splats.means[:] = np.stack([np.zeros(n), np.zeros(n), depths], 1)
    splats.log_scales[:], splats.logits[:] = np.log(3.0), 0.0
    splats.sh[:, :, 0] = (np.asarray(colours) - 0.5) / 0.28209479
    return splats


def test_nearer_splats_are_in_front_and_ties_go_by_index(isa):
    view, colours = straight_view(16, 16), np.eye(3)
    middle = (8, 8)
    nearest_first = splat_ops.render_splats(flat_stack([1, 2, 3], colours), view, (0, 0, 0))["rgb"][middle]
    assert np.allclose(nearest_first, [0.5, 0.25, 0.125], atol=2e-3)
    swapped = splat_ops.render_splats(flat_stack([2, 1, 3], colours), view, (0, 0, 0))["rgb"][middle]
    assert np.allclose(swapped, [0.25, 0.5, 0.125], atol=2e-3)
    ties = splat_ops.render_splats(flat_stack([2, 2, 2], colours), view, (0, 0, 0))["rgb"][middle]
    assert np.allclose(ties, [0.5, 0.25, 0.125], atol=2e-3)


def test_depths_from_near_to_sixteen_octaves_are_told_apart(isa):
    view = straight_view(16, 16, near=0.01)
    depths = 0.0101 * 2.0 ** np.arange(16)
    for a, b in zip(depths[:-1], depths[1:], strict=True):
        rgb = splat_ops.render_splats(flat_stack([b, a], np.eye(3)[:2]), view, (0, 0, 0))["rgb"][8, 8]
        assert rgb[1] > rgb[0]
    just = splat_ops.render_splats(flat_stack([1.00001, 1.0], np.eye(3)[:2]), view, (0, 0, 0))["rgb"][8, 8]
    assert just[1] > just[0]


@functools.cache
def crowd():
    """10^5 splats, a view, and the twin's picture."""
    splats, view = random_splats(100_000, 1, 3, size=0.01), straight_view(32, 16)
    splats.means[:, 2] += 3
    splats.logits -= 2
    with torch.no_grad():
        return splats, view, splat_reference.render(Parameters.of(splats), view, BACKGROUND)["rgb"].numpy()


def test_a_hundred_thousand_splats(isa):
    """In the twin's order; some float32 depths round to the other side of a key, which few pixels show."""
    splats, view, theirs = crowd()
    ours = splat_ops.render_splats(splats, view, BACKGROUND, 0.0)["rgb"]
    assert np.quantile(np.abs(ours - theirs), 0.9) < 2e-5
    assert np.abs(ours - theirs).max() < 0.01


@pytest.mark.parametrize("name", ops.available_isas()[1:])
def test_the_builds_agree_within_rounding(compiled, name):
    splats, view = random_splats(500, 9, 4), view_of_cube(120, 90)
    pictures = []
    for build in ("auto", name):
        ops.set_isa(build)
        pictures.append(splat_ops.render_splats(splats, view, BACKGROUND, 0.0)["rgb"])
    ops.set_isa("auto")
    assert (
        np.abs(pictures[0] - pictures[1]).max() < 2e-5 or np.quantile(np.abs(pictures[0] - pictures[1]), 0.999) < 2e-5
    )
