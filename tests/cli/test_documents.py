"""Every command line that the documents show is one: its options exist and its settings are accepted."""

import re
import shlex
from pathlib import Path

import pytest

from nerfvol.cli.command import assemble_options
from nerfvol.cli.main import _build_parser, commands

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


def test_commands_are_found():
    text = "`nerfvol info`\n```\nnerfvol train --data a \\\n  --out b  # so\nnerfvol view …\nls\n```\n"
    assert command_lines(text) == ["nerfvol train --data a --out b"]
    assert len(LINES) > 30
