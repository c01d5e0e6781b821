"""Text that must not steer a terminal, and streams that are closed, narrow or gone."""

import io
import os
import subprocess
import sys

import pytest

from nerfvol.cli.terminal import Screen
from nerfvol.errors import printable, shown


@pytest.mark.parametrize("text, expected", [
    ("plain 16³ ö 日本 😀\n\t", "plain 16³ ö 日本 😀\n\t"), ("\x1b]0;title\x07", "\\x1b]0;title\\x07"), ("a\x9bb", "a\\x9bb"),
    ("half \ud800", "half \\ud800"), ("gpj.\u202egnp", "gpj.\\u202egnp"), ("\x7f\x00", "\\x7f\\x00"),
])  # fmt: skip
def test_what_steers_a_terminal_is_shown_as_text(text, expected):
    assert printable(text) == expected


def test_what_came_stays_short():
    assert len(shown(["x" * 1000] * 1000)) < 600 and "thousands of digits" in shown(10**5000)


def test_a_narrow_stream_gets_escapes():
    raw = io.BytesIO()
    screen = Screen(io.TextIOWrapper(raw, encoding="ascii"))
    screen.write("16³ \ud800\x1b[2J")
    screen.flush()
    assert raw.getvalue() == rb"16\xb3 \ud800\x1b[2J"


class Gone(io.StringIO):
    def write(self, text):
        raise BrokenPipeError

    def fileno(self):
        raise OSError


def test_a_reader_that_goes_ends_only_what_is_not_to_go_on():
    screen = Screen(Gone())
    with pytest.raises(BrokenPipeError):
        screen.write("a")
    screen.goes_on = True
    assert screen.write("a") == 1


@pytest.mark.skipif(os.name != "posix", reason="shells of other systems")
@pytest.mark.parametrize("words", ["info >&-", "info 2>&-", "info nosuch 2>&-"])
def test_closed_streams_cost_no_traceback(words):
    code = "from nerfvol.cli.main import main; import sys; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(["sh", "-c", f'"$0" -c "$1" {words}', sys.executable, code], capture_output=True, text=True)
    assert done.returncode == (2 if "nosuch" in words else 0) and "Traceback" not in done.stderr


def test_an_unknown_instruction_set_is_a_sentence():
    code = "from nerfvol.cli.main import main; import sys; sys.exit(main(['info']))"
    environment = {**os.environ, "NERFVOL_ISA": "nosuch"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and "NERFVOL_ISA" in done.stderr and "Traceback" not in done.stderr
