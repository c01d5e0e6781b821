"""Exported SPZ files, unpacked by the format's document; without the library a sentence says what to install."""

import builtins
import gzip
import struct

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.views import SplatModel
from tests.splats.scenes import random_splats


@pytest.mark.parametrize("mode", ["plain", "mip"])
def test_the_file_by_its_document(tmp_path, mode):
    pytest.importorskip("gsply")
    splats = random_splats(50, 4, 1, mode)
    export_model(SplatModel(splats), tmp_path / "s.spz")
    data = gzip.decompress((tmp_path / "s.spz").read_bytes())
    magic, version, n, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", data)
    assert (magic, version, n, degree, flags & 1) == (b"NGSP", 3, 50, 1, int(mode == "mip"))
    raw = np.frombuffer(data, np.uint8, 9 * n, 16).reshape(n, 3, 3).astype(np.int32)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    fixed -= (fixed >> 23) << 24
    assert np.abs(fixed / 2.0**bits - (splats.means + splats.origin)).max() <= 2.0**-bits
    opacity = np.frombuffer(data, np.uint8, n, 16 + 9 * n) / 255
    assert np.abs(opacity - 1 / (1 + np.exp(-splats.logits))).max() <= 1.01 / 255


def test_without_the_library(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *rest):
        if name == "gsply":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match="need the library gsply"):
        export_model(SplatModel(random_splats(3, 1, 0)), tmp_path / "s.spz")
    assert not list(tmp_path.iterdir())
