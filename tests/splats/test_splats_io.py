"""Splat files of our own and .spz: exact or within stated bounds, and nothing in one does more than be refused."""

import gzip
import json
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

from nerfvol.errors import InputError
from nerfvol.splats.io import describe_splats, load_splats, save_splats
from nerfvol.splats.splats import Splats

SETTINGS = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
ARRAYS = ("means", "log_scales", "quats", "logits", "sh")


def make_splats(n=17, degree=1, mode="mip", seed=0):
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(size=(n, 3)).astype(np.float32), log_scales=rng.normal(-3, 1, (n, 3)).astype(np.float32),
        quats=rng.normal(size=(n, 4)).astype(np.float32), logits=rng.normal(size=n).astype(np.float32),
        sh=rng.normal(0, 0.3, (n, 3, (degree + 1) ** 2)).astype(np.float32), origin=np.array([1e5, -2.5, 0.125]), mode=mode,
    )  # fmt: skip


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("mode", ["mip", "plain"])
def test_own_file_is_exact(tmp_path, degree, mode):
    splats = make_splats(degree=degree, mode=mode)
    metadata = {"provenance": {"data": "é", "seed": 3}, "background": [1, 1, 1]}
    size = save_splats(tmp_path / "s.safetensors", splats, metadata)
    found, read = load_splats(tmp_path / "s.safetensors")
    assert read == metadata and size == (tmp_path / "s.safetensors").stat().st_size
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(splats, name))
    np.testing.assert_array_equal(found.origin, splats.origin)
    assert found.mode == mode and found.sh_degree == degree
    document = describe_splats(tmp_path / "s.safetensors")
    assert document["n"] == 17 and document["colour"] == "half_plus_sh_clamped"


def edited(path, document=None, **arrays):
    """The file with parts of its document and arrays replaced (None: removed)."""
    from safetensors import safe_open

    with safe_open(path, "numpy") as file:
        old = json.loads(file.metadata()["nerfvol"])
    tensors = {name: a for name, a in (load_file(path) | arrays).items() if a is not None}
    save_file(tensors, path, {"nerfvol": json.dumps(old | (document or {}))})


@pytest.mark.parametrize("document,arrays,words", [
    ({"format": "nerfvol octree"}, {}, "expected the format 'nerfvol splats'"), ({"version": 2}, {}, "reads version 1"),
    ({"mode": "soft"}, {}, "mode is 'soft'"), ({"colour": "half_plus_sh"}, {}, "colour"),
    ({"footprint_variance": 0.1}, {}, "footprint_variance"), ({"sh_degree": 4}, {}, "sh_degree"),
    ({"sh_degree": True}, {}, "sh_degree"), ({"n": -1}, {}, "n is -1"), ({"n": 10**9}, {}, "'means' should be float32"),
    ({"origin": [0, 0]}, {}, "origin"), ({"origin": [0, 0, 1e300]}, {}, "origin"), ({"metadata": 3}, {}, "metadata"),
    ({}, {"quats": None}, "'quats' is missing"), ({}, {"sh": np.zeros((17, 3, 9), np.float32)}, "'sh' should be"),
    ({}, {"logits": np.full(17, np.nan, np.float32)}, "'logits' are not finite"),
    ({}, {"means": np.zeros((17, 3), np.float64)}, "'means' should be float32"),
])  # fmt: skip
def test_files_that_cannot_be_used(tmp_path, document, arrays, words):
    path = tmp_path / "s.safetensors"
    save_splats(path, make_splats(), {})
    edited(path, document, **arrays)
    with pytest.raises(InputError, match=words) as caught:
        load_splats(path)
    assert "s.safetensors" in str(caught.value) and "\n" not in str(caught.value)


def test_values_that_are_not_finite_are_not_written(tmp_path):
    splats = make_splats()
    splats.means[3, 1] = np.nan
    with pytest.raises(InputError):
        save_splats(tmp_path / "s.safetensors", splats, {})
    assert not list(tmp_path.iterdir())


@SETTINGS
@given(data=st.data())
def test_any_damage_is_refused_in_a_sentence_or_read(tmp_path, data):
    path = tmp_path / "s.safetensors"
    save_splats(path, make_splats(n=3), {})
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            content[at] = data.draw(st.integers(0, 255))
        else:
            content = content[: at + 1]
    path.write_bytes(bytes(content))
    try:
        load_splats(path)[0].validate()
    except InputError as error:
        assert "\n" not in str(error)


# ------------------------------------------------------------------ spz
def test_spz_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    from nerfvol.splats import spz

    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(InputError, match="pip install gsply"):
        spz.save_spz(tmp_path / "a.spz", make_splats())
    with pytest.raises(InputError, match="pip install gsply"):
        spz.load_spz(tmp_path / "a.spz")


@pytest.mark.parametrize("mode", ["mip", "plain"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_keeps_what_its_bits_hold(tmp_path, mode, degree):
    pytest.importorskip("gsply")
    from nerfvol.splats.spz import load_spz, save_spz

    splats = make_splats(degree=degree, mode=mode)
    splats.origin = np.array([3.0, -2.0, 1.0])
    size = save_spz(tmp_path / "a.spz", splats)
    found = load_spz(tmp_path / "a.spz")
    assert size == (tmp_path / "a.spz").stat().st_size and found.mode == mode and found.sh_degree == degree
    np.testing.assert_allclose(found.means, splats.means + splats.origin, atol=2**-19)
    np.testing.assert_allclose(found.log_scales, splats.log_scales, atol=1 / 32 + 1e-6)
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (found.quats, splats.quats))
    assert np.abs((a * b).sum(1)).min() > 1 - 1e-5
    np.testing.assert_allclose(found.sh[:, :, 0], splats.sh[:, :, 0], atol=0.02)
    if degree:
        np.testing.assert_allclose(found.sh[:, :, 1:], np.clip(splats.sh[:, :, 1:], -1, 1), atol=0.07)
    header = gzip.decompress((tmp_path / "a.spz").read_bytes())[:16]
    assert header[:4] == b"NGSP" and header[4] == 3 and header[14] == (mode == "mip")


def test_damaged_spz_is_refused(tmp_path):
    pytest.importorskip("gsply")
    from nerfvol.splats.spz import load_spz, save_spz

    save_spz(tmp_path / "a.spz", make_splats())
    good = gzip.decompress((tmp_path / "a.spz").read_bytes())
    huge = good[:8] + (4_000_000_000).to_bytes(4, "little") + good[12:]
    for content in (b"", b"hello", gzip.compress(good[:40]), gzip.compress(huge), gzip.compress(b"XXXX" + good[4:])):
        (tmp_path / "b.spz").write_bytes(content)
        with pytest.raises(InputError, match="b.spz is not a usable .spz file"):
            load_spz(tmp_path / "b.spz")
    with pytest.raises(InputError, match="no such"):
        load_spz(tmp_path / "c.spz")
