"""Exported SPZ files, unpacked by the format's document; without the library a sentence says what to install."""

import builtins
import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.kernels.splat_ops import render_splats
from nerfvol.splats.splats import Splats
from nerfvol.splats.spz import load_spz, save_spz
from nerfvol.views import SplatModel
from tests.splats.scenes import random_splats, view_of_cube


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
    turned = (splats.means + splats.origin) * (1, -1, -1)  # right, up, backwards
    assert np.abs(fixed / 2.0**bits - turned).max() <= 2.0**-bits
    opacity = np.frombuffer(data, np.uint8, n, 16 + 9 * n) / 255
    assert np.abs(opacity - 1 / (1 + np.exp(-splats.logits))).max() <= 1.01 / 255


@pytest.mark.parametrize("degree", [1, 3])
def test_the_format_s_axes_are_half_a_turn_from_those_of_a_ply(tmp_path, degree):
    """The library's own reader finds the scene turned about x: seen by a camera that is turned too, it is the same."""
    gsply = pytest.importorskip("gsply")
    splats, view = random_splats(60, (degree + 1) ** 2, 2), view_of_cube()
    save_spz(tmp_path / "s.spz", splats)
    data = gsply.read_spz(tmp_path / "s.spz")
    sh = np.concatenate([data.sh0[:, :, None], data.shN.transpose(0, 2, 1)], axis=2)
    read = Splats(data.means, data.scales, data.quats, data.opacities.reshape(-1), sh, np.zeros(3), "mip")
    turn = np.diag([1.0, -1.0, -1.0])
    seen_by = replace(view, rotation=view.rotation @ turn, translation=view.translation - view.rotation @ splats.origin)
    a, b = render_splats(splats, view), render_splats(read, seen_by)
    again = load_spz(tmp_path / "s.spz")
    c = render_splats(again, replace(view, translation=view.translation - view.rotation @ splats.origin))
    assert np.abs(a["rgb"] - b["rgb"]).mean() < 0.01 and np.abs(b["rgb"] - c["rgb"]).max() < 1e-4


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
