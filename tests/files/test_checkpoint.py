"""Checkpoints come back exactly as saved, and no bytes whatever make loading do more than refuse."""

import json
import math
import os
import pickle

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nerfvol.errors import InputError
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint

SETTINGS = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def same(a, b):
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.generic):
        a = a.item()
    return type(a) is type(b) and (a == b or a != a and b != b)


def example_state():
    averages = {0: {"exp_avg": torch.arange(6.0).reshape(2, 3)}}
    optimizer_like = {"state": averages, "groups": [{"lr": 0.1, "params": [0]}]}
    return {
        "step": 7, "name": "é", "none": None, "flag": True, "numpy_flag": np.bool_(False), "n": np.int16(4),
        "big": 2**120, "loss": math.inf, "nan": math.nan,
        "optimizer": optimizer_like, "rng": torch.get_rng_state(), "pair": (1, 2.5),
        "scalar": torch.tensor(3, dtype=torch.int64), "empty": np.zeros((0, 4), np.float16),
        "strided": np.arange(12, dtype=np.int16).reshape(3, 4)[:, ::2], "mask": np.array([True, False]),
        "numpy": np.random.default_rng(3).bit_generator.state,
    }  # fmt: skip


def test_round_trip(tmp_path):
    state = example_state()
    size = save_checkpoint(tmp_path / "c.safetensors", state)
    assert size == os.path.getsize(tmp_path / "c.safetensors")
    assert same(state, load_checkpoint(tmp_path / "c.safetensors"))
    rng = np.random.default_rng()
    rng.bit_generator.state = load_checkpoint(tmp_path / "c.safetensors")["numpy"]
    assert rng.integers(1 << 30) == np.random.default_rng(3).integers(1 << 30)


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
keys = st.text() | st.integers()
trees = st.recursive(scalars, lambda t: st.lists(t, max_size=4) | st.dictionaries(keys, t, max_size=4), max_leaves=15)


@SETTINGS
@given(state=st.dictionaries(keys, trees, max_size=5))
def test_any_nesting_round_trips(tmp_path, state):
    save_checkpoint(tmp_path / "c.safetensors", state)
    assert same(state, load_checkpoint(tmp_path / "c.safetensors"))


def test_arrays_outlive_the_file_and_are_writable(tmp_path):
    save_checkpoint(tmp_path / "c.safetensors", {"a": np.ones(3), "t": torch.ones(3)})
    state = load_checkpoint(tmp_path / "c.safetensors")
    os.unlink(tmp_path / "c.safetensors")
    state["a"][0] = 2
    state["t"].add_(1)
    assert state["a"].tolist() == [2, 1, 1] and state["t"].tolist() == [2, 2, 2]


@pytest.mark.parametrize("bad", [{"x": object()}, {"x": {1.5: 0}}, {"x": [b"bytes"]}, {True: 0}])
def test_other_types_are_refused_before_anything_is_written(tmp_path, bad):
    with pytest.raises(TypeError, match="state"):
        save_checkpoint(tmp_path / "c.safetensors", bad)
    assert os.listdir(tmp_path) == []


def test_failed_save_keeps_the_previous_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, {"step": 1})

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="no space is left"):
        save_checkpoint(path, {"step": 2})
    assert load_checkpoint(path) == {"step": 1}
    assert os.listdir(tmp_path) == ["c.safetensors"]


def test_the_file_is_plain_safetensors(tmp_path):
    from safetensors.numpy import load_file

    save_checkpoint(tmp_path / "c.safetensors", {"a": np.arange(3), "b": np.ones(2, np.float32), "c": np.uint8([1])})
    assert {tuple(a) for a in load_file(tmp_path / "c.safetensors").values()} == {(0, 1, 2), (1, 1), (1,)}


def raw_file(path, header, body=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)


def document(tree, **extra):
    whole = {"format": "nerfvol checkpoint", "version": 1, "tree": tree, **extra}
    return {"__metadata__": {"nerfvol": json.dumps(whole)}}


def deep(n):
    tree = ["list", []]
    for _ in range(n):
        tree = ["list", [tree]]
    return ["dict", [["x", tree]]]


