"""The snippets of docs/data_synth.md run as they stand, and name all that is public."""

import re
from pathlib import Path

import pytest

import data_synth

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "data_synth.md").read_text()


def test_snippets_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    snippets = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    assert len(snippets) >= 3
    for snippet in snippets:
        exec(compile(snippet, "docs/data_synth.md", "exec"), names)
    assert (tmp_path / "mine" / "transforms_train.json").exists() and (tmp_path / "mine" / "truth.npz").exists()
    assert names["T"].shape == (100, 3) and names["picture"].variance.shape == (16, 16, 3)


def test_what_is_public_is_there_and_in_the_page():
    for name in data_synth.__all__:
        assert hasattr(data_synth, name), name
    modules = [name for name in data_synth.__all__ if type(getattr(data_synth, name)).__name__ == "module"]
    for name in modules:
        assert f"ds.{name}." in PAGE, name


@pytest.mark.parametrize("name", data_synth.scenes.SCENES)
def test_the_table_of_scenes_says_every_parameter_with_its_default_and_every_integrator(name):
    row = re.search(rf"^\| {name} \| (.*?) \| (.*?) \|", PAGE, re.M)
    assert row is not None
    parameters = data_synth.scenes.parameters_of(name)
    said = dict(pair.split("=") for pair in re.findall(r"`(\w+=[^`]+)`", row[2]))
    assert said == {key: str(default) for key, default in parameters.items()}
    few = {"resolution": 16} if "resolution" in parameters else {}
    assert row[1] == ", ".join(data_synth.scenes.make(name, **few).integrators)


def test_tests_and_modules_that_the_page_names_are_there():
    tests = "".join(path.read_text() for path in ROOT.glob("tests/**/*.py"))
    files = {path.name for path in ROOT.glob("tests/**/*.py")} | {path.name for path in ROOT.glob("data_synth/*.py")}
    files |= {path.name for path in ROOT.glob("tools/*.py")}
    for name in set(re.findall(r"`(test_\w+)`", PAGE)):
        assert f"def {name}(" in tests, name
    for name in set(re.findall(r"`(\w+\.py)`", PAGE)):
        assert name in files, name
