"""MetaImage, NRRD and NIfTI files, written here from the descriptions of the formats; damage; transfer functions."""

import gzip
import struct
import zlib

import numpy as np
import pytest

from data_synth import InputError, media, scenes
from data_synth.cli import main
from data_synth.volumes import read_volume

V = (np.arange(2 * 3 * 4).reshape(2, 3, 4) * 40 - 400).astype(np.int16)
BYTES = V.transpose(2, 1, 0).astype("<i2").tobytes()  # x fastest
SWAPPED = V.transpose(2, 1, 0).astype(">i2").tobytes()


def nifti(order="<", slope=1.0, shift=0.0, dims=(3, 2, 3, 4, 1, 1, 1, 1), code=4):
    head = bytearray(352)
    struct.pack_into(order + "i", head, 0, 348)
    struct.pack_into(order + "8h", head, 40, *dims)
    struct.pack_into(order + "hh", head, 70, code, 16)
    struct.pack_into(order + "8f", head, 76, -1, 0.5, -0.7, 2, 0, 0, 0, 0)
    struct.pack_into(order + "3f", head, 108, 352, slope, shift)
    head[344:348] = b"n+1\0"
    return bytes(head) + (BYTES if order == "<" else SWAPPED)


MHD = "ObjectType = Image\nNDims = 3\nDimSize = 2 3 4\nElementType = MET_SHORT\nElementSpacing = 0.5 0.7 2\n"
NRRD = "NRRD0004\n# a comment\ntype: short\ndimension: 3\nsizes: 2 3 4\n"
TURNED = "endian: big\nencoding: gzip\nspace directions: (0,0.5,0) (0.7,0,0) (0,0,-2)\n\n"
FILES = {
    "a.mhd": {"a.mhd": (MHD + "ElementDataFile = a.raw\n").encode(), "a.raw": BYTES},
    "z.mhd": {
        "z.mhd": (MHD + "CompressedData = True\nElementDataFile = /far/away/z.zraw").encode(), "z.zraw": zlib.compress(BYTES),
    },
    "m.mha": {"m.mha": (MHD + "ElementByteOrderMSB = True\nElementDataFile = LOCAL\n").encode() + SWAPPED},
    "r.nrrd": {"r.nrrd": (NRRD + "endian: little\nencoding: raw\nspacings: 0.5 0.7 2\n\n").encode() + BYTES},
    "g.nrrd": {"g.nrrd": (NRRD + TURNED).encode() + gzip.compress(SWAPPED)},
    "d.nrrd": {
        "d.nrrd": (NRRD + "endian: little\nencoding: raw\nspacings: 0.5 0.7 2\ndata file: d.bin\n").encode(), "d.bin": BYTES,
    },
    "n.nii": {"n.nii": nifti()},
    "b.nii.gz": {"b.nii.gz": gzip.compress(nifti(">", dims=(4, 2, 3, 4, 1, 1, 1, 1)))},
}  # fmt: skip


def put(folder, name):
    for each, data in FILES[name].items():
        (folder / each).write_bytes(data)
    return folder / name


@pytest.mark.parametrize("name", FILES)
def test_samples_and_spacing(tmp_path, name):
    values, spacing = read_volume(put(tmp_path, name))
    assert np.array_equal(values, V) and np.allclose(spacing, (0.5, 0.7, 2.0))


def test_scaled_nifti(tmp_path):
    (tmp_path / "s.nii").write_bytes(nifti(slope=0.5, shift=3.0))
    assert np.allclose(read_volume(tmp_path / "s.nii")[0], 0.5 * V + 3.0)


@pytest.mark.parametrize("name", FILES)
def test_damage_is_an_input_error(tmp_path, name):
    path, rng = put(tmp_path, name), np.random.default_rng(0)
    good = path.read_bytes()
    for k in range(150):
        damaged = bytearray(good[: int(rng.integers(len(good)))] if k % 3 == 0 else good)
        for _ in range(k % 4):
            if damaged:
                damaged[int(rng.integers(len(damaged)))] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            values, _ = read_volume(path)
            assert values.size <= 24
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("name, old, new, message", [
    ("a.mhd", b"2 3 4", b"20000 30000 40000", "at most"), ("a.mhd", b"2 3 4", b"2 3", "3 dimensions"),
    ("a.mhd", b"2 3 4", b"2 3 5", "expected 60 bytes"), ("a.mhd", b"MET_SHORT", b"MET_LONG", "MET_LONG"),
    ("r.nrrd", b"encoding: raw", b"encoding: hex", "raw or gzip"), ("r.nrrd", b"NRRD", b"NRDD", "begins with NRRD"),
    ("r.nrrd", b"0.5 0.7 2", b"0.5 0.7 0", "three positive"), ("n.nii", b"n+1", b"ni1", "NIfTI-1"),
])  # fmt: skip
def test_what_is_wrong_is_said(tmp_path, name, old, new, message):
    path = put(tmp_path, name)
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(InputError, match=message):
        read_volume(path)


def test_transfer_functions_are_in_the_volume_s_own_values(tmp_path):
    """Values -400 to 520 in Hounsfield-like units; bone above 200 is opaque and white, the rest is not there."""
    path = put(tmp_path, "n.nii")
    (tmp_path / "t.txt").write_text("# value opacity r g b\n-400 0 1 0 0\n200 0 1 0 0\n240 1 1 1 1\n520 1 1 1 1\n")
    scene = scenes.make("phantom", volume=str(path), transfer=str(tmp_path / "t.txt"), density=10.0)
    assert np.allclose(media.dense(scene.medium), np.clip((V - 200) / 40, 0, 1), atol=1e-6)
    shown = scenes.make("phantom", volume=str(path), transfer=str(tmp_path / "t.txt"), mode="emission")
    assert np.array_equal(shown.medium.Le, scene.medium.albedo) and not shown.medium.albedo.any()
    assert shown.integrators[0] == "emission"


@pytest.mark.parametrize("text, message", [
    ("1 2 3\n", "two or more"), ("0 0 1 1 1\n0 1 1 1 1\n", "ascending"), ("0 0 1 1 1\n1 2 1 1 1\n", r"in \[0, 1\]"),
    ("a b\n", "lines of value"), ("", "two or more"),
])  # fmt: skip
def test_bad_transfer_functions(tmp_path, text, message, capsys):
    (tmp_path / "t.txt").write_text(text)
    path = put(tmp_path, "n.nii")
    with pytest.raises(InputError, match=message):
        scenes.make("phantom", volume=str(path), transfer=str(tmp_path / "t.txt"))
    argv = ["phantom", "--volume", str(path), "--set", f"transfer={tmp_path / 't.txt'}", "--out", str(tmp_path / "o")]
    assert main(argv) == 2 and capsys.readouterr().err.count("\n") == 1
    assert main(["phantom", "--set", "transfer=none.txt", "--out", str(tmp_path / "o")]) == 2


def test_nibabel_writes_what_is_read(tmp_path):
    nib = pytest.importorskip("nibabel", reason="nibabel is not installed: pip install nibabel")
    data = np.random.default_rng(0).normal(size=(5, 6, 7)).astype(np.float32)
    nib.save(nib.Nifti1Image(data, np.diag([1.0, 2.0, 3.0, 1.0])), tmp_path / "n.nii.gz")
    values, spacing = read_volume(tmp_path / "n.nii.gz")
    assert np.array_equal(values, data) and np.allclose(spacing, (1, 2, 3))
