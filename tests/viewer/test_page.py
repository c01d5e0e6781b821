"""Pages as files: they are models again, keep a limit of bytes, and what is damaged is refused in a sentence."""

import math
import re

import numpy as np
import pytest

from nerfvol.cli.main import main
from nerfvol.export import export_model
from nerfvol.export.page import first_camera
from nerfvol.export.page_size import stored
from nerfvol.files.page import OPENING, read_model
from nerfvol.models import describe_file, load_model
from nerfvol.rotations import rotations
from nerfvol.splats.codec import quaternions, rotation_vectors
from nerfvol.splats.io import load_splats, save_splats
from nerfvol.views import OctreeModel, SplatModel
from tests.viewer.scenes import METADATA, ball, cloud_of_splats


def decibels(a, b) -> float:
    return -10 * math.log10(((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2).mean())


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    models = {"octree": ball(2), "splats": cloud_of_splats(3)}
    for name, model in models.items():
        export_model(model, folder / f"{name}.html")
    return folder, models


@pytest.mark.parametrize("name", ["octree", "splats"])
def test_a_page_is_a_model(pages, name, capsys):
    folder, models = pages
    path, model = folder / f"{name}.html", models[name]
    again = load_model(path)
    assert again.kind == name and describe_file(path)["format"] == f"nerfvol {name}"
    assert again.metadata["orbit"] == METADATA["orbit"]
    assert stored(again) == read_model(path)  # and is written as it was read
    camera = first_camera(METADATA["orbit"], 90, 60)
    assert decibels(again.render(camera)["rgb"], model.render(camera)["rgb"]) > (45 if name == "octree" else 38)
    assert main(["info", str(path)]) == 0 and "compact" in capsys.readouterr().out


def test_commands_take_a_page(pages, tmp_path):
    folder, _ = pages
    assert (
        main(["render", str(folder / "octree.html"), "--orbit", "1", "--size", "16x16", "--out", str(tmp_path / "o")])
        == 0
    )
    assert main(["export", str(folder / "splats.html"), "--out", str(tmp_path / "s.ply")]) == 0
    assert main(["export", str(folder / "octree.html"), "--out", str(tmp_path / "again.html")]) == 0
    assert read_model(tmp_path / "again.html") == read_model(folder / "octree.html")


@pytest.mark.parametrize("name", ["octree", "splats"])
def test_the_poster_is_small_and_nothing_in_the_page_is_foreign(pages, name):
    text = (pages[0] / f"{name}.html").read_text()
    poster = re.search(r'id="poster" alt="" src="data:image/webp;base64,([^"]+)"', text)
    assert 1000 < len(poster[1]) * 3 / 4 <= 60_000
    assert not re.search(r"(?:https?:)?//[a-z0-9-]+\.[a-z]", text[: text.rindex(OPENING)].replace(poster[1], ""))
    assert "default-src 'none'" in text and "unsafe-inline" not in text


def test_a_name_is_no_markup(tmp_path):
    path = tmp_path / "a<img src=x>&.html"
    export_model(ball(0, 3), path)
    text = path.read_text()
    assert "<img src=x>" not in text and "a&lt;img src=x&gt;&amp;" in text


@pytest.mark.parametrize("kind, share", [("octree", 0.5), ("octree", 0.12), ("splats", 0.7), ("splats", 0.3)])
def test_a_limit_is_kept_and_used(tmp_path, kind, share):
    model = ball(1, 6) if kind == "octree" else cloud_of_splats(2, 20000)
    full = len(stored(model)) * 4 // 3
    export_model(model, tmp_path / "full.html")
    overhead = (tmp_path / "full.html").stat().st_size - full
    limit = int(overhead + share * full)
    size = export_model(model, tmp_path / "small.html", max_bytes=limit).size
    assert size == (tmp_path / "small.html").stat().st_size
    assert limit - 0.1 * share * full <= size <= limit
    small = load_model(tmp_path / "small.html")
    camera = first_camera(METADATA["orbit"], 90, 60)
    wanted = model.render(camera)["rgb"]
    assert decibels(small.render(camera)["rgb"], wanted) > 18


def test_what_differs_least_is_closed_first(tmp_path):
    """A half of constant field and one of noise: the limit takes leaves from the constant one."""
    octree = ball(0, 5).octree
    places = octree.vertex_positions()
    calm = places[:, 0] < 0
    octree.density = np.where(calm, 0.0, np.random.default_rng(0).normal(0, 2, len(places)))
    sh = np.zeros_like(octree.sh)
    sh[~calm] = np.random.default_rng(1).normal(0, 1, sh[~calm].shape)
    octree.sh = sh
    model = OctreeModel(octree, METADATA)
    limit = len(stored(model)) * 4 // 3 * 0.85
    export_model(model, tmp_path / "full.html")
    overhead = (tmp_path / "full.html").stat().st_size - len(stored(model)) * 4 // 3
    export_model(model, tmp_path / "small.html", max_bytes=int(overhead + limit))
    left = load_model(tmp_path / "small.html").octree
    fine = left.leaf_level == octree.max_level
    side = left.leaf_centers()[:, 0] < 0
    assert fine[~side].mean() > fine[side].mean() + 0.15


def test_a_limit_that_is_too_small_and_other_wrong_options(tmp_path, capsys):
    export_model(ball(0, 3), tmp_path / "m.html")
    model = str(tmp_path / "m.html")
    out = str(tmp_path / "x.html")
    for options, sentence in (
        (["--max-bytes", "50kB"], "--max-bytes is 50000, the page takes"),
        (["--max-bytes", "much"], "expected bytes such as"),
        (["--crop", "5,5,5,6,6,6"], "nothing of the model lies in this box"),
        (["--level", "0"], "level"),
    ):
        assert main(["export", model, "--out", out, *options]) == 2
        said = capsys.readouterr().err
        assert sentence in said and "Traceback" not in said
    assert not (tmp_path / "x.html").exists()


def test_levels_and_boxes(tmp_path):
    model = ball(1, 5)
    export_model(model, tmp_path / "l.html", level=4)
    assert load_model(tmp_path / "l.html").octree.max_level == 4
    for kind in (model, cloud_of_splats()):
        export_model(kind, tmp_path / "c.html", crop=(-2, -2, -2, 0, 2, 2))
        part = load_model(tmp_path / "c.html")
        places = part.octree.leaf_centers() if part.kind == "octree" else part.splats.means + part.splats.origin
        assert len(places) > 100 and places[:, 0].max() <= 1e-3


@pytest.mark.parametrize("name", ["octree", "splats"])
def test_damaged_pages_are_refused_in_a_sentence(pages, tmp_path, capsys, name):
    text = (pages[0] / f"{name}.html").read_text()
    start = text.rindex(OPENING) + len(OPENING)
    damages = {
        "no model": (text[: start - len(OPENING)], "holds no model"),
        "cut off": (text[: start + 100], "is not whole"),
        "not base64": (text[: start + 8] + "?" + text[start + 8 :], "no base64"),
        "shorter": (text[: start + 400] + text[text.index("</script>", start) :], "the model in"),
    }
    for damaged, sentence in damages.values():
        path = tmp_path / "bad.html"
        path.write_text(damaged)
        assert main(["info", str(path)]) == 2
        said = capsys.readouterr().err
        assert sentence in said and str(path) in said and "/model.safetensors" not in said and said.count("\n") == 1


# ------------------------------------------------------------------ compact splats
def test_compact_splats_are_as_near_as_their_steps(tmp_path):
    splats = cloud_of_splats(2, 300).splats
    splats.quats[:40, 0] *= 1e-3  # turned by nearly half a turn
    size = save_splats(tmp_path / "s", splats, {}, compact=True)
    assert size < 0.5 * save_splats(tmp_path / "e", splats, {})
    back, _ = load_splats(tmp_path / "s")
    distance = np.abs(back.means[:, None] - splats.means[None]).max(2)
    match = distance.argmin(1)
    assert sorted(match) == list(range(splats.n))
    extent = 1.0  # of the middle 80 %; asinh is steeper than the step outside by at most sqrt(1 + x^2)
    assert distance.min(1).max() <= 0.5 * 2.0**-16 * extent * 2
    assert np.abs(back.log_scales - splats.log_scales[match]).max() <= 0.5 / 24 + 1e-6
    assert np.abs(back.logits - np.clip(splats.logits[match], -12, 12)).max() <= 0.5 / 16 + 1e-6
    turn = np.einsum("nij,nkj->nik", rotations(back.quats), rotations(splats.quats[match]))
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    # The rotation vector's error bounds the angle: half a step along three axes, or a whole one where the nearest vector is
    # longer than half a turn and is rounded towards none. 1e-4: float32 in the trace (7e-7) over 2 sin(angle).
    step = 1 / 96
    nearest = np.rint(rotation_vectors(splats.quats[match]) / step) * step
    beyond = np.linalg.norm(nearest, axis=1) > np.pi
    assert 4 < beyond.sum() < 40
    assert angle[~beyond].max() <= 3**0.5 * 0.5 * step + 1e-4
    assert angle[beyond].max() <= 3**0.5 * step + 1e-4
    # a rotation of the channels keeps lengths: three half steps at right angles
    assert np.abs(back.sh - splats.sh[match])[:, :, 0].max() <= 3**0.5 * 0.5 / 128 / 0.2820947 + 1e-5


def test_rotation_vectors_come_back():
    q = np.random.default_rng(0).normal(size=(500, 4)).astype(np.float32)
    q[0], q[1], q[2] = (1, 0, 0, 0), (0, 1, 0, 0), (-1, 1e-9, 0, 0)
    vectors = rotation_vectors(q)
    assert np.linalg.norm(vectors, axis=1).max() <= np.pi + 1e-9
    assert np.abs(rotations(quaternions(vectors)) - rotations(q)).max() < 1e-5


def test_splats_far_out_and_none_at_all(tmp_path):
    splats = cloud_of_splats(0, 50).splats
    splats.means[0] = (1e6, -1e6, 3)
    save_splats(tmp_path / "far", splats, {}, compact=True)
    means = load_splats(tmp_path / "far")[0].means
    far = means[np.abs(means).max(1).argmax()]
    assert np.allclose(far[:2], (1e6, -1e6), rtol=1e-3)
    save_splats(tmp_path / "none", splats.select([]), {}, compact=True)
    assert load_splats(tmp_path / "none")[0].n == 0


def test_a_notebook_shows_the_page_or_a_picture(monkeypatch):
    text = ball(0, 3)._repr_html_()
    assert text.startswith('<iframe srcdoc="') and "&lt;script" in text and "<script" not in text
    assert isinstance(cloud_of_splats(0, 20), SplatModel) and "iframe" in cloud_of_splats(0, 20)._repr_html_()
    monkeypatch.setattr("nerfvol.viewer.notebook.MOST_BYTES", 100)
    text = ball(0, 3)._repr_html_()
    assert "iframe" not in text and "data:image/webp" in text and "too large" in text
