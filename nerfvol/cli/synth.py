"""``nerfvol synth``: data_synth's own command line; it is a package independent of this one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from nerfvol.cli.command import Command
from nerfvol.errors import InputError


def run(arguments: list[str]) -> int:
    """The exit code of data_synth's command line on ``arguments``; ``--cluster WHERE`` among them is this package's.

    Raises:
        InputError: the engine cannot be reached, or its workers cannot render this.
    """
    from data_synth.cli import main

    argv, where = _without_cluster(arguments)
    if where is None:
        return main(argv) or 0
    return main(argv, _on_cluster(where, argv)) or 0


def _without_cluster(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    argv, where = [], None
    words = iter(arguments)
    for word in words:
        if word == "--cluster":
            where = next(words, "")
        elif word.startswith("--cluster="):
            where = word.partition("=")[2]
        else:
            argv.append(word)
    if where == "":
        raise InputError(
            "--cluster: expected local:N, an address such as tcp://host:8786, or a scheduler file, got nothing"
        )
    return argv, where


def _on_cluster(where: str, argv: list[str]) -> Callable[[Sequence[Any]], Iterable[Any]]:
    """Renders views and parts of views on the workers, in the form that data_synth asks for."""

    def each(pieces: Sequence[Any]) -> Iterable[Any]:
        if not pieces:
            return []
        from nerfvol.cluster.needs import Needs, with_data
        from nerfvol.cluster.share import shared_out
        from nerfvol.cluster.tasks import Job

        words = [word.rpartition("=")[2] for word in argv]
        files = [
            word for word in words if Path(word).is_file()
        ]  # volumes and scene files, which the workers must have too
        here = {word: str(Path(word).resolve()) for word in files}
        resolved = [word if (w := word.rpartition("=")[2]) not in here else word.replace(w, here[w]) for word in argv]
        job = Job("data_synth.cli:render_task", {"argv": resolved}, threads="data_synth.jit:use_threads")
        integrator = next((argv[k + 1] for k, word in enumerate(argv[:-1]) if word == "--integrator"), "")
        probe = f"data_synth.cli:probe?{argv[0]}:{integrator}"
        # Workers may have to compile first.
        needs = Needs((probe,), with_data(list(here.values())), patience=600.0)
        return shared_out(where, job, needs, list(pieces), lambda text: print(text, file=sys.stderr))

    return each


COMMAND = Command(
    summary="Make a synthetic scene with exact ground truth.",
    example="nerfvol synth list\nnerfvol synth showcase --out scene\nnerfvol synth cloud --out cloud --cluster local:2",
    options=None,
    arguments=lambda parser: None,
    run=run,
    place=60,
    passes_on=True,
)
