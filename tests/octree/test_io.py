"""Octree files: exact or within the codec's stated bounds, and nothing that bytes can say does more than be refused."""

import json
import os
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

from nerfvol.errors import InputError
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.octree import codec, io
from nerfvol.octree.io import describe_octree, load_octree, save_octree
from nerfvol.octree.topology import morton
from nerfvol.octree.tree import Octree

BYTE = st.integers(0, 255)
SETTINGS = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def make_octree(seed=0, degree=1, level=3, share=0.2):
    """Random leaves of two levels with random values of a trained octree's magnitudes."""
    rng = np.random.default_rng(seed)
    n = 1 << level
    cells = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = cells[rng.random(len(cells)) < share]
    if not len(cells):
        cells = np.zeros((1, 3), int)
    octree = Octree.from_leaves(np.full(len(cells), level), cells, (-1.0, -2.0, 0.5), 3.0, degree, 100.0)
    octree, _ = octree.subdivide(rng.random(octree.n_leaves) < 0.3)
    octree.density = rng.normal(0.0, 6.0, octree.n_vertices)
    octree.sh = rng.normal(0.0, 0.5, (octree.n_vertices, 3, (degree + 1) ** 2))
    return octree


def assert_same_topology(a, b):
    for name in ("node_mask", "leaf_mask", "corners", "leaf_level", "leaf_ijk", "origin"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert (a.size, a.density_scale, a.sh_degree) == (b.size, b.density_scale, b.sh_degree)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_float32_is_exact(tmp_path, degree):
    octree = make_octree(degree, degree)
    metadata = {"provenance": {"data": "é", "seed": 3}, "orbit": None}
    size = save_octree(tmp_path / "o.safetensors", octree, metadata)
    loaded, found = load_octree(tmp_path / "o.safetensors")
    loaded.validate()
    assert size == (tmp_path / "o.safetensors").stat().st_size and found == metadata
    assert_same_topology(octree, loaded)
    assert np.array_equal(octree.values, loaded.values)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_mapped_file_is_exact_and_opens_without_a_copy(tmp_path, degree):
    octree = make_octree(degree, degree)
    path = tmp_path / "o.safetensors"
    save_octree(path, octree, {"a": 1}, "mapped")
    before = path.read_bytes()
    loaded, metadata = load_octree(path)
    loaded.validate()
    assert metadata == {"a": 1} and describe_octree(path)["version"] == io.MAPPED_VERSION
    assert_same_topology(octree, loaded)
    assert np.array_equal(octree.values, loaded.values)
    # The kernels take rows and corners as they lie, on cache lines, in pages of the file.
    kept = loaded.values
    loaded.values = kept
    assert loaded.values is kept and isinstance(kept.base, np.memmap)
    assert all(array.ctypes.data % 64 == 0 for array in (loaded.values, loaded.corners))
    loaded.density = 0.0  # this process's own copy
    assert path.read_bytes() == before and np.array_equal(load_octree(path)[0].values, octree.values)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("corners", lambda a: np.where(a == a.max(), a.max() + 1, a), "corners point outside"),
        ("corners", lambda a: a - 1, "corners point outside"),
        ("leaf_level", lambda a: a + 1, "levels that it does not have"),
        ("leaf_ijk", lambda a: a + 8, "outside the root cube"),
        ("leaf_mask", lambda a: np.zeros_like(a), "no leaves"),
        ("node_mask", lambda a: np.roll(a, 1), "hang on the root|both as an interior"),
        ("values", lambda a: np.full_like(a, np.nan), "not finite"),
        ("values", lambda a: a[:-1], "shape"),
    ],
)  # fmt: skip
def test_a_lying_mapped_file_is_refused(tmp_path, name, change, message):
    path = tmp_path / "o.safetensors"
    save_octree(path, make_octree(), {}, "mapped")
    arrays, metadata = load_file(path), json.dumps(describe_octree(path))
    arrays[name] = np.ascontiguousarray(change(arrays[name]).astype(arrays[name].dtype))
    save_file(arrays, path, {"nerfvol": metadata})
    with pytest.raises(InputError, match=message):
        load_octree(path)


