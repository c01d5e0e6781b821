"""Runs the engine in a process of its own, follows its progress, and stops it on Ctrl-C."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json, write_json
from nerfvol.poses.engine import RESULT, Job

LOG = "colmap.log"
SHARES = {"frames": (0.0, 0.12), "features": (0.12, 0.45), "matching": (0.45, 0.75), "mapping": (0.75, 1.0)}
"""Of the time, about: a bar over all steps must not jump back."""


def require_pycolmap() -> None:
    """InputError with what to install where structure from motion is not there."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            "poses from photographs need COLMAP's library: pip install 'nerfvol[poses]' (or run COLMAP yourself and give "
            "nerfvol train its folder)"
        )


class Progress:
    """One bar over all steps, with the time left; silent where the output is no terminal."""

    def __init__(self, on_share: Callable[[str, float], object] | None = None) -> None:
        shape = "{desc} {percentage:3.0f}% |{bar:20}| {elapsed}<{remaining}"
        self._bar = tqdm(total=1.0, bar_format=shape, disable=None if on_share is None else True)
        self._share, self._on_share = 0.0, on_share

    def at(self, step: str, done: float, of: float) -> None:
        """``done`` of ``of`` things of a step are done."""
        low, high = SHARES[step.split()[-1]]
        share = max(self._share, low + (high - low) * min(1.0, done / max(of, 1)))
        self._bar.set_description_str(f"{step} {done:.0f}/{of:.0f}", refresh=False)
        self._bar.update(share - self._share)
        self._share = share
        if self._on_share is not None:
            self._on_share(step, share)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *failure: object) -> None:
        self._bar.close()


def run_engine(job: Job, progress: Progress) -> dict[str, Any]:
    """What :func:`nerfvol.poses.engine.run` returns, made by a child process whose messages go to ``work/colmap.log``.

    Raises:
        InputError: the library failed; the sentence has its last complaint and the log's name.
        KeyboardInterrupt: Ctrl-C, after the child was stopped. What it had done is kept.
    """
    work = Path(job.work)
    write_json(work / "job.json", asdict(job))
    (work / RESULT).unlink(missing_ok=True)
    log = work / LOG
    with log.open("wb") as complaints:
        command = [sys.executable, "-m", "nerfvol.poses.engine", str(work / "job.json")]
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints)
        assert child.stdout is not None
        try:
            for line in child.stdout:
                with contextlib.suppress(ValueError, TypeError, KeyError):  # the library may print a line of its own
                    message = json.loads(line)
                    progress.at(message["step"], message["done"], message["of"])
            code = child.wait()
        finally:
            if child.poll() is None:
                child.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(5)
                child.kill()
                child.wait()
            child.stdout.close()
    if code or not (work / RESULT).is_file():
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
        last = lines[-1].split("] ", 1)[-1] if lines else f"exit code {code}"
        raise InputError(f"structure from motion stopped: {last:.200} (all it said: {log})")
    return read_json(work / RESULT)
