"""A format is a row: which reader takes a folder, what help and errors say of it, and what all formats have in common."""

import subprocess
import sys

import numpy as np
import pytest

from nerfvol.datasets import formats
from nerfvol.datasets.formats import FORMATS, Format, find_format, formats_help
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from tests.fixtures import scenes

WRITERS = {
    "transforms": scenes.write_instant_ngp,
    "llff": scenes.write_llff,
    "colmap": scenes.write_colmap,
    "nsvf": scenes.write_nsvf,
}
BOX = [-0.5, -1, -1.5, 0.5, 1, 2]


@pytest.fixture(params=WRITERS)
def scene(request, tmp_path):
    return request.param, WRITERS[request.param](tmp_path, scenes.ring(), scenes.random_images())


def test_every_row_is_tested_here():
    assert {row.module for row in FORMATS} == WRITERS.keys()


def test_one_reader_recognises_a_folder(scene):
    module, folder = scene
    assert [row.module for row in FORMATS if row.reader.recognises(folder)] == [module]
    assert find_format(folder).module == module


def test_help_and_errors_are_made_from_the_rows(tmp_path, monkeypatch):
    with pytest.raises(InputError) as caught:
        load_dataset(tmp_path)
    for row in FORMATS:
        assert f"{row.looks_for} ({row.name})" in formats_help() and f"no {row.looks_for}" in str(caught.value)
    monkeypatch.setattr(formats, "FORMATS", (Format("A", "a.txt", "llff"), Format("B", "b.txt", "llff")))
    assert formats_help() == "posed images: a folder with a.txt (A), or b.txt (B)"
    with pytest.raises(InputError, match="expected posed images, but found no a.txt and no b.txt$"):
        load_dataset(tmp_path)


def test_help_needs_no_numpy():
    code = "import sys, nerfvol.datasets.formats as f; f.formats_help(); sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_package_offers_what_it_names():
    import nerfvol.datasets

    for name in nerfvol.datasets.__all__:
        assert getattr(nerfvol.datasets, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'load_data'"):
        nerfvol.datasets.load_data  # noqa: B018


def test_a_given_box_is_the_region_of_detail(scene):
    dataset = load_dataset(scene[1], aabb=BOX)
    np.testing.assert_array_equal(dataset.scene.aabb, np.reshape(BOX, (2, 3)))
    np.testing.assert_allclose(dataset.scene.background_cube, [[-28, -28, -27.75], [28, 28, 28.25]])  # 16 x the longest
    assert dataset.messages[-1] == "scene bounds: the aabb as given"


@pytest.mark.parametrize("box,sentence", [
    ([0, 0, 0, 1, 1], r"aabb must be two corners of three numbers, got shape \(5,\)"),
    ([0, 0, 0, 1, 1, float("nan")], "aabb must be finite with its first corner below the second"),
    ([0, 0, 0, 1, -1, 1], "aabb must be finite with its first corner below the second"),
    ([[0, 0, 0], [1, 1]], "aabb must be two corners of three numbers, got"),
    ("a b c d e f", "aabb must be two corners of three numbers, got"),
])  # fmt: skip
def test_boxes_that_are_none_are_refused(scene, box, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        load_dataset(scene[1], aabb=box)
    assert "\n" not in str(caught.value)
