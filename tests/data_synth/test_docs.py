"""The snippets of docs/data_synth.md run as they stand, and name all that is public."""

import re
from pathlib import Path

import data_synth

PAGE = (Path(__file__).parents[2] / "docs" / "data_synth.md").read_text()


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
