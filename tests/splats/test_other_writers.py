"""Files of SuperSplat (.compressed.ply) and of the first viewers in browsers (.splat), made here byte by byte from what their
formats say: read to the last bit, and refused in a sentence where they are wrong."""

import math
import struct

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.models import load_model
from nerfvol.splats.ply import is_splat_ply, load_ply
from nerfvol.splats.rows32 import load_splat
from tests.splats.test_ply import columns_of, make_splats, same, write_table
from tests.splats.written import ENDS, WORDS, compressed, unit_chunk


@pytest.mark.parametrize("word, parts", [
    (0, (0, 0, 0)), (0xFFFFFFFF, (1, 1, 1)), (1 << 21, (1 / 2047, 0, 0)), (0x7FF << 21, (1, 0, 0)),
    (1 << 11, (0, 1 / 1023, 0)), (0x3FF << 11, (0, 1, 0)), (1, (0, 0, 1 / 2047)), (0x7FF, (0, 0, 1)),
    (1 << 31, (1024 / 2047, 0, 0)), (1 << 20, (0, 512 / 1023, 0)), (1 << 10, (0, 0, 1024 / 2047)),
])  # fmt: skip
def test_eleven_ten_and_eleven_bits_of_positions_and_scales(tmp_path, word, parts):
    splats = load_ply(compressed(tmp_path / "a.ply", [unit_chunk()], [(word, 0, word, 0)]))
    np.testing.assert_allclose(splats.means[0], parts, rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales[0], np.array(parts) - 1.0, atol=1e-7)


def packed_rotation(quat):
    """The word of a quaternion w, x, y, z."""
    quat = np.array(quat) / np.linalg.norm(quat)
    largest = int(np.abs(quat).argmax())
    quat, word = quat * np.sign(quat[largest]), largest
    for k in range(4):
        if k != largest:
            word = word << 10 | round((quat[k] * math.sqrt(0.5) + 0.5) * 1023)
    return word


