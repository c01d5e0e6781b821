"""LPIPS by a package that may be missing; here a stand-in with its interface."""

import builtins
import sys
import types

import numpy as np
import pytest
import torch

from nerfvol.errors import InputError
from nerfvol.measure.perceptual import load_lpips


class Stub(torch.nn.Module):
    """As lpips.LPIPS: images (1, 3, h, w), with ``normalize`` in [0, 1]; the mean absolute difference."""

    def __init__(self, net="alex", verbose=True):
        super().__init__()
        assert net == "vgg"
        print("Setting up [LPIPS] perceptual loss")

    def forward(self, a, b, normalize=False):
        assert normalize and a.shape == b.shape and a.shape[:2] == (1, 3) and a.dtype == torch.float32
        assert not torch.is_grad_enabled() and not self.training
        return (a - b).abs().mean().reshape(1, 1, 1, 1)


@pytest.fixture
def stub(monkeypatch):
    package = types.ModuleType("lpips")
    package.LPIPS = Stub
    monkeypatch.setitem(sys.modules, "lpips", package)
    return package


def test_images_of_numpy_go_to_the_network(stub, capsys):
    distance = load_lpips()
    image = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    assert distance(image, image) == 0
    assert distance(np.clip(image, 0, 0.5) + 0.25, np.clip(image, 0, 0.5)) == pytest.approx(0.25, abs=1e-6)
    assert capsys.readouterr().out == ""
    for wrong in (image[:20], image[:, :, :1], image[0]):
        with pytest.raises(InputError, match="at least 32x32"):
            distance(wrong, wrong)
    with pytest.raises(InputError, match="of one size"):
        distance(image, image[:-1])


def test_without_the_package_or_its_weights(monkeypatch, stub):
    def refuse(*_, **__):
        raise OSError("no route to host\nmore")

    stub.LPIPS = refuse
    with pytest.raises(InputError, match="vgg network cannot be loaded: no route to host$"):
        load_lpips()
    real = builtins.__import__

    def without(name, *rest):
        if name == "lpips":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install 'nerfvol\[lpips\]'"):
        load_lpips()


def test_eval_reports_it(tmp_path, command, tiny_scene, stub):
    import json

    from nerfvol.splats.ply import save_ply
    from tests.splats.scenes import random_splats

    save_ply(tmp_path / "g.ply", random_splats(30, 4, 0))
    more = ("--data", tiny_scene, "--json", tmp_path / "s.json")
    code, out, err = command("eval", tmp_path / "g.ply", *more, "--lpips")
    assert code == 0 and "LPIPS 0." in out and "(vgg)" in out, err
    record = json.loads((tmp_path / "s.json").read_text())
    assert record["lpips"] == pytest.approx(np.mean([row["lpips"] for row in record["rows"]]))
    assert command("eval", tmp_path / "g.ply", *more)[0] == 0
    assert "lpips" not in json.loads((tmp_path / "s.json").read_text())