def test_float16_is_rounded_once(tmp_path):
    octree = make_octree()
    save_octree(tmp_path / "o.safetensors", octree, {}, "float16")
    loaded, _ = load_octree(tmp_path / "o.safetensors")
    assert_same_topology(octree, loaded)
    assert np.array_equal(loaded.density, octree.density.astype(np.float16).astype(np.float32))
    assert np.array_equal(loaded.sh, octree.sh.astype(np.float16).astype(np.float32))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("quality", [1.0, 4.0])
def test_codec_keeps_its_error_bounds(degree, quality):
    octree = make_octree(degree + 10, degree)
    density, sh = octree.density.copy(), octree.sh
    planes, parameters = codec.encode(density, sh, quality)
    parameters = json.loads(json.dumps(parameters))
    found_density, found_sh = codec.decode(len(density), sh.shape[2], planes.__getitem__, parameters)
    # Rounding moves the companded density by at most half a step; float32 adds its own rounding, some 1e-6 of asinh.
    curve = np.arcsinh(np.float64(density) / codec.DENSITY_SOFTNESS)
    moved = np.abs(np.arcsinh(np.float64(found_density) / codec.DENSITY_SOFTNESS) - curve)
    assert moved.max() <= 0.5 * codec.DENSITY_STEP / quality + 1e-5
    # An orthonormal rotation of three errors of half a step each is at most sqrt(3) / 2 steps long.
    step = codec.COLOUR_STEP / 0.28209479177387814 / quality
    distance = np.linalg.norm(found_sh - sh, axis=1)
    assert distance.max() <= 0.5 * 3**0.5 * step + 1e-5
    # Uniform rounding errors have variance step^2 / 12: the whole range of steps is used, none twice as coarse.
    assert np.isclose((found_sh - sh).var(), step**2 / 12, rtol=0.15)


def test_compact_file(tmp_path):
    octree = make_octree(level=4, share=0.5)
    exact = save_octree(tmp_path / "f.safetensors", octree, {})
    size = save_octree(tmp_path / "c.safetensors", octree, {"a": [1]}, "compact")
    loaded, metadata = load_octree(tmp_path / "c.safetensors")
    assert_same_topology(octree, loaded)
    assert metadata == {"a": [1]}
    assert size < exact / 4
    assert np.abs(loaded.sh - octree.sh).max() < 0.06


def test_smooth_values_store_differences(tmp_path):
    octree = make_octree(level=4, share=0.7)
    position = octree.vertex_positions()
    octree.density = 40 * np.sin(position[:, 0])
    sh = np.zeros((octree.n_vertices, 3, 4), np.float32)
    sh[:, :, 0] = np.cos(position)
    octree.sh = sh
    planes, parameters = codec.encode(octree.density, octree.sh)
    assert parameters["differences"][1] and not parameters["differences"][2]
    density, found = codec.decode(octree.n_vertices, 4, planes.__getitem__, parameters)
    assert np.abs(found - octree.sh).max() < 0.06
    moved = np.abs(np.arcsinh(density / 2) - np.arcsinh(octree.density / 2))
    assert moved.max() < 0.5 * codec.DENSITY_STEP + 1e-5


def test_values_at_the_bounds_survive(tmp_path):
    octree = make_octree()
    for value in (io.LARGEST_VALUE, -io.LARGEST_VALUE, 0.0):
        octree.density = value
        save_octree(tmp_path / "o.safetensors", octree, {}, "compact")
        loaded, _ = load_octree(tmp_path / "o.safetensors")
        assert np.allclose(loaded.density, value, rtol=0.02)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 2e6])
