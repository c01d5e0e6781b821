"""Exposures from what photographs share: known gains to a percent, even sets even, slow changes no reason for maps."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Intrinsics
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.load import load_dataset
from nerfvol.starts import exposures
from nerfvol.starts.exposures import brightness_spread, measure_exposures, solve
from nerfvol.training.appearance import SPREAD, Appearance
from tests.fixtures.rooms import draw, facing_cameras, trace_planes, write_photographs

N = 12
GAINS = np.random.default_rng(5).uniform(0.7, 1.3, N)


@pytest.fixture(scope="module")
def planes():
    """Twelve cameras before textured planes, and what they see."""
    cameras = facing_cameras(N, Intrinsics(80, 56, 78.0, 78.0, 40.0, 28.0))
    return cameras, [np.round(0.7 * draw(c, trace_planes, 2)).astype(np.uint8) for c in cameras]


def photographs(planes, folder, gains) -> Dataset:
    cameras, pictures = planes
    taken = [np.clip(np.round(p * g), 0, 255).astype(np.uint8) for p, g in zip(pictures, gains, strict=True)]
    return load_dataset(write_photographs(folder / "scene", cameras, taken), "train", holdout="own")


def test_gains_are_found_to_a_percent_before_the_start(planes, tmp_path):
    data = photographs(planes, tmp_path, GAINS)
    chosen = [int(name.split("_")[-1][:3]) if "_" in name else int(name[:3]) for name in data.names]
    found = measure_exposures(data)
    assert found is not None and found.spread > SPREAD and found.error < 0.02
    truth = GAINS[chosen] / GAINS[chosen].mean()
    np.testing.assert_allclose(found.gains.mean(1), truth, rtol=0.02)
    appearance = Appearance(len(data))
    appearance.begin(found)
    assert appearance.active and np.allclose(appearance.exposures(), truth, rtol=0.02)


def test_even_photographs_need_no_maps_nor_to_be_held(planes, tmp_path, monkeypatch):
    data = photographs(planes, tmp_path, np.ones(N))
    monkeypatch.setattr(exposures, "EVEN", 0.0)  # measured, not judged by brightness
    found = measure_exposures(data)
    assert found is not None and found.spread < 0.02
    appearance = Appearance(len(data))
    appearance.begin(found)
    assert not appearance.active and not appearance.may_change
    monkeypatch.undo()
    assert brightness_spread(data) < exposures.EVEN and measure_exposures(data).spread == 0


def test_what_changes_slowly_along_a_walk_is_no_reason_for_maps():
    pairs = np.array([(i, i + 1) for i in range(40)])
    ratios = np.full((40, 3), 0.02)  # 2 % a step, by 2.2 in all
    found = solve(41, pairs, ratios)
    assert found.spread == pytest.approx(0.02 / np.sqrt(2), rel=0.1) and np.ptp(found.gains) > 0.5


def test_a_pair_that_met_a_shadow_does_not_count_as_error():
    rng = np.random.default_rng(0)
    logs = rng.normal(0, 0.2, 10)
    pairs = np.array([(i, j) for i in range(10) for j in range(i)])
    ratios = np.repeat((logs[pairs[:, 1]] - logs[pairs[:, 0]])[:, None], 3, 1)
    ratios[7] += 1.0
    found = solve(10, pairs, ratios)
    assert found.error < 0.06 and np.abs(np.log(found.gains.mean(1)) - (logs - logs.mean())).max() < 0.2


def test_photographs_that_share_nothing_cannot_be_compared(planes, tmp_path):
    cameras, pictures = planes
    noise = [
        np.random.default_rng(i).integers(0, 255, p.shape, np.uint8) // (1 + i % 3) for i, p in enumerate(pictures)
    ]
    data = load_dataset(write_photographs(tmp_path / "scene", cameras, noise))
    assert measure_exposures(data) is None
    appearance = Appearance(len(data))
    appearance.begin(None)
    assert not appearance.decided and appearance.may_change
