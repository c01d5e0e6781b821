"""OpenVDB, npz and raw volumes: round trips, a real file, hostile files."""

import re
import struct
import zlib

import numpy as np
import pytest

from data_synth import media, scenes
from data_synth.blosc import decompress
from data_synth.bricks import bricks
from data_synth.errors import InputError, RenderWarning
from data_synth.vdb import Reader, Tree, grid_names, read_vdb
from data_synth.vdb_write import SparseGrid, write_grids, write_vdb
from data_synth.volumes import open_volume, read_volume, write_density
from tests.fixtures.real import real_data


@pytest.fixture
def values():
    v = np.random.default_rng(0).random((20, 140, 33)).astype(np.float32)
    v[v < 0.5] = 0.0
    v[:, 40:100] = 0.0
    return v


def test_round_trip(tmp_path, values):
    write_vdb(tmp_path / "a.vdb", values, (0.5, 0.25, 2.0), (1.0, 2.0, 3.0))
    grid = read_vdb(tmp_path / "a.vdb")
    assert grid.name == "density" and np.allclose(grid.voxel_size, (0.5, 0.25, 2.0))
    assert np.allclose(grid.origin, (1.0, 2.0, 3.0))
    part = values[tuple(slice(f, f + n) for f, n in zip(grid.first, grid.values.shape, strict=True))]
    assert np.array_equal(part, grid.values) and grid.values.sum() == values.sum()


def test_a_grid_says_its_name_and_where_it_is(tmp_path, values):
    """Blender shows a grid without these as nameless and of size 0, and finds no "density"."""
    write_vdb(tmp_path / "a.vdb", values)
    said = read_vdb(tmp_path / "a.vdb").metadata
    where = np.argwhere(values > 0)
    assert said["name"] == b"density" and said["class"] == b"fog volume"
    assert struct.unpack("<3i", said["file_bbox_min"]) == tuple(where.min(0))
    assert struct.unpack("<3i", said["file_bbox_max"]) == tuple(where.max(0))
    assert struct.unpack("<q", said["file_voxel_count"]) == (len(where),)


@pytest.mark.parametrize("half", [False, True])
def test_sparse_grids_far_apart_and_below_zero(tmp_path, half):
    """Indices of either sign, in several root nodes and in any order; numbers and vectors in one file."""
    rng = np.random.default_rng(3)
    coords = np.unique(rng.integers(-60, 60, (4000, 3)) + rng.choice([-130, 0, 140], (4000, 3)), axis=0)
    rng.shuffle(coords)
    numbers, vectors = (rng.uniform(-2, 2, (len(coords), *more)).astype(np.float32) for more in ((), (3,)))
    grids = [
        SparseGrid("density", coords, numbers, 0.5, (1, 2, 3)),
        SparseGrid("color", coords, vectors, kind="unknown"),
    ]
    assert write_grids(tmp_path / "a.vdb", grids, half) == (tmp_path / "a.vdb").stat().st_size
    for name, wanted in (("density", numbers), ("color", vectors)):
        grid = read_vdb(tmp_path / "a.vdb", name)
        got = grid.values[tuple((coords - grid.first).T)]
        assert np.abs(got - wanted).max() <= (2**-11 * 2 if half else 0)  # half a unit in the last place of 16 bits
        absent = np.ones(grid.values.shape[:3], bool)
        absent[tuple((coords - grid.first).T)] = False
        assert not grid.values[absent].any()
    assert read_vdb(tmp_path / "a.vdb").values.ndim == 3


