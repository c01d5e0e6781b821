"""Damaged .ply, .splat and .spz files are refused in one sentence or read, and never cost more than they hold."""

import gzip
import struct

import numpy as np
import pytest

from nerfvol.splats.spz import save_spz
from tests.splats.fuzz import damaged, sources, verdict, verdicts
from tests.splats.scenes import random_splats

HEADER = struct.Struct("<4sIIBBBB")


@pytest.mark.parametrize("name", [
    "splats.ply", "points.ply", "text.ply", "packed.ply", "rows.splat", "3.spz", "4.spz", "inside.spz",
])  # fmt: skip
def test_any_damage_is_a_sentence_or_a_model(tmp_path, name):
    if name.endswith(".spz"):
        pytest.importorskip("gsply")
    if name == "4.spz":
        pytest.importorskip("zstandard")
    said = list(verdicts(name, tmp_path, 120, 0))
    assert len(set(said)) > 5  # the damage is not always the same


def test_the_damage_goes_by_the_seed(tmp_path):
    _, good, _ = sources(tmp_path)["splats.ply"]
    a, b, c = (damaged(good, np.random.default_rng([0, k])) for k in (1, 1, 2))
    assert a == b != c and a != good


def spz(version=3, count=5, degree=0, body=b"", magic=b"NGSP") -> bytes:
    return gzip.compress(HEADER.pack(magic, version, count, degree, 12, 0, 0) + body)


BAD = {
    "empty": (b"", "no header"),
    "zeros": (bytes(200), "does not start like"),
    "magic": (spz(magic=b"NGSQ"), "does not start like"),
    "newer": (spz(version=7), "of version 7, versions 1 to 4 are known"),
    "degree": (spz(degree=9), "degree 9, expected 0 to 3"),
    "count": (spz(count=2**32 - 1), "declares 4294967295 Gaussians"),
    "cut": (spz(count=40, body=bytes(100)), "should unpack to 816 bytes, and ends after 116"),
    "gzip": (spz(count=2, body=bytes(40))[:-20] + bytes(20), "not a usable .spz file"),
    "bomb": (spz(count=1, body=bytes(1 << 24)), "should unpack to 36 bytes, and goes on"),
    "second.bomb": (spz(count=1, body=bytes(20)) + gzip.compress(bytes(1 << 24)), "goes on for"),
    "table": (struct.pack("<4sIIBBBBI", b"NGSP", 4, 3, 0, 12, 0, 5, 1 << 30), "within its table of contents"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_spz_files_that_lie(tmp_path, name):
    pytest.importorskip("gsply")
    if name == "table":
        pytest.importorskip("zstandard")
    data, words = BAD[name]
    (tmp_path / "x.spz").write_bytes(data)
    assert words in verdict(tmp_path / "x.spz")


def test_a_stream_that_unpacks_to_more_than_it_should(tmp_path):
    pytest.importorskip("gsply")
    zstandard = pytest.importorskip("zstandard")
    save_spz(tmp_path / "x.spz", random_splats(4, 1, 0), 4)
    data = bytearray((tmp_path / "x.spz").read_bytes())
    table_at = struct.unpack_from("<I", data, 16)[0]
    streams = data[15]
    *_, last = struct.iter_unpack("<QQ", bytes(data[table_at : table_at + 16 * streams]))
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 28))
    data[len(data) - last[0] :] = bomb
    struct.pack_into("<Q", data, table_at + 16 * (streams - 1), len(bomb))
    (tmp_path / "x.spz").write_bytes(data)
    assert f"it states {1 << 28}" in verdict(tmp_path / "x.spz")