@pytest.mark.parametrize("quat", [
    (0.9, 0.1, -0.3, 0.2), (0.1, 0.9, -0.3, 0.2), (0.2, -0.1, 0.8, 0.3), (-0.3, 0.2, 0.1, 0.7), (-0.9, 0.1, 0.3, -0.2),
    (0.1, 0.3, -0.9, 0.2), (1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (0, 0, 1, 1),
])  # fmt: skip
def test_the_three_smaller_entries_of_a_rotation(tmp_path, quat):
    """Half of a step of 10 bits over sqrt(2) for each of three entries, and what the fourth makes of them."""
    splats = load_ply(compressed(tmp_path / "a.ply", [unit_chunk()], [(0, packed_rotation(quat), 0, 0)]))
    found, wanted = splats.quats[0].astype(float), np.array(quat) / np.linalg.norm(quat)
    step = math.sqrt(2) / 1023 / 2
    assert abs(np.linalg.norm(found) - 1) < 1e-6
    assert np.abs(found * np.sign(found @ wanted) - wanted).max() <= 3 * step + 1e-6


def test_bytes_of_colours_and_opacity(tmp_path):
    rows = [(0, 0, 0, 0x336699CC), (0, 0, 0, 0xFF0000FF), (0, 0, 0, 0)]
    for colours, ends in ((True, (-1.0, 3.0)), (False, (0.0, 1.0))):
        splats = load_ply(compressed(tmp_path / "a.ply", [unit_chunk(colours)], rows))
        wanted = ends[0] + (ends[1] - ends[0]) * np.array([[0.2, 0.4, 0.6], [1, 0, 0], [0, 0, 0]])
        np.testing.assert_allclose(0.5 + 0.28209479177387814 * splats.sh[:, :, 0], wanted, atol=1e-6)
        np.testing.assert_allclose(1 / (1 + np.exp(-splats.logits.astype(float))), [0.8, 1, 0], atol=1e-6)
        assert splats.sh_degree == 0 and splats.mode == "plain" and np.isfinite(splats.logits).all()


@pytest.mark.parametrize("kind", ["little", "big"])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_are_bytes_channel_by_channel(tmp_path, degree, kind):
    """Both ways round, and what writers lose: half of a 256th of 8."""
    rng, k = np.random.default_rng(degree), (degree + 1) ** 2 - 1
    sh = rng.uniform(-3.9, 3.9, (3, 3, k))
    codes = np.floor((sh / 8 + 0.5) * 256).astype(int).reshape(3, -1).tolist()
    splats = load_ply(compressed(tmp_path / "a.ply", [unit_chunk()], [(0, 0, 0, 0)] * 3, codes, kind=kind))
    assert splats.sh.shape == (3, 3, k + 1)
    assert np.abs(splats.sh[:, :, 1:] - sh).max() <= 8 / 256 / 2 + 1e-6


def test_the_first_and_last_byte_of_harmonics_are_the_ends(tmp_path):
    """Writers put there what is beyond, and the format's own reader takes them for -4 and 4."""
    splats = load_ply(
        compressed(tmp_path / "a.ply", [unit_chunk()], [(0, 0, 0, 0)], [[0, 255, 1, 254, 127, 128, 0, 0, 0]])
    )
    np.testing.assert_array_equal(splats.sh[0, :2, 1:], [[-4, 4, -3.953125], [3.953125, -0.015625, 0.015625]])


def test_every_256_gaussians_have_their_chunk(tmp_path):
    chunks = [[i, 10.0 * i, -i, *[i + 1, 10.0 * i, -i + 2.0], *[-5.0] * 6, *[0.0] * 3, *[1.0] * 3] for i in range(3)]
    rows = [(0xFFFFFFFF if k % 2 else 0, 0, 0, 0x80) for k in range(600)]
    path = compressed(tmp_path / "a.ply", chunks, rows, comments=("SplatRenderMode: mip", "nerfvol origin: 1 2 3"))
    splats, k = load_ply(path), np.arange(600)
    chunk, odd = k // 256, k % 2
    np.testing.assert_allclose(splats.means, np.stack([chunk + odd, 10 * chunk, -chunk + 2 * odd], 1), atol=1e-6)
    assert splats.mode == "mip" and splats.origin.tolist() == [1, 2, 3] and (splats.log_scales == -5).all()
    assert is_splat_ply(path) and load_model(path).kind == "splats"


def test_another_reader_finds_the_same(tmp_path):
    gsply = pytest.importorskip("gsply")
    rng = np.random.default_rng(0)
    rows = [tuple(int(v) for v in rng.integers(0, 1 << 32, 4)) for _ in range(700)]
    # No rotation whose three smaller entries are longer than 1 can be written.
    rows = [(p, packed_rotation(rng.normal(size=4)), s, c) for p, _, s, c in rows]
    chunks = [np.sort(rng.normal(size=(2, 9)), 0)[:, [0, 1, 2, 3, 4, 5, 6, 7, 8]] for _ in range(3)]
    chunks = [[*c[0, :3], *c[1, :3], *c[0, 3:6], *c[1, 3:6], *c[0, 6:], *c[1, 6:]] for c in chunks]
    codes = rng.integers(0, 256, (700, 45)).tolist()
    path = compressed(tmp_path / "a.ply", chunks, rows, codes)
    ours, theirs = load_ply(path), gsply.plyread(path)
    np.testing.assert_allclose(ours.means, theirs.means, atol=2e-6)
    np.testing.assert_allclose(ours.log_scales, theirs.scales, atol=2e-6)
    np.testing.assert_allclose(ours.quats, theirs.quats, atol=2e-6)
    np.testing.assert_allclose(ours.sh[:, :, 0], np.reshape(theirs.sh0, (-1, 3)), atol=2e-5)
    seen = np.abs(ours.logits) < 9  # the other one ends at 10
    np.testing.assert_allclose(ours.logits[seen], np.reshape(theirs.opacities, -1)[seen], atol=1e-4)


@pytest.mark.parametrize("damage, words", [
    ({"chunks": [unit_chunk()], "rows": [(0, 0, 0, 0)] * 257}, "257 packed Gaussians need 2 chunks, it has 1"),
    ({"chunks": [unit_chunk()[:9]], "rows": [(0, 0, 0, 0)]}, "element 'chunk' has no property 'max_scale_x'"),
    ({"chunks": [unit_chunk()[:15]], "rows": [(0, 0, 0, 0)]}, "element 'chunk' has no property 'max_r'"),
    ({"chunks": [unit_chunk()], "rows": [(0, 0, 0, 0)], "words": [*WORDS[:3], "colour"]}, "no property 'packed_color'"),
    ({"chunks": [unit_chunk()], "rows": [(0, 0, 0, 0)], "sh": [[0] * 8]}, "1 rows of 8 numbers, expected 1 of 9, 24 or 45"),
    ({"chunks": [unit_chunk()], "rows": [(0, 0, 0, 0)], "sh": [[0] * 9] * 2}, "2 rows of 9 numbers, expected 1 of"),
    ({"chunks": [[math.nan] * 18], "rows": [(0, 0, 0, 0)]}, "a scale of vertex 0"),
    ({"chunks": [[math.inf] * 6 + [0.0] * 12], "rows": [(0, 0, 0, 0)]}, "the position of vertex 0 is not finite"),
])  # fmt: skip
def test_packed_files_that_cannot_be_used(tmp_path, damage, words):
    with pytest.raises(InputError, match=words) as caught:
        load_ply(compressed(tmp_path / "bad.ply", **damage))
    assert "bad.ply" in str(caught.value) and "\n" not in str(caught.value)


def test_packed_files_that_end_early_or_lack_their_chunks(tmp_path):
    path = compressed(tmp_path / "bad.ply", [unit_chunk()], [(0, 0, 0, 0)] * 9, [[0] * 9] * 9)
    whole = path.read_bytes()
    for cut, words in ((1, "9 rows of 'sh'"), (9 * 9 + 1, "9 vertices"), (9 * 25 + 1, "1 rows of 'chunk'")):
        path.write_bytes(whole[:-cut])
        with pytest.raises(InputError, match=f"declares {words}|declares 9 vertices"):
            load_ply(path)
    path.write_bytes(whole.replace(b"element chunk", b"element lumps"))
    with pytest.raises(InputError, match="no element 'chunk'"):
        load_ply(path)


@pytest.mark.parametrize("old, new, words", [
    (b"uint packed_color", b"int packed_color", "'packed_color' should be uint32, it is int32"),
    (b"float max_scale_z", b"uint max_scale_z", "'max_scale_z' should be float32, it is uint32"),
    (b"uchar f_rest_8", b"char f_rest_8", "'f_rest_8' should be uint8, it is int8"),
    (b"uchar f_rest_8", b"uchar f_more_8", "element 'sh' has no property 'f_rest_8'"),
])  # fmt: skip
def test_packed_numbers_of_another_type_or_name(tmp_path, old, new, words):
    """Of the same length, so that nothing else tells."""
    path = compressed(tmp_path / "bad.ply", [unit_chunk()], [(0, 0, 0, 0)], [[0] * 9])
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(InputError, match=rf"bad\.ply.*{words}"):
        load_ply(path)


def test_a_packed_file_whose_chunks_have_a_list(tmp_path):
    """Behind the vertices, where its rows need not be passed over."""
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    head += b"".join(b"property uint %s\n" % word.encode() for word in WORDS)
    (tmp_path / "bad.ply").write_bytes(
        head + b"element chunk 1\nproperty list uchar float more\n"
        + b"".join(b"property float %s\n" % name.encode() for name in ENDS) + b"end_header\n" + bytes(200)
    )  # fmt: skip
    with pytest.raises(InputError, match="its element 'chunk' has a list"):
        load_ply(tmp_path / "bad.ply")


def test_elements_before_the_vertices_are_passed_over(tmp_path):
    """Rows of numbers have a length; cameras of some programs come first."""
    splats = make_splats()
    for kind in ("binary_little_endian", "ascii"):
        before = "element camera 2\nproperty float f\nproperty uchar id"
        path = write_table(tmp_path / "a.ply", columns_of(splats), kind=kind, before=before)
        head, body = path.read_bytes().split(b"end_header\n", 1)
        rows = b"1.5 1\n2.5 2\n" if kind == "ascii" else struct.pack("<fBfB", 1.5, 1, 2.5, 2)
        path.write_bytes(head + b"end_header\n" + rows + body)
        same(load_ply(path), splats)


# ------------------------------------------------------------------ .splat
def test_rows_of_32_bytes(tmp_path):
    rows = [struct.pack("<6f8B", 1.5, -2.5, 1e3, 0.5, 2.0, 0.0, 51, 102, 153, 204, 255, 128, 128, 128),
            struct.pack("<6f8B", 0, 0, 0, 1, 1, 1, 255, 0, 0, 255, 128, 218, 38, 128),
            struct.pack("<6f8B", 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 128, 128, 128, 128)]  # fmt: skip
    (tmp_path / "a.splat").write_bytes(b"".join(rows))
    splats = load_splat(tmp_path / "a.splat")
    np.testing.assert_array_equal(splats.means[0], [1.5, -2.5, 1e3])
    np.testing.assert_allclose(np.exp(splats.log_scales[0].astype(float)), [0.5, 2.0, 0.0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * splats.sh[0, :, 0], [0.2, 0.4, 0.6], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.logits.astype(float))), [0.8, 1, 0], atol=1e-6)
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(unit, [[1, 0, 0, 0], [0, 0.5**0.5, -(0.5**0.5), 0], [1, 0, 0, 0]], atol=1e-6)
    assert load_model(tmp_path / "a.splat").kind == "splats"


@pytest.mark.parametrize("row, words", [
    (bytes(33), "33 bytes are no multiple of the 32"), (b"", "holds no Gaussians"),
    (struct.pack("<6f8B", math.nan, 0, 0, 1, 1, 1, *[255] * 8), "position of vertex 0"),
    (struct.pack("<6f8B", 0, 0, 0, 1, -1, 1, *[255] * 8), "scale of vertex 0 is negative"),
    (struct.pack("<6f8B", 0, 0, 0, 1, math.nan, 1, *[255] * 8), "scale of vertex 0"),
])  # fmt: skip
def test_rows_that_cannot_be_used(tmp_path, row, words):
    (tmp_path / "bad.splat").write_bytes(row)
    with pytest.raises(InputError, match=words) as caught:
        load_model(tmp_path / "bad.splat")
    assert "bad.splat" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".ksplat", ".sog", ".lcc", ".splatv"])
def test_what_is_not_read_says_what_to_export(tmp_path, suffix):
    (tmp_path / f"scene{suffix}").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=rf"scene\{suffix} holds .* does not read: export it as \.ply") as caught:
        load_model(tmp_path / f"scene{suffix}")
    assert ("splat-transform" in str(caught.value)) == (suffix != ".splatv")  # which it cannot read
