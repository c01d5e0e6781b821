"""``import nerfvol``: the names a notebook needs, loaded when they are asked for; and ``train`` as a function."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import nerfvol
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.octree.io import load_octree

SOURCE = Path(nerfvol.__file__)
FEW = {"levels": [3, 4], "downscales": [2, 1], "stage_ends": [0.5, 1.0], "tiles": [8, 8], "prunes": [1, 1], "steps": 12}
"""Sections of a run of no length."""


def test_import_loads_nothing_else():
    code = "import sys; before = set(sys.modules); import nerfvol; print(*(set(sys.modules) - before))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=SOURCE.parents[1], capture_output=True, text=True, check=True
    )
    heavy = {"numpy", "torch", "numba", "PIL", "yaml", "tqdm", "imageio", "data_synth"}
    assert not [name for name in loaded.stdout.split() if name.split(".")[0] in heavy or name.startswith("nerfvol.")]


@pytest.mark.parametrize("name", nerfvol.__all__)
def test_every_name_is_the_one_of_its_module(name):
    value = getattr(nerfvol, name)
    if name in nerfvol._HOMES:
        assert value is getattr(importlib.import_module(f"nerfvol.{nerfvol._HOMES[name]}"), name)
    assert value.__doc__ and name in dir(nerfvol)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'nerfvol' has no attribute 'octopus'"):
        _ = nerfvol.octopus
    assert not hasattr(nerfvol, "octopus")


def test_type_checkers_see_the_same_names():
    """The imports under TYPE_CHECKING, the names loaded on demand and ``__all__`` are one list."""
    body = ast.parse(SOURCE.read_text()).body
    block = next(node for node in body if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING")
    seen = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if node.module.startswith("nerfvol")
    }
    assert seen == {name: f"nerfvol.{home}" for name, home in nerfvol._HOMES.items()}
    assert sorted([*seen, "train"], key=str.lower) == sorted(nerfvol.__all__, key=str.lower)


# ---------------------------------------------------------------- train
def test_train_by_keywords(tiny_scene, tmp_path):
    run = nerfvol.train(data=tiny_scene, out=tmp_path / "run", init="direct", octree=FEW, storage="float32")
    octree, metadata = load_octree(run / "octree.safetensors")
    assert run == tmp_path / "run" and octree.n_leaves > 0
    assert metadata["provenance"]["steps"] == {"octree": 12}


def test_train_by_a_config_which_stays_as_it_is(tiny_scene, tmp_path):
    config, before = (Config(data=str(tiny_scene), out=str(tmp_path / "a"), init="direct", seed=3) for _ in range(2))
    run = nerfvol.train(config, out=tmp_path / "b", octree=FEW)
    assert run == tmp_path / "b" and config == before
    assert "seed: 3" in (run / "config.yaml").read_text()


def test_train_goes_on_with_the_settings_of_its_run(tiny_scene, tmp_path, capsys):
    run = nerfvol.train(data=tiny_scene, out=tmp_path / "run", init="direct", octree=FEW)
    assert nerfvol.train(out=run, resume=True) == run
    assert "nothing to resume" in capsys.readouterr().out


@pytest.mark.parametrize("settings, reason", [
    ({}, "train needs 'data'"),
    ({"data": "x"}, "train needs 'out'"),
    ({"data": "x", "out": "y", "time_buget": 3}, "did you mean 'time_budget'"),
    ({"data": "x", "out": "y", "octree": {"steps": 0}}, "octree.steps: expected a number of at least 1, got 0"),
    ({"data": "nowhere", "out": "y"}, "no such folder"),
    ({"out": "nowhere", "resume": True}, "nothing to resume"),
])  # fmt: skip
def test_train_refuses_in_a_sentence(tmp_path, monkeypatch, settings, reason):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=reason):
        nerfvol.train(**settings)
    assert not list(tmp_path.iterdir())
