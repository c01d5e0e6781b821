"""Few photographs: what may be expected of them is said before a run, and only then."""

from types import SimpleNamespace

import pytest

from nerfvol.datasets import load
from nerfvol.training.few_views import OBJECTS, PHOTOGRAPHS, few_views
from tools import starts


@pytest.mark.parametrize("n,photographs,said", [
    (3, True, "22.6 dB from 3"), (11, True, "28.0 dB from 12"), (12, True, None), (4, False, "25.6 dB from 8"),
    (16, False, "28.1 dB from 16"), (17, False, None), (100, True, None),
])  # fmt: skip
def test_what_few_views_let_expect(n, photographs, said):
    sentence = few_views(n, photographs)
    assert sentence is None if said is None else sentence.startswith(f"{n} training views are few") and said in sentence
    known = list((PHOTOGRAPHS if photographs else OBJECTS).values())
    assert known == sorted(known)


def test_few_of_photographs_leave_the_lists_of_their_data_alone(tmp_path, monkeypatch):
    """A link to a list, written through, would be the data's own."""
    data = tmp_path / "data"
    data.mkdir()
    for name in ("train.txt", "val.txt", "a.jpg"):
        (data / name).write_text("a\nb\nc")
    names = {"train": ["a", "b", "c"], "val": ["d"]}
    monkeypatch.setattr(load, "load_dataset", lambda path, split: SimpleNamespace(names=names[split]))
    for _ in range(2):
        folder = starts.subset(data, tmp_path / "out", 2)
        assert [(folder / f"{split}.txt").read_text() for split in ("train", "val")] == ["a\nc", "d"]
        assert {(data / name).read_text() for name in ("train.txt", "val.txt")} == {"a\nb\nc"}
        assert (folder / "a.jpg").is_symlink()
