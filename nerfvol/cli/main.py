"""The ``nerfvol`` command: parse, call, and say in one sentence what was wrong.

Exit codes: 0 done, 2 bad input (message on stderr, no traceback), 130 interrupted after saving. Heavy modules are
imported inside the command that needs them, so that help and mistakes answer at once.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import cast

import nerfvol.cli
from nerfvol import __version__
from nerfvol.cli.command import LAYERED, Command, Parser, assemble_options
from nerfvol.cli.terminal import Screen, screens
from nerfvol.errors import InputError

_DESCRIPTION = """\
From posed photographs to a radiance field, and pictures of it, on an ordinary CPU.

  nerfvol synth showcase --out scene                      make a scene to try it on
  nerfvol train --data scene --out run                    train on it (--time-budget 60s: in a minute)
  nerfvol eval run --data scene --split test              score it on views it has not seen
  nerfvol render run --orbit 120 --out orbit.mp4          fly around it
"""
_EPILOG = "`nerfvol COMMAND --help` explains a command. Exit codes: 0 done, 2 bad input, 130 interrupted (saved)."


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: that of the process) and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    return guard(lambda: _dispatch(arguments))


def guard(run: Callable[[], int]) -> int:
    """The exit code of ``run``; what the user has to put right is said in one sentence instead of a traceback."""
    # Of damaged EXIF and the like, which decides nothing: with a line of Pillow's source they are no sentence.
    warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")
    with screens():
        return _guarded(run)


def _guarded(run: Callable[[], int]) -> int:
    try:
        code = run()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("nerfvol: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader (head, a pager) has gone.
        cast(Screen, sys.stdout).silence()
        return 141
    except Exception as error:
        sentence = _sentence(error)
        if sentence is None:
            raise
        print(f"nerfvol: error: {sentence}", file=sys.stderr)
        return 2


def _sentence(error: Exception) -> str | None:
    """What to tell the user, or None where ``error`` is a defect of the program and the traceback is wanted."""
    synth = sys.modules.get(
        "data_synth.errors"
    )  # where it was not loaded it was not raised, and loading it takes a second
    if isinstance(error, InputError) or (synth is not None and isinstance(error, synth.InputError)):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return "the machine's memory is used up; try smaller pictures (--downscale, --size)"
    if isinstance(error, OSError):
        from nerfvol.files.atomic import explain_os_error

        return f"{error.filename or 'input or output'}: {explain_os_error(error)}"
    return None


def commands() -> dict[str, Command]:
    """The commands by name, in the order in which they are listed: every file of this package that has a COMMAND."""
    names = [module.name for module in pkgutil.iter_modules(nerfvol.cli.__path__) if not module.name.startswith("_")]
    modules = {name: importlib.import_module(f"nerfvol.cli.{name}") for name in names}
    found = {name: module.COMMAND for name, module in modules.items() if hasattr(module, "COMMAND")}
    return dict(sorted(found.items(), key=lambda item: (item[1].place, item[0])))


def _dispatch(arguments: list[str]) -> int:
    known = commands()
    if arguments and arguments[0] in known and known[arguments[0]].passes_on:
        return known[arguments[0]].run(arguments[1:]) or 0
    parser, parsers = _build_parser(known)
    if not arguments:
        parser.print_help()
        return 0
    try:
        given, leftovers = parser.parse_known_args(arguments)
    except SystemExit as stop:  # --help and --version print and stop
        return int(stop.code or 0)
    parsers[given.command].check_leftovers(leftovers)
    options = vars(given)
    command = known[options.pop("command")]
    return command.run(options if command.options is None else assemble_options(command.options, options))


def _build_parser(known: dict[str, Command]) -> tuple[Parser, dict[str, Parser]]:
    raw = argparse.RawDescriptionHelpFormatter
    parser = Parser(prog="nerfvol", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=raw, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"nerfvol {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    parsers = {}
    for name, command in known.items():
        examples = "\n".join(f"  {line}" for line in command.example.splitlines())
        # Only options that were given appear in the result: what is absent comes from the config file or the default.
        sub = subparsers.add_parser(
            name, help=command.summary, description=command.summary, epilog=f"For example:\n{examples}\n\n{LAYERED}",
            formatter_class=raw, allow_abbrev=False, argument_default=argparse.SUPPRESS,
        )  # fmt: skip
        command.arguments(sub)
        parsers[name] = sub
    return parser, parsers


if __name__ == "__main__":
    sys.exit(main())