HOSTILE = {
    "huge shape": ({"a": {"dtype": "F32", "shape": [2**40, 2**20], "data_offsets": [0, 4]}}, b"\0" * 4),
    "overlong offsets": ({"a": {"dtype": "F32", "shape": [2**30], "data_offsets": [0, 2**32]}}, b"\0" * 4),
    "negative shape": ({"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, b"\0" * 4),
    "unknown dtype": ({"a": {"dtype": "PICKLE", "shape": [1], "data_offsets": [0, 4]}}, b"\0" * 4),
    "no document": ({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}, b"\0" * 4),
    "document is no json": ({"__metadata__": {"nerfvol": "{"}}, b""),
    "document is a list": ({"__metadata__": {"nerfvol": "[]"}}, b""),
    "document nested for ever": ({"__metadata__": {"nerfvol": "[" * 100_000}}, b""),
    "other version": (document(["dict", []], version=99), b""),
    "missing array": (document(["dict", [["a", ["array", "7"]]]]), b""),
    "unknown tag": (document(["dict", [["a", ["eval", "1"]]]]), b""),
    "tree is a number": (document(3), b""),
    "bare dict in the tree": (document(["dict", [["a", {"x": 1}]]]), b""),
    "key that is a list": (document(["dict", [[["x"], 1]]]), b""),
    "dict entry of three": (document(["dict", [["a", 1, 2]]]), b""),
    "nested too deep": (document(deep(200)), b""),
    "header is no json": (b"{" + b"x" * 50, b""),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused(tmp_path, case):
    path = tmp_path / "c.safetensors"
    raw_file(path, *HOSTILE[case])
    with pytest.raises(InputError, match="checkpoint") as error:
        load_checkpoint(path)
    assert "c.safetensors" in str(error.value) and "\n" not in str(error.value)


def test_missing_folder_and_pickle_are_refused(tmp_path):
    (tmp_path / "p").write_bytes(pickle.dumps({"a": 1}))
    (tmp_path / "empty").touch()
    for name, reason in [("none", "no such"), ("", "is a folder"), ("p", "not a usable"), ("empty", "not a usable")]:
        with pytest.raises(InputError, match=reason):
            load_checkpoint(tmp_path / name)


@SETTINGS
@given(data=st.data())
def test_truncated_and_corrupted_bytes_only_ever_raise_input_errors(tmp_path, data):
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, {"step": 3, "a": np.arange(5.0), "nested": {"t": torch.ones(2, 2)}})
    whole = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        whole = whole[: data.draw(st.integers(0, len(whole) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 8))):
            whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(whole))
    try:
        load_checkpoint(path)
    except InputError as error:
        assert str(path) in str(error)


@SETTINGS
@given(content=st.binary(max_size=300))
def test_random_bytes(tmp_path, content):
    path = tmp_path / "c.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError):
        load_checkpoint(path)


def test_expect_names_what_came(tmp_path):
    write_arrays(tmp_path / "a", {"x": np.zeros((3, 2), np.int32)}, {})
    with ArrayFile(tmp_path / "a", "octree file") as file:
        assert file.expect("x", "int32", (None, 2)) == (3, 2)
        for dtype, shape in [("float32", (None, 2)), ("int32", (None, 3)), ("int32", (None,))]:
            with pytest.raises(InputError, match="should be .* it is int32 of 3×2"):
                file.expect("x", dtype, shape)
        with pytest.raises(InputError, match="'y' is missing"):
            file.expect("y", "int32", (None,))


def test_arrays_lie_aligned_to_their_elements(tmp_path):
    write_arrays(tmp_path / "a", {"a": np.zeros(3, np.uint8), "b": np.zeros(2), "c": np.zeros(5, np.int16)}, {})
    content = (tmp_path / "a").read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    for name, size in (("a", 1), ("b", 8), ("c", 2)):
        assert (8 + length + header[name]["data_offsets"][0]) % size == 0


def test_unsupported_dtype_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="complex"):
        write_arrays(tmp_path / "a", {"x": np.zeros(2, complex)}, {})
    with pytest.raises(ValueError):
        write_arrays(tmp_path / "a", {}, {"psnr": math.nan})
    assert os.listdir(tmp_path) == []
