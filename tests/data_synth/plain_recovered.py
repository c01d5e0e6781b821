"""tools/recovered.py, which says what learning recovered of a medium among solids: exact where both are known, and off by what
was planted. In plain Python, as the tool itself (test_plain.py runs this file)."""

import importlib.util
import math
import re
from pathlib import Path

import numpy as np
import pytest

from nerfvol.octree.rows import explin_inverse
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel

TOOL = Path(__file__).resolve().parents[2] / "tools" / "recovered.py"
LO, HI = np.array([-1.5, -1.5, -0.7]), np.array([1.5, 1.5, 0.9])  # of the mist
CELL = 3.0 / 32


@pytest.fixture(scope="module")
def recovered():
    made = importlib.util.spec_from_file_location("recovered", TOOL)
    assert made is not None and made.loader is not None
    module = importlib.util.module_from_spec(made)
    made.loader.exec_module(module)
    return module


def mist(points):
    """Extinction of the scene, 1/u."""
    return np.exp(-(points[:, 2] + 0.7) / 0.5)


def octree_of(sigma) -> Octree:
    """The extinction sigma(points) in leaves of ``CELL`` over [-1.5, 1.5]^3."""
    cells = np.stack(np.meshgrid(*[np.arange(32)] * 3, indexing="ij"), -1).reshape(-1, 3)
    scale = 1e-4  # so that what lies between vertices is linear in all but the faintest extinctions
    octree = Octree.from_leaves(np.full(len(cells), 5), cells, (-1.5,) * 3, 3.0, 0, scale)
    octree.density = explin_inverse(np.maximum(sigma(octree.vertex_positions()), 1e-9) / scale)
    return octree


def report(recovered, capsys, monkeypatch, tmp_path, sigma, weight=None) -> dict[str, dict[str, float]]:
    """What the tool prints of an octree of that extinction: {line: {name: number}}."""
    monkeypatch.setattr(recovered, "POINTS", 400)
    monkeypatch.setattr(recovered, "CHORDS", 24)
    monkeypatch.setattr(recovered, "SPACING", 2 * CELL / 3)
    if weight is not None:
        monkeypatch.setattr(recovered, "seen", weight)
    OctreeModel(octree_of(sigma)).save(tmp_path / "octree.safetensors", "float32")
    assert recovered.main(["mist", str(tmp_path / "octree.safetensors")]) == 0
    lines = (line.split(":", 1) for line in capsys.readouterr().out.splitlines())
    words = r"(relative L1|correlation|found/true|median) ([\d.]+)"
    return {name.strip(): {k: float(v) for k, v in re.findall(words, rest)} for name, rest in lines}


def test_an_octree_of_the_truth_is_told_so(recovered, capsys, monkeypatch, tmp_path):
    """Off by interpolation, (h / H)^2 / 8 of the density; along a chord also by its ends, where the octree is cut to leaves of
    ``CELL`` / 2: half of one at either end of chords longer than 0.3. The core of a ball that is opaque counts nowhere."""

    def sigma(points):
        return np.where(np.linalg.norm(points - (-0.6, -0.25, -0.2), axis=1) < 0.4, 50.0, mist(points))

    found = report(recovered, capsys, monkeypatch, tmp_path, sigma)
    assert set(found) == {"density", "as seen", "opacity"}
    for name in ("density", "as seen"):
        assert found[name]["relative L1"] <= (CELL / 0.5) ** 2 / 8 + 5e-4 and found[name]["correlation"] > 0.999
    assert found["opacity"]["relative L1"] < CELL / 2 / 0.3 and found["opacity"]["correlation"] > 0.99
    assert found["opacity"]["found/true"] == pytest.approx(1.0, abs=0.03)


def test_axes_that_changed_places_are_seen(recovered, capsys, monkeypatch, tmp_path):
    found = report(recovered, capsys, monkeypatch, tmp_path, lambda p: mist(p[:, [2, 1, 0]]))
    assert found["density"]["relative L1"] > 0.5 and abs(found["density"]["correlation"]) < 0.3
    assert found["opacity"]["relative L1"] > 0.2


