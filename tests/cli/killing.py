"""Runs a command and kills it, for test_killed.py: python killing.py SEED FIRST FOLDER COMMAND... [--then COMMAND...]

In the commands OUT is a folder: once FOLDER/whole, which is left in peace, then two more, and further ones as long as none was
killed, where the command gets SIGKILL or SIGTERM at random moments, three times each at most, and is begun again until it ends
by itself; the second command is taken once there is OUT/FIRST. Prints how often it was killed. Children are forked, so that
importing costs its seconds once.
"""

import os
import random
import signal
import sys
import time
import traceback
from pathlib import Path

import data_synth.cli  # noqa: F401  # what the commands import
import nerfvol.measure.scores
import nerfvol.training.train  # noqa: F401
from nerfvol.cli.main import main

SIGNALS = (signal.SIGKILL, signal.SIGTERM)


def attempt(command: str, after: float | None, number: int, said: str | os.PathLike[str] | None = None) -> int:
    """The command's exit code, negative where a signal ended it; it is sent ``number`` ``after`` so many seconds.

    Its errors are written to the file ``said``; by default they go where this process's go.
    """
    child = os.fork()
    if child == 0:
        code = 70  # as of a fault within a program
        try:
            quiet = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1):
                os.dup2(quiet, stream)
            if said is not None:
                os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666), 2)
            code = main(command.split())
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)  # whatever came: a child that went on would tidy up what is its parent's
    deadline = None if after is None else time.monotonic() + after
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if deadline is not None and time.monotonic() >= deadline:
            os.kill(child, number)
            deadline = None
        time.sleep(0.002)


def run() -> None:
    seed, first, folder, *argv = sys.argv[1:]
    rng = random.Random(seed)
    begin, _, resume = " ".join(argv).partition(" --then ")
    began = time.monotonic()
    if attempt(begin.replace("OUT", f"{folder}/whole"), None, 0):
        sys.exit("the command does not end well even undisturbed")
    seconds, killed, k = time.monotonic() - began, 0, 0
    while k < 2 or not killed:  # a first run on a busy machine says little of how long the others take
        k += 1
        out = f"{folder}/killed_{k}"
        for left in (3, 2, 1, 0):
            command = resume if resume and Path(out, first).exists() else begin
            after = rng.uniform(0, 1.5 * seconds / left) if left else None
            if attempt(command.replace("OUT", out), after, rng.choice(SIGNALS)) == 0:
                break
            killed += 1
        else:
            sys.exit(f"{command} does not end")
        seconds /= 1 if killed else 2
    print(killed)


if __name__ == "__main__":
    run()