def test_values_out_of_bounds_are_not_written(tmp_path, bad):
    octree = make_octree()
    octree.density[5] = bad
    with pytest.raises(InputError, match="cannot write .*o.safetensors"):
        save_octree(tmp_path / "o.safetensors", octree, {})
    assert not (tmp_path / "o.safetensors").exists()
    with pytest.raises(ValueError, match="storage"):
        save_octree(tmp_path / "o.safetensors", make_octree(), {}, "int3")


def test_describe_reads_no_array(tmp_path):
    octree = make_octree()
    save_octree(tmp_path / "o.safetensors", octree, {"x": 1})
    document = describe_octree(tmp_path / "o.safetensors")
    assert document["n_leaves"] == octree.n_leaves and document["colour"] == "half_plus_sh"
    assert document["aabb"] == [[-1.0, -2.0, 0.5], [2.0, 1.0, 3.5]]


def test_the_documented_reader_finds_the_same_leaves(tmp_path, monkeypatch):
    """docs/file_format.md shows how to read a file without nerfvol: run just that."""
    monkeypatch.chdir(tmp_path)
    octree = make_octree()
    save_octree("octree.safetensors", octree, {})
    text = (Path(__file__).parents[2] / "docs" / "file_format.md").read_text()
    names: dict = {}
    exec(text.split("```python\n")[1].split("```")[0], names)
    assert names["leaves"] == list(zip(octree.leaf_level.tolist(), morton(octree.leaf_ijk).tolist(), strict=True))


# ---------------------------------------------------------------- hostile files
def edited(path, storage="float32", document=None, **arrays):
    """A saved octree with its document or arrays changed (None removes an array)."""
    octree = make_octree()
    save_octree(path, octree, {}, storage)
    content = load_file(path)
    whole = describe_octree(path)
    whole.update(document or {})
    for name, change in arrays.items():
        name = name.replace("__", ".")
        if change is None:
            del content[name]
        else:
            content[name] = change(content[name]) if callable(change) else change
    save_file({k: np.ascontiguousarray(v) for k, v in content.items()}, path, {"nerfvol": json.dumps(whole)})
    return octree


def chain_masks(depth):
    """One interior child per level: an octree ``depth`` levels deep."""
    nodes, leaves = np.full(depth, 1, np.uint8), np.zeros(depth, np.uint8)
    nodes[-1], leaves[-1] = 0, 1
    return {"node_mask": nodes, "leaf_mask": leaves}


def set_bit(index, value):
    def change(mask):
        mask = mask.copy()
        mask[index] = value
        return mask

    return change


def with_value(value):
    def change(array):
        array = array.copy()
        array.reshape(-1)[7] = value
        return array

    return change


