"""NanoVDB files, written by NanoVDB's own library (10.0.1): what they hold is what was put in, damage is one sentence."""

import struct
from pathlib import Path

import numpy as np
import pytest

from data_synth import InputError, RenderWarning, level_sets, nanovdb, vdb_tree
from data_synth.bricks import Sparse
from data_synth.vdb import grid_names, read_level_set, read_vdb
from data_synth.volumes import open_volume, read_volume

FILES = Path(__file__).parent / "files"
SEVERAL = FILES / "several.nvdb"
"""density and Cd, spacing 0.5 from (1, -2, 3); ball4, ball8, ball16, the ball of ball.vdb in 4, 8 and 16 bits."""
N = np.arange(300)
VOXELS = np.stack([N * 37 % 61 - 30, N * 53 % 47 - 60, N * 29 % 300 - 140], axis=1)
VALUES = np.float32(0.01) * (N + 1).astype(np.float32)


def test_every_voxel_of_a_fog_is_what_was_put_in():
    """Far apart and on both sides of 0, in several nodes of each level; vectors beside numbers."""
    grid, colour = read_vdb(SEVERAL), read_vdb(SEVERAL, "Cd")
    assert grid.name == "density" and grid.voxel_size == pytest.approx([0.5] * 3) and grid.origin.tolist() == [1, -2, 3]
    assert np.array_equal(grid.values[tuple((VOXELS - grid.first).T)], VALUES) and (grid.values != 0).sum() == 300
    want = np.stack([VALUES, np.float32(0.5) * VALUES, np.ones_like(VALUES)], axis=1)
    assert np.array_equal(colour.values[tuple((VOXELS - colour.first).T)], want)
    assert grid_names(SEVERAL)[0] == {"density": 1, "Cd": 3, "ball4": 1, "ball8": 1, "ball16": 1}
    with pytest.warns(RenderWarning, match="took density as density, Cd as colour, not ball4"):
        volume = open_volume(SEVERAL)
    assert isinstance(volume.density, Sparse) and np.array_equal(volume.density.dense(), grid.values)
    assert volume.colour is not None
    assert np.array_equal(read_volume(f"{SEVERAL}:density")[0], grid.values)


@pytest.mark.parametrize("name", ["ball.nvdb", "ball_blosc.nvdb"])
def test_a_level_set_is_that_of_openvdb(name):
    """Zip and blosc: sample by sample, what nanovdb made is what openvdb made of the same sphere."""
    tree, voxel_size, origin = read_level_set(FILES / name)
    other, _, _ = read_level_set(FILES / "ball.vdb")
    assert voxel_size == pytest.approx([0.2] * 3) and origin.tolist() == [0, 0, 0]
    assert tree.background == other.background and len(tree.leaves) == len(other.leaves) > 20
    known = {tuple(place): k for k, place in enumerate(other.leaves)}
    order = [known[tuple(place)] for place in tree.leaves]
    assert np.array_equal(tree.values, other.values[order]) and np.array_equal(tree.active, other.active[order])
    inside = [{(*place, edge) for places, edge, _ in t.inside for place in places.tolist()} for t in (tree, other)]
    assert inside[0] == inside[1] and len(inside[0]) > 0


@pytest.mark.parametrize("bits", [4, 8, 16])
def test_quantised_samples_are_within_half_a_step(bits):
    """A leaf's samples lie between its least and its largest, in 2^bits - 1 equal steps."""
    tree, (other, _, _) = read_level_set(SEVERAL, f"ball{bits}")[0], read_level_set(FILES / "ball.vdb")
    known = {tuple(place): k for k, place in enumerate(other.leaves)}
    for place, values in zip(tree.leaves, tree.values, strict=True):
        want = other.values[known[tuple(place)]]
        assert abs(values - want).max() <= 0.5 * np.ptp(want) / (2**bits - 1) * (1 + 1e-3) + 1e-6
    solid, exact = level_sets.level_set(0, SEVERAL, f"ball{bits}"), level_sets.level_set(0, FILES / "ball.vdb")
    assert solid.bricks == exact.bricks


def changed(name, at, kind, *values):
    data = bytearray((FILES / name).read_bytes())
    struct.pack_into("<" + kind, data, at, *values)
    return bytes(data)


