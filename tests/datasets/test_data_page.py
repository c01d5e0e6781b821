"""docs/data.md says what the code says: every sentence that it quotes is one that the code can say, every name one it knows."""

import re
from pathlib import Path

import pytest

import nerfvol
from nerfvol.datasets import colmap_files, formats, images

ROOT = Path(nerfvol.__file__).parents[1]
PAGE = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")


def code() -> str:
    """The text of the loaders with strings that are written in pieces joined, values as …"""
    files = [*(ROOT / "nerfvol" / "datasets").glob("*.py"), *(ROOT / "nerfvol" / "cameras").glob("*.py")]
    text = "".join(path.read_text(encoding="utf-8") for path in files)
    text = re.sub(r'"\s*\n\s*f?"', "", text)
    return re.sub(r"\{[^{}\n]*\}", "…", text)


QUOTED = [words for sentence in re.findall(r'"([^"\n]*…[^"\n]*)"', PAGE[PAGE.index("## What is said") : PAGE.index("## Speed")])
          for words in re.split(r"…|\b[NM]\b|WxH|\(cx, cy\)", sentence) if len(words.split()) >= 2]  # fmt: skip


@pytest.mark.parametrize("words", QUOTED)
def test_a_sentence_on_the_page_is_one_of_the_codes(words):
    assert words.strip(" :,") in code()


def test_every_format_lens_and_program_is_on_the_page():
    for row in formats.FORMATS:
        assert all(word in PAGE for word in row.name.split(", ")), row.name
    for name in (*colmap_files._MODELS, *images.FORMATS):
        assert name in PAGE, name
    for name, whose in formats._OTHER_PROGRAMS.items():
        assert all(word in PAGE for word in re.findall(r"\b([A-Z0-9][\w-]+)'", whose)), (name, whose)