def test_what_no_camera_sees_counts_in_the_first_line_alone(recovered, capsys, monkeypatch, tmp_path):
    """Twice the density below z = 0, where nothing is seen."""

    def above(octree, points, eyes):
        assert len(eyes) == recovered.CAMERAS and np.linalg.norm(eyes, axis=1).min() > 2.5
        return (points[:, 2] > CELL).astype(float)

    found = report(recovered, capsys, monkeypatch, tmp_path, lambda p: np.where(p[:, 2] > 0, 1, 2) * mist(p), above)
    assert found["density"]["found/true"] > 1.5
    assert found["as seen"]["found/true"] == pytest.approx(1.0, abs=0.01) and found["as seen"]["relative L1"] < 0.01


def test_agreement_is_weighted(recovered):
    found, truth, weight = np.array([3.0, 1.0, 4.0]), np.array([1.0, 2.0, 4.0]), np.array([1.0, 0.5, 0.25])
    words = recovered.compare(found, truth, weight)
    assert words.startswith("relative L1 0.833")  # (1 * 2 + 0.5 * 1) / (1 + 1 + 1)
    assert f"correlation {np.corrcoef(found, truth)[0, 1]:.3f}" in words
    assert "found/true 1.500, median 1.000 (3)" in words  # (3 + 0.5 + 1) / 3
    assert "correlation none" in recovered.compare(found, np.ones(3))


def test_a_point_is_seen_as_far_as_light_comes_through(recovered):
    """A cube of extinction 2 and side 1, from far along either half of the x axis."""
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(512, 3), cells, (-0.5,) * 3, 1.0, 0, 1.0)
    octree.density = explin_inverse(np.array(2.0))
    points, eyes = np.array([[0.25, 0.1, 0.0], [-0.4, 0.0, 0.2]]), np.array([[900.0, 0.0, 0.0], [-900.0, 0.0, 0.0]])
    want = [(math.exp(-2 * (0.5 - x)) + math.exp(-2 * (0.5 + x))) / 2 for x in points[:, 0]]
    assert recovered.seen(octree, points, eyes) == pytest.approx(want, rel=1e-4)


def test_where_the_showcases_ring_and_solids_are(recovered):
    """Its ring lies flat around a column: nothing of it is outside of the box, all of which it reaches."""
    lo, hi, sigma, clear = recovered.known("showcase")
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (6000, 3))
    there = points[[sigma(*p) > 0 for p in points]]
    assert len(there) > 50 and (there > lo).all() and (there < hi).all()
    assert (np.ptp(there, axis=0) > 0.6 * (hi - lo)).all() and hi[2] - lo[2] < hi[0] - lo[0] == hi[1] - lo[1]
    assert not clear(0.0, 0.0, lo[2]) and clear(0.0, 0.0, 5.0)
    floor = next(h for h in np.linspace(0.0, -1.0, 400) if not clear(0.0, -1.2, h))
    assert floor == pytest.approx(-0.55 + recovered.MARGIN, abs=0.003)


def test_solids_keep_their_distance_in_every_direction(recovered):
    """The fog's red ball, and its box of y from 0.1 on."""
    _, _, sigma, clear = recovered.known("fog")
    assert sigma(1.0, -1.0, 0.0) == pytest.approx(0.38)
    ball, radius, m = np.array([-0.5, -0.3, -0.55]), 0.45, recovered.MARGIN
    for axis in np.eye(3):
        for sign in (1, -1):
            near, far = (ball + sign * (radius + share * m) * axis for share in (0.9, 1.1))
            assert not clear(*near) and clear(*far) == (far[2] > -1 + m)
    assert not clear(0.8, 0.1 - 0.9 * m, -0.5) and clear(0.8, 0.1 - 1.1 * m, -0.5) and clear(-0.5, 0.8, -0.5)
    with pytest.raises(SystemExit, match="one medium"):
        recovered.known("solids")
