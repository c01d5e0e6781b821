"""What a job asks of a machine, and the fingerprint by which machines are told apart. Imports no engine."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerfvol import __version__

PATIENCE = 60.0
"""Seconds to wait for a worker that is fit."""


@dataclass(frozen=True)
class Needs:
    """What a job asks of a machine. probes: "module:function" or "module:function?argument", that return bytes.

    data: files and folders that must be there as they are here; room: bytes that its cache may take; patience: seconds to wait
    for a worker that is fit.
    """

    probes: tuple[str, ...] = ("nerfvol.cluster.probe:pictures",)
    data: tuple[tuple[str, str], ...] = ()
    room: int = 0
    patience: float = PATIENCE


def fingerprint(needs: Needs) -> str:
    """16 hex digits of the version and of what the probes give here."""
    return _fingerprint(needs.probes)


@functools.cache
def _fingerprint(probes: tuple[str, ...]) -> str:
    """Found once: a copy of this process (nerfvol.cluster.copies) draws as it does, and is not asked again."""
    from nerfvol.cluster.tasks import named

    digest = hashlib.sha256(__version__.encode())
    for probe in probes:
        name, _, argument = probe.partition("?")
        digest.update(hashlib.sha256(named(name)(*([argument] if argument else []))).digest())
    return digest.hexdigest()[:16]


def description() -> str:
    """What draws here, for a person."""
    import PIL

    from nerfvol.kernels import ops

    return f"nerfvol {__version__} with {ops.isa()} kernels and Pillow {PIL.__version__}"


def listing(folder: str | Path) -> str:
    """A hash of the names and sizes of the files in ``folder``, at any depth, or of a file; "" where there is no such thing."""
    root = Path(folder)
    if root.is_file():
        return hashlib.sha256(root.read_bytes()).hexdigest()
    if not root.is_dir():
        return ""
    rows = sorted(
        f"{path.relative_to(root).as_posix()} {path.stat().st_size}" for path in root.rglob("*") if path.is_file()
    )
    return hashlib.sha256("\n".join(rows).encode()).hexdigest()


def with_data(folders: Sequence[str | Path]) -> tuple[tuple[str, str], ...]:
    """What Needs.data takes of ``folders``."""
    return tuple((str(Path(folder).resolve()), listing(folder)) for folder in folders)
