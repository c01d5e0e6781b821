"""``nerfvol synth``: data_synth's own command line; it is a package independent of this one."""

from __future__ import annotations

from nerfvol.cli.command import Command


def run(arguments: list[str]) -> int:
    """The exit code of data_synth's command line on ``arguments``."""
    from data_synth.cli import main

    return main(arguments) or 0


COMMAND = Command(
    summary="Make a synthetic scene with exact ground truth.",
    example="nerfvol synth list\nnerfvol synth showcase --out scene",
    options=None,
    arguments=lambda parser: None,
    run=run,
    place=60,
    passes_on=True,
)
