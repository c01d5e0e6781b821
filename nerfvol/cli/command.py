"""What a command of ``nerfvol`` is, and what all of them share: options from a config file, threads, one parser."""

from __future__ import annotations

import argparse
import difflib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from nerfvol.config.assemble import assemble, parse_assignment, read_yaml
from nerfvol.errors import InputError, shown

LAYERED = "Any option can stand in a YAML file given with --config (time_budget: 2m); the command line wins over it."

POSED = "after a fit of each view's pose, for training moved its cameras too: PSNR {:.2f} dB, SSIM {:.4f}"
FITTED = "after a colour map fitted to each view (exposure and white balance differ): PSNR {:.2f} dB, SSIM {:.4f}"


@dataclass(frozen=True)
class Command:
    """One command. A file of this package that has a ``COMMAND`` is one, by the file's name.

    summary: one sentence. example: a command line or more that work as they stand. options: the dataclass that the command
    line and config files fill. arguments: adds the options to a parser. run: does it; the exit code. place: in the list of
    commands, small numbers first. passes_on: ``run`` takes the bare arguments instead, because it has a parser of its own.
    """

    summary: str
    example: str
    options: Any
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[Any], int]
    place: int = 100
    passes_on: bool = False


class Parser(argparse.ArgumentParser):
    """argparse whose complaints end in one sentence, with a near option for a mistyped one."""

    def error(self, message: str) -> NoReturn:
        """Raises InputError with ``message``, where argparse would print it and end the process."""
        raise InputError(f"{message} (see `{self.prog} --help`)")

    def check_leftovers(self, leftovers: Sequence[str]) -> None:
        """Refuse what no option took."""
        if not leftovers:
            return
        word = leftovers[0].split("=")[0]
        known = [option for action in self._actions for option in action.option_strings]
        close = difflib.get_close_matches(word, known, n=1) if word.startswith("-") else []
        hint = f"; did you mean {close[0]}?" if close else ""
        self.error(f"unknown argument {word!r}{hint}")


def assemble_options(cls: Any, given: dict[str, Any], base: tuple[dict[str, Any], str] | None = None) -> Any:
    """Defaults < ``base`` < the file of --config < the options given < --set."""
    layers = [base] if base else []
    path = given.pop("config", None)
    if path is not None:
        layers.append((read_yaml(path), str(path)))
    assignments = given.pop("set", [])
    layers.append((given, "command line"))
    layers.extend((parse_assignment(text), "--set") for text in assignments)
    return assemble(cls, *layers)


def need(command: str, **values: Any) -> None:
    """An InputError for the first of ``values`` that is not given, by its name."""
    for name, value in values.items():
        if value in (None, ""):
            what = "RUN|FILE" if name == "target" else f"--{name.replace('_', '-')}"
            raise InputError(f"nerfvol {command} needs {what} (see `nerfvol {command} --help`)")


def add_target(p: argparse.ArgumentParser) -> None:
    """RUN|FILE, --config and --threads, which the commands on a model share."""
    p.add_argument("target", metavar="RUN|FILE", nargs="?", help="model file, or a run folder that holds one")
    p.add_argument("--config", metavar="FILE", help="YAML file of this command's options")
    p.add_argument("--threads", metavar="N", help="CPU threads (default: all)")


def add_drawing(p: argparse.ArgumentParser) -> None:
    """How pictures are drawn."""
    p.add_argument("--background", metavar="COLOUR", help="white, black or R,G,B (default: that of the training)")
    p.add_argument("--early-stop-eps", metavar="T", help="stop a ray at this transmittance; 0: exact (default: 1/255)")
    p.add_argument("--lod", metavar="PIXELS", help="draw what is smaller as one cell; 0: every leaf (default: 0.8)")


def set_threads(threads: int) -> int:
    """Use ``threads`` CPU threads (0: every core this process may use) in torch and the kernels; returns the number.

    Raises:
        InputError: fewer than 0, or more than make sense.
    """
    from nerfvol.config.training import MOST_THREADS
    from nerfvol.machine import usable_cores

    if not 0 <= threads <= MOST_THREADS:
        raise InputError(f"--threads must be from 0 (all cores) to {MOST_THREADS}, got {shown(threads)}")
    count = threads or usable_cores()
    from nerfvol.kernels import ops

    ops.set_threads(count)
    return count


def prepare_outputs(folder: str | None = None, file: str | None = None) -> None:
    """Make the folders that a command will write to, before it spends time on what it writes; what killed writers left there
    goes."""
    from nerfvol.files.atomic import ensure_writable_folder, is_special, remove_leftovers

    if folder is not None:
        remove_leftovers(ensure_writable_folder(folder))
    if file is not None and not is_special(file):
        remove_leftovers(ensure_writable_folder(Path(os.path.realpath(file)).parent))