@pytest.mark.parametrize("half, sizes", [(False, 16), (True, 0)])
def test_a_voxel_takes_the_bytes_that_openvdb_reads(tmp_path, half, sizes):
    """Between a grid's two marks: root, a node of 32^3 and one of 16^3 without values, whose number of bytes (8 each) is in
    files of single precision alone, and a leaf's mask. Our reader would agree with our writer; Blender did not."""
    grid = SparseGrid("density", np.array([[3, 4, 5]]), np.array([0.5]))
    write_grids(tmp_path / "a.vdb", [grid], half)
    data = (tmp_path / "a.vdb").read_bytes()
    kind = b"Tree_float_5_4_3" + (b"_HalfFloat" if half else b"")
    start, block, end = struct.unpack_from("<3q", data, data.index(kind) + len(kind) + 4)
    topology = data.index(b"ScaleTranslateMap", start) + 17 + 18 * 8
    root, nodes = 4 + 4 + 4 + 4 + 12, (2 * 4096 + 1) + (2 * 512 + 1)
    assert block - topology == root + nodes + sizes + 64
    assert end == len(data) and end - block == 64 + 1 + 8 + (2 if half else 4)


def test_grids_that_no_file_holds(tmp_path):
    place = np.zeros((2, 3), int)
    for coords, values, message in (
        (place, np.ones(2), "a voxel twice"), (place[:0], np.ones(0), "active voxels"), (place[:1], [np.inf], "not finite"),
        (place[:1], [1e5], "16-bit"), (place[:1] + (1 << 31), [1.0], "beyond"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            write_grids(tmp_path / "a.vdb", [SparseGrid("density", coords, np.asarray(values))])
    assert not list(tmp_path.iterdir())


def test_every_truncation_is_an_input_error(tmp_path, values):
    write_vdb(tmp_path / "a.vdb", values[:9, :9, :9])
    data = (tmp_path / "a.vdb").read_bytes()
    for n in [0, 7, 15, 60, 100, len(data) // 2, len(data) - 1]:
        (tmp_path / "b.vdb").write_bytes(data[:n])
        with pytest.raises(InputError, match="b.vdb"):
            read_vdb(tmp_path / "b.vdb")


def test_random_damage_never_escapes(tmp_path, values):
    write_vdb(tmp_path / "a.vdb", values[:9, :9, :9])
    data, rng = bytearray((tmp_path / "a.vdb").read_bytes()), np.random.default_rng(1)
    for _ in range(60):
        damaged = bytearray(data)
        damaged[int(rng.integers(0, 600))] = int(rng.integers(0, 256))
        (tmp_path / "b.vdb").write_bytes(damaged)
        try:
            read_vdb(tmp_path / "b.vdb")
        except InputError:
            pass


@pytest.mark.parametrize(
    "code, extra, inactive",
    [
        (0, b"", (0.5, 0.5)),
        (1, b"", (-0.5, -0.5)),
        (2, struct.pack("<f", 3.0), (3.0, 3.0)),
        (3, bytes([0b1010] + [0] * 63), (-0.5, 0.5)),
        (4, struct.pack("<f", 3.0) + bytes([0b1010] + [0] * 63), (3.0, 0.5)),
        (5, struct.pack("<ff", 3.0, 4.0) + bytes([0b1010] + [0] * 63), (3.0, 4.0)),
    ],
)
def test_inactive_values_of_a_compressed_leaf(code, extra, inactive):
    """The six ways in which OpenVDB leaves out inactive values; voxels 1 and 3 are chosen, voxel 2 is active.

    Of background and minus it the chosen ones are the background (test_level_sets.py has a file that OpenVDB wrote)."""
    data = bytes([code]) + extra + struct.pack("<f", 9.0)
    tree = Tree.__new__(Tree)
    tree.r, tree.flags, tree.half, tree.background = Reader(data, "x.vdb"), 2, False, 0.5
    active = np.zeros(512, bool)
    active[2] = True
    values, _ = tree._values(512, active)
    assert values[:4].tolist() == [inactive[0], inactive[1], 9.0, inactive[1]]
    assert tree.r.at == len(data)


def lz4(plain):
    """A valid LZ4 block: a match of 4 or more where one is near, else literals; the last five bytes are literals."""
    out, at, literals = bytearray(), 0, 0

    def number(n):
        while n >= 255:
            out.append(255)
            n -= 255
        out.append(n)

    def emit(end, offset=0, length=0):
        n = end - literals
        out.append(min(n, 15) << 4 | (min(length - 4, 15) if length else 0))
        if n >= 15:
            number(n - 15)
        out.extend(plain[literals:end])
        if length:
            out.extend(struct.pack("<H", offset))
            if length - 4 >= 15:
                number(length - 19)

    while at < len(plain) - 12:
        offset = next((o for o in (1, 2, 7, 40) if o <= at and plain[at - o : at - o + 4] == plain[at : at + 4]), 0)
        if not offset:
            at += 1
            continue
        length = 4
        while at + length < len(plain) - 5 and plain[at + length - offset] == plain[at + length]:
            length += 1
        emit(at, offset, length)
        at += length
        literals = at
    emit(len(plain))
    return bytes(out)


def frame(plain, width=4, block=1024, shuffle=True, split=True):
    """A blosc 1 frame, written from the description of the format."""
    blocks = [plain[k : k + block] for k in range(0, len(plain), block)]
    body, starts = b"", []
    for part in blocks:
        starts.append(16 + 4 * len(blocks) + len(body))
        if shuffle:
            whole = len(part) // width * width
            part = np.frombuffer(part[:whole], np.uint8).reshape(-1, width).T.tobytes() + part[whole:]
        n = width if split and len(part) == block and block // width >= 128 else 1
        for k in range(n):
            stream = part[k * len(part) // n : (k + 1) * len(part) // n]
            packed = lz4(stream)
            stored = packed if len(packed) < len(stream) else stream
            body += struct.pack("<i", len(stored)) + stored
    flags = 1 << 5 | (1 if shuffle else 0) | (0 if split else 16)
    head = struct.pack("<BBBBIII", 2, 1, flags, width, len(plain), block, 16 + 4 * len(blocks) + len(body))
    return head + struct.pack(f"<{len(blocks)}I", *starts) + body


@pytest.mark.parametrize("n, width, block, shuffle, split", [
    (5000, 4, 1024, True, True), (4096, 4, 4096, True, True), (900, 4, 4096, True, False),
    (777, 2, 512, False, True), (3, 4, 64, True, True),
])  # fmt: skip
def test_blosc_frames(n, width, block, shuffle, split):
    plain = (np.arange(n) // 37 % 11).astype(np.uint8).tobytes()
    packed = frame(plain, width, block, shuffle, split)
    assert decompress(packed, n).tobytes() == plain
    assert n < 100 or len(packed) < 0.7 * n
    copied = struct.pack("<BBBBIII", 2, 1, 2, width, n, n, 16 + n) + plain
    assert decompress(copied, n).tobytes() == plain
    rng = np.random.default_rng(0)
    for _ in range(200):  # damage ends in an error or in other bytes, never outside the arrays
        damaged = bytearray(packed)
        damaged[int(rng.integers(len(damaged)))] = int(rng.integers(256))
        try:
            assert len(decompress(bytes(damaged[: int(rng.integers(1, len(damaged) + 1))]), n)) == n
        except (ValueError, zlib.error):
            pass


def test_blosc_and_other_formats_are_named(tmp_path, values):
    write_vdb(tmp_path / "a.vdb", values[:9, :9, :9])
    data = (tmp_path / "a.vdb").read_bytes()
    at = data.index(struct.pack("<I", 7) + struct.pack("<I", 4) + b"name") - 4
    (tmp_path / "b.vdb").write_bytes(data[:at] + struct.pack("<I", 4) + data[at + 4 :])
    with pytest.raises(InputError, match="b.vdb"):
        read_vdb(tmp_path / "b.vdb")
    zstd = struct.pack("<BBBBIII", 2, 1, 4 << 5 | 1, 4, 16, 16, 40) + bytes(24)
    with pytest.raises(ValueError, match="zstd"):
        decompress(zstd, 16)
    (tmp_path / "c.vdb").write_bytes(b"not a volume at all, only text")
    with pytest.raises(InputError, match="another format"):
        read_vdb(tmp_path / "c.vdb")
    with pytest.raises(InputError, match="cannot be read"):
        read_vdb(tmp_path / "missing.vdb")


def two_grids(tmp_path, names):
    """A file of several float grids, joined from files of one each."""
    head, entries, at = b"", [], 0
    for k, name in enumerate(names):
        write_vdb(tmp_path / "one.vdb", np.full((4, 4, 4), k + 1.0), (0.5,) * 3)
        data = (tmp_path / "one.vdb").read_bytes()
        start = data.index(struct.pack("<I", 7) + b"density")
        head = data[: start - 4]
        entries.append((name, data[start + 11 : start + 11 + 4 + 16 + 4], data[start + 11 + 24 + 24 :]))
    at = len(head) + 4
    out = head + struct.pack("<I", len(names))
    for name, kind, body in entries:
        text = struct.pack("<I", len(name)) + name.encode()
        at += len(text) + len(kind) + 24
        out += text + kind + struct.pack("<qqq", at, at, at + len(body)) + body
        at += len(body)
    (tmp_path / "two.vdb").write_bytes(out)
    return tmp_path / "two.vdb"


@pytest.mark.parametrize("names", [("flame", "density"), ("density", "flame"), ("heat", "flame")])
def test_grids_by_name(tmp_path, names):
    """The density wherever it stands, else the first; a sentence says which; FILE.vdb:NAME takes another."""
    path = two_grids(tmp_path, names)
    want = "density" if "density" in names else "heat"
    with pytest.warns(RenderWarning, match=f"took the grid {want}.*flame"):
        values, spacing = read_volume(path)
    assert np.all(values == names.index(want) + 1.0) and np.allclose(spacing, 0.5)
    assert np.all(read_volume(f"{path}:flame")[0] == names.index("flame") + 1.0)
    with pytest.raises(InputError, match="flame.*not smoke"):
        read_volume(f"{path}:smoke")


def several(path, *names):
    """Grids of eight voxels each, of value 1, 2, ...; names as OpenVDB writes them: of several alike each with its number."""
    write_grids(
        path, [SparseGrid(name, np.argwhere(np.ones((2, 2, 2))), np.full(8, k + 1.0)) for k, name in enumerate(names)]
    )
    return path


@pytest.mark.parametrize("names, known", [
    (("density\x1e0", "density\x1e1", "heat"), {"density": 1, "density[0]": 1, "density[1]": 2, "heat": 3}),
    (("\x1e0", "\x1e1"), {"[0]": 1, "[1]": 2}),
    (("", "heat"), {"[0]": 1, "heat": 2}),
    (("a", "a", "a[1]"), {"a": 1, "a[0]": 1, "a[1]": 2, "a[1][1]": 3}),
    (("", "", ""), {"[0]": 1, "[1]": 2, "[2]": 3}),
])  # fmt: skip
def test_several_grids_of_one_name_and_grids_without_one(tmp_path, names, known):
    """As OpenVDB's tools call them."""
    path = several(tmp_path / "a.vdb", *names)
    for name, value in known.items():
        assert read_vdb(path, name).values.max() == value, name
    with pytest.warns(RenderWarning, match=re.escape(f"took the grid {next(iter(known))};")):
        assert read_volume(path)[0].max() == 1
    shown = known.keys() - {f"{name}[0]" for name in known}
    assert grid_names(path) == (dict.fromkeys((n for n in known if n in shown), 1), ())


def spoilt(path, name, what):
    """Of a grid: the number of its metadata's entries, the place where it ends, or its values."""
    data = bytearray(path.read_bytes())
    kind = data.index(b"Tree_float_5_4_3", data.index(name))
    places = kind + struct.unpack_from("<I", data, kind - 4)[0] + 4
    start, block, _ = struct.unpack_from("<3q", data, places)
    if what == "place":
        data[places + 16 : places + 24] = struct.pack("<q", len(data) + 9)
    elif what == "metadata":
        data[start + 4 : start + 8] = b"\xff" * 4
    elif what == "values":
        data[start + 4 + 4 :] = data[start + 4 + 4 :].replace(b"ScaleTranslateMap", b"ScaleTranslateMop", 1)
    path.write_bytes(data)


@pytest.mark.parametrize("what", ["metadata", "values", "place"])
def test_a_damaged_grid_is_no_harm_to_the_others(tmp_path, what):
    """Whoever names none gets the density where that is whole; else nobody knows which was meant. Where a grid's place is
    damaged, those after it are not found."""
    path = several(tmp_path / "a.vdb", "first", "density", "heat", "last")
    whole = path.read_bytes()
    spoilt(path, b"heat", what)
    assert read_vdb(path, "first").values.max() == 1
    assert read_vdb(path).values.max() == 2
    with pytest.raises(InputError, match=r"a\.vdb: expected an OpenVDB"):
        read_vdb(path, "heat")
    if what == "place":
        with pytest.raises(InputError, match="the grid heat says it lies at"):
            read_vdb(path, "last")
    else:
        assert read_vdb(path, "last").values.max() == 4
    path.write_bytes(whole)
    spoilt(path, b"density", what)
    with pytest.raises(InputError, match=r"a\.vdb: expected an OpenVDB"):
        read_vdb(path)
    assert read_vdb(path, "first").values.max() == 1


def test_a_damaged_grid_of_colour_is_left_out(tmp_path):
    path = several(tmp_path / "a.vdb", "density", "temperature")
    spoilt(path, b"temperature", "values")
    with pytest.warns(RenderWarning) as told:
        volume = open_volume(path)
    assert volume.heat is None and volume.density.max() == 1
    assert "temperature cannot be read and is left out" in str(told[0].message)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name, what", [("Cd", "colour"), ("temperature", "heat")])
def test_a_further_grid_of_values_that_are_no_numbers_is_left_out(tmp_path, monkeypatch, bad, name, what):
    """The density and the other grids are read as if it were not there; without a density nobody knows what was meant."""
    monkeypatch.setattr("data_synth.vdb_write._Layout._check", lambda *_: None)  # it refuses to write such values
    path, coords = tmp_path / "a.vdb", np.argwhere(np.ones((3, 3, 3)))
    ones = {n: np.ones((27, 3) if n == "Cd" else 27, np.float32) for n in ("density", "Cd", "temperature")}
    ones[name][4] = bad
    write_grids(path, [SparseGrid(n, coords, values) for n, values in ones.items()])
    with pytest.warns(RenderWarning) as told:
        volume = open_volume(path)
    assert f"{name} cannot be read and is left out" in str(told[0].message)
    assert "infinite or no number" in str(told[0].message) and f", not {name};" in str(told[1].message)
    assert volume.density.max() == 1 and getattr(volume, what) is None
    assert (volume.heat if what == "colour" else volume.colour) is not None
    ones["density"][4] = bad
    write_grids(path, [SparseGrid(n, coords, values) for n, values in ones.items()])
    with pytest.raises(InputError, match=r"a\.vdb:density: expected finite samples, got 1 "):
        open_volume(path)


@pytest.mark.parametrize("kind, message", [
    (b"NonlinearFrustumMap", "its grid density lie in a camera's frustum"),
    (b"UnitaryMap", "transform of its grid density is a Unit"),
])  # fmt: skip
def test_transforms_that_are_no_scale_are_named(tmp_path, kind, message):
    path = several(tmp_path / "a.vdb", "density")
    usual = struct.pack("<I", 17) + b"ScaleTranslateMap"
    data = path.read_bytes()
    assert data.count(usual) == 1
    place = data.index(b"Tree_float_5_4_3")
    at = place + struct.unpack_from("<I", data, place - 4)[0] + 4
    more = len(kind) - 17
    places = [n + d for n, d in zip(struct.unpack_from("<3q", data, at), (0, more, more), strict=True)]
    data = data[:at] + struct.pack("<3q", *places) + data[at + 24 :]
    path.write_bytes(data.replace(usual, struct.pack("<I", len(kind)) + kind))
    with pytest.raises(InputError, match=message):
        read_vdb(path)


@pytest.mark.parametrize("arrays, message", [
    ({"density": np.full((3, 3, 3), np.nan)}, "27 that are infinite or no number"),
    ({"density": np.full((3, 3, 3), "a")}, "array of numbers"),
    ({"density": np.ones((3, 3, 3)), "voxel_size": [1.0, 2.0]}, "three positive"),
    ({"density": np.ones((3, 3, 3)), "voxel_size": [1.0, 2.0, 0.0]}, "three positive"),
    ({"density": np.ones((1, 3, 3))}, "at least 2"),
])  # fmt: skip
def test_what_is_wrong_with_a_volume_is_said(tmp_path, arrays, message):
    np.savez(tmp_path / "v.npz", **arrays)
    with pytest.raises(InputError, match=message):
        read_volume(tmp_path / "v.npz")


def test_negative_and_constant_densities(tmp_path):
    np.savez(tmp_path / "one.npz", density=np.ones((3, 3, 3)))
    assert scenes.make("smoke", volume=str(tmp_path / "one.npz")).medium.max_density == 1.0  # a cube of smoke
    np.savez(tmp_path / "two.npz", density=np.linspace(-1, 2, 27).reshape(3, 3, 3))
    with pytest.warns(RenderWarning, match="samples are negative, down to -1"):
        scenes.make("smoke", volume=str(tmp_path / "two.npz"))
    assert scenes.make("phantom", volume=str(tmp_path / "two.npz")).medium.max_density > 0  # of a scan they are values
    with pytest.raises(InputError, match=r"one\.npz: expected samples of more than one value, got 1 alone"):
        scenes.make("phantom", volume=str(tmp_path / "one.npz"))


def test_numpy_and_raw(tmp_path):
    v = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    np.savez(tmp_path / "v.npz", density=v, voxel_size=[1.0, 2.0, 3.0])
    values, spacing = read_volume(tmp_path / "v.npz")
    assert np.array_equal(values, v) and np.array_equal(spacing, [1, 2, 3])
    v.transpose(2, 1, 0).tofile(tmp_path / "head_2x3x4_uint8.raw")
    assert np.array_equal(read_volume(tmp_path / "head_2x3x4_uint8.raw")[0], v)
    np.savez(tmp_path / "flat.npz", a=np.zeros(3))
    for name, message in (("flat.npz", "3D array"), ("no.vdb", "no such file")):
        with pytest.raises(InputError, match=message):
            read_volume(tmp_path / name)
    (tmp_path / "bad.npz").write_bytes(b"PK\3\4 rubbish")
    with pytest.raises(InputError, match="numpy volume"):
        read_volume(tmp_path / "bad.npz")


@pytest.mark.parametrize("kind", ["S4", "U1", "complex64", "M8[s]", "object", "V4", "float99", ""])
def test_raw_samples_of_a_type_that_is_no_number(tmp_path, kind):
    path = tmp_path / f"head_2x2x2_{kind}.raw"
    path.write_bytes(bytes(range(64)))
    with pytest.raises(InputError, match="head_2x2x2") as caught:
        read_volume(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("steering", ["\x1b[2J", "\x1b]0;x\x07", "\u202e", "a\0b"])
def test_a_grids_name_does_not_steer_the_terminal(tmp_path, values, steering, command):
    """It is said as text."""
    file, out = tmp_path / "a.vdb", tmp_path / "s"
    write_grids(file, [SparseGrid(steering + "x" * 3, np.argwhere(values > 0)[:9], np.ones(9, np.float32))])
    whole = bytearray(file.read_bytes())
    at = whole.index(b"Tree_float_5_4_3") + 16 + 4 + 16
    whole[at : at + 8] = struct.pack("<q", at - 60)
    file.write_bytes(whole)
    code, _, said = command("synth", "smoke", "--volume", file, "--views", "1", "--size", "8x8", "--out", out)
    assert code == 2 and "says it lies at bytes" in said and said.strip().isprintable()


def test_pickles_are_not_loaded(tmp_path):
    np.save(tmp_path / "evil.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="evil.npy"):
        read_volume(tmp_path / "evil.npy")


def test_written_truth_is_the_extinction(tmp_path, values):
    m = media.grid(values, (0, 0, 0), (1, 7, 1.6), sigma_t=(1.0, 2.0, 3.0))
    write_density(m, tmp_path)
    with np.load(tmp_path / "density.npz") as stored:
        assert np.array_equal(stored["density"], 2.0 * values) and np.allclose(stored["hi"], (1, 7, 1.6))
    assert read_vdb(tmp_path / "density.vdb").values.sum() == pytest.approx(2.0 * values.sum(dtype=float), rel=1e-5)


def test_a_real_file_reads_exactly():
    folder = real_data("volumes")
    grid = read_vdb(folder / "smoke.vdb")
    with np.load(folder / "smoke_dense_f32.npz") as dense:
        assert np.array_equal(grid.values, dense["density"]) and np.array_equal(grid.first, dense["ijk_min"])
        assert np.allclose(grid.voxel_size, dense["voxel_size"])


def test_a_grid_of_tiles_alone_is_cut_to_bricks():
    """Without any leaf its blocks' places were no whole numbers, and synth ended in a TypeError."""
    tree = Tree(Reader(struct.pack("<fII", 0.0, 0, 0), "tiles.vdb"), flags=0, half=False)
    tree.values, tree.active = np.zeros((0, 512), np.float32), np.zeros((0, 512), bool)
    tree.boxes = [(np.array([8, -16, 0]), 8, 0.25), (np.array([8, 0, 16]), 8, 0.5)]
    first, volume = tree.sparse()
    assert first.tolist() == [8, -16, 0] and volume.size == (8, 24, 24)
    total = bricks(volume).samples.reshape(-1, 9, 9, 9)[:, :8, :8, :8].sum()
    assert total == pytest.approx(512 * 0.75)


def test_voxels_far_apart_and_grids_that_end_before_they_begin(tmp_path):
    """8 kB that ask for gigabytes are refused before any is taken, and so is a file that would be read for ever."""
    far = np.array([[0, 0, 0], [900, 900, 900]])
    write_grids(tmp_path / "far.vdb", [SparseGrid("density", far, np.ones(2, np.float32))])
    with pytest.raises(InputError, match="901x901x901 apart, 2.7 GiB"):
        read_vdb(tmp_path / "far.vdb")
    whole = bytearray((tmp_path / "far.vdb").read_bytes())
    at = whole.index(b"Tree_float_5_4_3") + 16 + 4 + 16
    whole[at : at + 8] = struct.pack("<q", at - 60)
    (tmp_path / "back.vdb").write_bytes(whole)
    with pytest.raises(InputError, match="says it lies at bytes"):
        read_vdb(tmp_path / "back.vdb")


@pytest.mark.parametrize("make", [
    lambda data: data[: len(data) // 2], lambda data: data[:90] + bytes(40) + data[130:], lambda data: b"",
])  # fmt: skip
def test_a_damaged_archive_is_one_sentence(tmp_path, make):
    np.savez_compressed(tmp_path / "v.npz", density=np.random.default_rng(0).random((4, 5, 6)))
    (tmp_path / "v.npz").write_bytes(make((tmp_path / "v.npz").read_bytes()))
    with pytest.raises(InputError, match="v.npz: cannot be read as a numpy volume"):
        read_volume(tmp_path / "v.npz")


def test_an_array_called_an_archive(tmp_path):
    with (tmp_path / "v.npz").open("wb") as file:
        np.save(file, np.ones((3, 3, 3)))
    with pytest.raises(InputError, match="it holds one array; such a file's name ends in .npy"):
        read_volume(tmp_path / "v.npz")
