"""The table of photographs: each is drawn once, for its row and its thumbnail."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from nerfvol.datasets.load import load_dataset
from nerfvol.training.appearance import Appearance
from nerfvol.training.photograph_table import write_table


def test_each_view_is_drawn_once(tmp_path, tiny_scene):
    """Pictures of an octree of a million leaves take seconds; the row has the error of what was drawn, unrounded."""
    dataset, drawn = load_dataset(tiny_scene), []

    def seen(i):
        drawn.append(i)
        photograph = np.full((4, 6, 3), 0.5, np.float32)
        return photograph, photograph + np.float32(10.0 ** -(3 + i / 10)), np.ones((4, 6))

    phase = SimpleNamespace(appearance=Appearance(len(dataset), "off"), refined=lambda: None, seen=seen)
    path = tmp_path / "photographs.csv"
    write_table(path, dataset, phase)
    assert sorted(drawn) == list(range(len(dataset)))
    rows = list(csv.DictReader(path.read_text().splitlines()))
    expected = {dataset.names[i]: 20 * (3 + i / 10) for i in range(len(dataset))}
    for row in rows:
        assert float(row["psnr_small_db"]) == pytest.approx(expected[row["photograph"]], abs=0.01)
    assert path.with_suffix(".html").read_text().count("data:image") == 3 * len(dataset)  # with their difference