@pytest.mark.parametrize("data, message", [
    (b"", "holds no float grid"), (b"PK\3\4" + bytes(40), "another format's"), (b"NanoVDB0", "ends too early"),
    (changed("ball.nvdb", 8, "I", 29 << 21), "layout is version 29, not 32"),
    (changed("ball.nvdb", 14, "H", 3), "codec is number 3"),
    (changed("ball.nvdb", 16, "Q", 1 << 40), "says it has 1099511627776 bytes"),
    (changed("ball.nvdb", 16 + 32, "I", 9), r"no float grid and ball \(half\) of other kinds"),
    ((FILES / "ball.nvdb").read_bytes()[:3000], "ends too early"),
    (changed("ball.nvdb", 16 + 176 + 5 + 8 + 500, "Q", 77), "compressed data are damaged"),
])  # fmt: skip
def test_damage_is_one_sentence(tmp_path, data, message):
    (tmp_path / "b.nvdb").write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_volume(tmp_path / "b.nvdb")
    assert "b.nvdb" in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_trees_never_escape(tmp_path):
    """Uncompressed, so that counts, offsets and masks themselves are hit, and children that point anywhere."""
    import zlib

    packed = (FILES / "ball.nvdb").read_bytes()
    start = 16 + 176 + 5
    plain = zlib.decompress(packed[start + 8 :])
    head = bytearray(packed[:start])
    struct.pack_into("<H", head, 14, 0)
    struct.pack_into("<Q", head, 24, len(plain))
    (tmp_path / "a.nvdb").write_bytes(head + plain)
    assert np.array_equal(read_level_set(tmp_path / "a.nvdb")[0].values, read_level_set(FILES / "ball.nvdb")[0].values)
    rng = np.random.default_rng(0)
    for k in range(60):
        damaged = bytearray(plain)
        upper = 672 + 64 + 64 + 32  # behind the grid's head, the tree's and the root's
        at = rng.integers(
            *((280, upper), (upper, upper + 8256), (upper + 8256, upper + 270400))[k % 3], size=1 + 400 * (k % 3 == 2)
        )
        for place in at:
            damaged[place] = int(rng.integers(0, 256))
        (tmp_path / "b.nvdb").write_bytes(head + damaged)
        try:
            level_sets.level_set(0, tmp_path / "b.nvdb")
        except InputError as error:
            assert "b.nvdb" in str(error) and "\n" not in str(error)


