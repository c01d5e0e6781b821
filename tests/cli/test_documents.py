"""Every command line that the documents show is one: its options exist and its settings are accepted."""

import json
import re
import shlex
from pathlib import Path

import pytest

from nerfvol.cli.command import assemble_options
from nerfvol.cli.main import _build_parser, commands
from tests.fixtures.runs import TINY

ROOT = Path(__file__).resolve().parents[2]
DATED = ("experiments.md",)
"""What was typed on a day, and may have another name now."""
PAGES = [path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if path.name not in DATED]
SHORT = re.compile(r"[…\[\]|<>$]|\.\.\.|\bCOMMAND\b")
"""Of what stands for something else."""


def command_lines(text: str) -> list[str]:
    """Those in fences that begin with nerfvol."""
    fences = re.findall(r"^```(?:sh|bash)?\n(.*?)^```", text, re.M | re.S)
    lines = [line for fence in fences for line in re.sub(r"\s*\\\n\s*", " ", fence).splitlines()]
    found = [re.split(r"\s+#|\s+&&|\s*;", line.removeprefix("$ "))[0] for line in lines]
    return [line for line in found if re.match(r"nerfvol [a-z]+ ", line) and not SHORT.search(line)]


LINES = [
    pytest.param(line, id=f"{p.name}-{line[8:60]}")
    for p in PAGES
    for line in dict.fromkeys(command_lines(p.read_text()))
]


@pytest.mark.parametrize("line", LINES)
def test_a_command_of_the_documents_is_one(line):
    known = commands()
    arguments = shlex.split(line)[1:]
    assert arguments[0] in known
    if known[arguments[0]].passes_on:
        return  # a program with tests of its own
    parser, parsers = _build_parser(known)
    given, leftovers = parser.parse_known_args(arguments)
    parsers[given.command].check_leftovers(leftovers)
    options = vars(given)
    command = known[options.pop("command")]
    if command.options is not None and "config" not in options:
        assemble_options(command.options, options)


def test_the_first_commands_run_one_after_the_other(command, tiny_scene, tmp_path, monkeypatch):
    """Those of the README as they stand there, but for ten steps and three pictures; the viewer has tests of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").symlink_to(tiny_scene, target_is_directory=True)
    few = {"steps": 10, "levels": [4], "downscales": [2], "stage_ends": [1.0], "tiles": [16], "prunes": [1]}
    (tmp_path / "few.yaml").write_text(json.dumps({**TINY, "octree": few, "checkpoint_every": 100}))
    lines = command_lines((ROOT / "README.md").read_text())
    assert [line.split()[1] for line in lines[:7]] == ["train", "eval", "render", "export", "export", "view", "info"]
    for line in (*lines[:5], lines[6]):
        line = line.replace("--time-budget 2m", "--init direct --config few.yaml").replace("--orbit 120", "--orbit 3")
        code, _, err = command(*shlex.split(line)[1:])
        assert code == 0, f"{line}: {err}"
    for written in re.findall(r"--out (\S+)", "\n".join(lines[:7])):
        assert (tmp_path / written).stat().st_size > 0, written


def test_commands_are_found():
    text = "`nerfvol info`\n```\nnerfvol train --data a \\\n  --out b  # so\nnerfvol view …\nls\n```\n"
    assert command_lines(text) == ["nerfvol train --data a --out b"]
    assert len(LINES) > 30