BOMB = np.frombuffer(zlib.compress(b"\0" * 50_000_000), np.uint8)
HOSTILE = {
    "other format": (dict(document={"format": "pickle"}), "expected the format"),
    "newer version": (dict(document={"version": 3}), "reads versions 1 and 2"),
    "other colour": (dict(document={"colour": "sigmoid_sh"}), "colour convention"),
    "other density": (dict(document={"density": "softplus"}), "density convention"),
    "unknown storage": (dict(document={"storage": "exe"}), "storage"),
    "degree 9": (dict(document={"sh_degree": 9}), "sh_degree"),
    "degree true": (dict(document={"sh_degree": True}), "sh_degree"),
    "no size": (dict(document={"size": None}), "size"),
    "negative size": (dict(document={"size": -1}), "size"),
    "huge scale": (dict(document={"density_scale": 1e300}), "density_scale"),
    "origin of two": (dict(document={"origin": [0, 0]}), "origin"),
    "origin of text": (dict(document={"origin": ["a", 0, 0]}), "origin"),
    "vertices of text": (dict(document={"n_vertices": "9"}), "n_vertices"),
    "negative vertices": (dict(document={"n_vertices": -1}), "n_vertices"),
    "more vertices than arrays": (dict(document={"n_vertices": 10**15}), "density"),
    "metadata is a list": (dict(document={"metadata": []}), "metadata"),
    "missing array": (dict(sh=None), "'sh' is missing"),
    "float64 density": (dict(density=lambda a: a.astype(np.float64)), "should be float32"),
    "int masks": (dict(node_mask=lambda a: a.astype(np.int32)), "should be uint8"),
    "two-dimensional mask": (dict(leaf_mask=lambda a: a[None]), "shape"),
    "masks of two lengths": (dict(leaf_mask=lambda a: a[:-1]), "shape"),
    "no nodes": (dict(node_mask=lambda a: a[:0], leaf_mask=lambda a: a[:0]), "vertices"),
    "no leaves": (dict(leaf_mask=lambda a: a * 0), "vertices"),
    "both bits set": (dict(leaf_mask=lambda a: a | 255), "both|vertices"),
    "one link too many": (dict(node_mask=set_bit(-1, 1)), "links|both|vertices"),
    "nodes that do not hang on the root": (dict(node_mask=set_bit(0, 0)), "links|hang|both|vertices"),
    "leaves missing": (dict(leaf_mask=set_bit(-1, 0)), "vertices"),
    "NaN density": (dict(density=with_value(np.nan)), "'density' are not finite"),
    "infinite colour": (dict(sh=with_value(np.inf)), "'sh' are not finite"),
    "absurd colour": (dict(sh=with_value(-1e20)), "'sh' are not finite"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_documents_and_arrays(tmp_path, case):
    changes, reason = HOSTILE[case]
    path = tmp_path / "bad.safetensors"
    edited(path, **changes)
    with pytest.raises(InputError, match=reason) as error:
        load_octree(path)
    assert "bad.safetensors" in str(error.value) and "\n" not in str(error.value)


COMPACT_HOSTILE = {
    "bomb": (dict(code000__low=BOMB), "does not hold one code"),
    "stream cut short": (dict(code001__low=lambda a: a[:-8]), "does not hold|damaged"),
    "checksum cut off": (dict(code001__low=lambda a: a[:-2]), "does not hold"),
    "too few codes": (dict(code002__high=np.frombuffer(zlib.compress(b"\0" * 5), np.uint8)), "does not hold one code"),
    "noise": (dict(code003__low=lambda a: a[::-1]), "damaged|does not hold"),
    "missing plane": (dict(code004__high=None), "missing"),
    "plane of another dtype": (dict(code004__high=lambda a: a.astype(np.int16)), "should be uint8"),
    "no codec": (dict(document={"codec": None}), "codec"),
    "step is text": (dict(document={"codec": {"density_step": "1", "differences": []}}), "density_step"),
    "too few flags": (
        dict(document={"codec": {"density_step": 1, "density_softness": 1, "sh_step": 1, "differences": [1]}}),
        "differences",
    ),
    "steps that overflow": (
        dict(document={"codec": {"density_step": 999, "density_softness": 999, "sh_step": 1, "differences": [0] * 13}}),
        "'density' are not finite or beyond",
    ),
    "sums out of range": (dict(code000__high=lambda a: np.frombuffer(zlib.compress(b"\xff" * 2000), np.uint8)), "code"),
}


@pytest.mark.parametrize("case", COMPACT_HOSTILE)
def test_hostile_compact_files(tmp_path, case):
    changes, reason = COMPACT_HOSTILE[case]
    path = tmp_path / "bad.safetensors"
    edited(path, "compact", **changes)
    with pytest.raises(InputError, match=reason):
        load_octree(path)


def test_a_bomb_costs_no_memory(tmp_path):
    """50 kB that claim to be 50 MB: reading stops at one byte more than there are vertices."""
    path = tmp_path / "bad.safetensors"
    edited(path, "compact", code000__low=BOMB)
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            load_octree(path)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_too_deep_an_octree_is_refused(tmp_path):
    path = tmp_path / "deep.safetensors"
    for depth, fine in ((16, True), (17, False)):
        values = dict(density=np.zeros(8, np.float32), sh=np.zeros((8, 3, 4), np.float32))
        edited(path, document={"n_vertices": 8}, **chain_masks(depth), **values)
        if fine:
            assert load_octree(path)[0].max_level == 16
        else:
            with pytest.raises(InputError, match="deeper than 16"):
                load_octree(path)


def test_a_declared_count_costs_no_memory(tmp_path, monkeypatch):
    """A count that the masks cannot have is refused before the octree is built."""
    path = tmp_path / "bad.safetensors"
    edited(path, "compact", document={"n_vertices": 10**9})
    monkeypatch.setattr(io, "Octree", None)
    with pytest.raises(InputError, match="declares 1000000000 vertices"):
        load_octree(path)


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    files = []
    for storage in ("float32", "compact"):
        save_octree(folder / storage, make_octree(level=2, share=0.4), {"provenance": {"seed": 1}}, storage)
        files.append((folder / storage).read_bytes())
    return files


@SETTINGS
@given(data=st.data())
def test_fuzzed_bytes_load_a_valid_octree_or_raise_one_sentence(tmp_path, whole_files, data):
    content = bytearray(data.draw(st.sampled_from(whole_files)))
    kind = data.draw(st.sampled_from(["cut", "flip", "splice"]))
    if kind == "cut":
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    elif kind == "flip":
        for _ in range(data.draw(st.integers(1, 6))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    else:
        start = data.draw(st.integers(0, len(content) - 1))
        content[start : start + 16] = data.draw(st.binary(max_size=32))
    path = tmp_path / "fuzz.safetensors"
    path.write_bytes(bytes(content))
    try:
        octree, _ = load_octree(path)
    except InputError as error:
        assert "fuzz.safetensors" in str(error) and "\n" not in str(error)
    else:
        octree.validate()


@SETTINGS
@given(masks=st.lists(st.tuples(BYTE, BYTE), min_size=1, max_size=12), n=st.integers(0, 90))
def test_fuzzed_masks(tmp_path, masks, n):
    path = tmp_path / "fuzz.safetensors"
    node_mask, leaf_mask = np.array(masks, np.uint8).T
    values = dict(density=np.zeros(n, np.float32), sh=np.zeros((n, 3, 4), np.float32))
    edited(path, document={"n_vertices": n}, node_mask=node_mask, leaf_mask=leaf_mask, **values)
    try:
        octree, _ = load_octree(path)
    except InputError:
        return
    octree.validate()


@pytest.mark.parametrize("key, value", [
    ("size", 10**400), ("origin", [0, 0, 10**400]), ("aabb", "big"), ("nerfvol", 5), ("n_vertices", True),
    ("density_scale", "9"),
])  # fmt: skip
def test_headers_that_lie_are_one_sentence(tmp_path, key, value):
    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), [0] * 3, 1.0)
    path = tmp_path / "a.safetensors"
    save_octree(path, octree, {}, "float32")
    with ArrayFile(path, "octree file") as file:
        document = {**file.document, key: value}
        arrays = {name: file.read(name) for name in file.shapes}
    write_arrays(path, arrays, document)
    with pytest.raises(InputError, match=f"its {key}|it says that nerfvol"):
        load_octree(path)


def test_what_would_not_fit_into_memory_is_refused_before_it_is_made(tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    save_octree(path, Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), [0] * 3, 1.0), {}, "float32")
    monkeypatch.setattr("nerfvol.machine.available_memory", lambda: 1000)
    with pytest.raises(InputError, match="GiB of memory"):
        load_octree(path)


@pytest.mark.skipif(sys.platform != "linux", reason="limits on address space are told by Linux")
def test_a_limit_on_the_process_is_a_limit_on_memory():
    """A batch system's ``ulimit -v``: what does not fit there is refused before it is tried."""
    code = (
        "import resource as r; hard = r.getrlimit(r.RLIMIT_AS)[1]; r.setrlimit(r.RLIMIT_AS, (1 << 29, hard))\n"
        "from nerfvol.machine import available_memory; print(available_memory())"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert 0 <= int(said.stdout) < 1 << 29