def nodes(uppers, lowers=0, leaves=0, layout=1):
    """A file of a grid. The root's places share one node of 32^3, the first of its places one of 16^3, the first of that one's
    a leaf; all others are active tiles."""
    at = {"root": 64, "upper": 64 + 64 + 32 * uppers}
    at["lower"] = at["upper"] + 8256 + 8 * 32768
    at["leaf"] = at["lower"] + 1088 + 8 * 4096
    data = bytearray(672 + at["leaf"] + nanovdb.LAYOUTS[layout].leaf)
    data[:8] = b"NanoVDB1"
    struct.pack_into("<9d", data, 296 + 88, *np.eye(3).ravel())
    struct.pack_into("<d", data, 296 + 88 + 168, 1.0)
    struct.pack_into("<Q", data, 672 + 24, at["root"])
    struct.pack_into("<If", data, 672 + 64 + 24, uppers, 0.0)
    for k in range(uppers):
        struct.pack_into("<Qq", data, 672 + 128 + 32 * k, k, at["upper"] - at["root"])
    for node, head, bits, shared, child in (
        ("upper", 8256, 32768, lowers, at["lower"] - at["upper"]), ("lower", 1088, 4096, leaves, at["leaf"] - at["lower"]),
    ):  # fmt: skip
        start = 672 + at[node]
        ones, some = b"\xff" * (bits // 8), np.packbits(np.arange(bits) < shared, bitorder="little").tobytes()
        data[start + 32 : start + 32 + bits // 4] = ones + some
        table = np.zeros(bits, "<i8")
        table[:shared] = child
        data[start + head : start + head + 8 * bits] = table.tobytes()
    meta = bytearray(176)
    struct.pack_into("<QQ", meta, 0, len(data), len(data))
    struct.pack_into("<IIII", meta, 32, layout, 2, 0, 0)
    struct.pack_into("<I", meta, 136, 2)
    return b"NanoVDB0" + struct.pack("<IHH", 32 << 21, 1, 0) + bytes(meta) + b"d\0" + bytes(data)


def named(name, value, **more):
    """A segment with a fog of one value."""
    data = bytearray(nodes(1, **more))
    at = data.index(b"NanoVDB1") - 2  # the name, "d" and its end
    table = at + 2 + 672 + 64 + 64 + 32 + 8256
    data[table : table + 8] = struct.pack("<ff", value, 0)
    active = at + 2 + 672 + 64 + 64 + 32 + 32
    data[active : active + 4096] = b"\1" + bytes(4095)
    struct.pack_into("<I", data, 16 + 136, len(name) + 1)
    return bytes(data[:at]) + name.encode() + b"\0" + bytes(data[at + 2 :])


@pytest.mark.parametrize("names, known", [
    (("density", "density", "heat"), {"density": 1, "density[0]": 1, "density[1]": 2, "heat": 3}),
    (("", ""), {"[0]": 1, "[1]": 2}), (("", "heat"), {"[0]": 1, "heat": 2}),
    (("a", "a", "a[1]"), {"a": 1, "a[0]": 1, "a[1]": 2, "a[1][1]": 3}),
])  # fmt: skip
def test_several_grids_of_one_name_and_grids_without_one(tmp_path, names, known):
    """As of OpenVDB's files."""
    path = tmp_path / "a.nvdb"
    path.write_bytes(b"".join(named(name, k + 1.0) for k, name in enumerate(names)))
    for name, value in known.items():
        assert read_vdb(path, name).values.max() == value, name
    shown = known.keys() - {f"{name}[0]" for name in known}
    assert grid_names(path) == (dict.fromkeys((n for n in known if n in shown), 1), ())


@pytest.mark.parametrize("what, message", [
    ("cut", "ends too early"), ("cut head", "ends too early"), ("size", "says it has 1099511627776 bytes"),
    ("magic", "the bytes where its next segment begins are another"), ("begin", "the grid heat does not begin as one"),
])  # fmt: skip
def test_a_damaged_grid_is_no_harm_to_those_before_it(tmp_path, what, message):
    """Whoever names none gets the density where that is whole; else nobody knows which was meant."""
    path = tmp_path / "a.nvdb"
    whole, heat = [named("first", 1.0), named("density", 2.0)], bytearray(named("heat", 3.0))
    if what.startswith("cut"):
        del heat[60 if what == "cut head" else len(heat) // 2 :]
    elif what == "begin":
        heat[heat.index(b"NanoVDB1") + 7] = 7
    else:
        struct.pack_into("<Q", heat, 16 if what == "size" else 0, 1 << 40)
    path.write_bytes(b"".join(whole) + heat)
    assert read_vdb(path, "first").values.max() == 1 and read_vdb(path).values.max() == 2
    with pytest.raises(InputError, match=message) as caught:
        read_vdb(path, "heat")
    assert "a.nvdb" in str(caught.value) and "\n" not in str(caught.value)
    path.write_bytes(whole[0] + heat)
    if what == "begin":
        assert read_vdb(path).values.max() == 1
    else:
        with pytest.raises(InputError, match=message):
            read_vdb(path)


@pytest.mark.parametrize("given, message", [
    ((3,), "more nodes than there is room for"), ((1, 40), "more nodes than there is room for"),
    ((1, 1, 4096), "more leaves than there is room for"), ((70_000,), "says it has 70000 places"),
])  # fmt: skip
def test_nodes_that_several_places_share_do_not_fill_the_memory(tmp_path, given, message):
    """A file of 300 KB whose places share nodes would have millions of tiles, and billions with three more places."""
    (tmp_path / "b.nvdb").write_bytes(nodes(*given))
    with pytest.raises(InputError, match=message):
        read_vdb(tmp_path / "b.nvdb")


def test_more_than_can_be_used_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    """Samples of 4 bits, and tiles, take many times in memory what they take in a file."""
    (tmp_path / "b.nvdb").write_bytes(nodes(1, 1, 1, layout=13))
    monkeypatch.setattr(vdb_tree, "BLOCKS", 30_000)
    with pytest.raises(InputError, match="more than 30000 active tiles"):
        read_vdb(tmp_path / "b.nvdb")
    monkeypatch.setattr(vdb_tree, "BLOCKS", 20)
    for name, grid in (("several.nvdb", "ball4"), ("ball.nvdb", "ball"), ("ball.vdb", "ball")):
        with pytest.raises(InputError, match=r"it has \d+ leaves, 0.0 GiB of values"):
            read_vdb(FILES / name, grid)
