"""Who may work: machines whose pictures are the same to the last byte, who see the data and have room on their disk.

Processors are told apart by what they draw, not by their names: AVX-512 and AVX2 give the same bits, the baseline does not.
A worker that is fit gets a resource named by its fingerprint, and every task asks for it; others are named with the reason.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from distributed import WorkerPlugin

from nerfvol import __version__
from nerfvol.cluster.ship import cache_folder
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, Worker

TOPIC = "nerfvol"
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
    from nerfvol.cluster.tasks import named

    digest = hashlib.sha256(__version__.encode())
    for probe in needs.probes:
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


class Fit(WorkerPlugin):
    """Gives present and later workers the resource ``resource`` where they are fit, else says why they are not."""

    def __init__(self, needs: Needs, expected: str) -> None:
        self.needs, self.expected, self.client = needs, expected, description()
        asked = hashlib.sha256(repr(needs).encode()).hexdigest()
        self.name = self.resource = f"nerfvol-{expected}-{asked[:6]}"

    async def setup(self, worker: Worker) -> None:
        """Never raises: a worker whose plugin raises would go on taking tasks."""
        try:
            reason = self.reason()
        except Exception as error:  # whatever is wrong over there, its name says more than silence
            reason = f"{type(error).__name__}: {error}"
        if reason:
            worker.log_event(TOPIC, {"resource": self.resource, "worker": worker.address, "reason": reason})
        else:
            await worker.set_resources(**{self.resource: 1})

    def reason(self) -> str:
        """Why this machine must not work, or nothing."""
        if fingerprint(self.needs) != self.expected:
            return f"{description()} draws other pictures than the client's {self.client}"
        for folder, contents in self.needs.data:
            here = listing(folder)
            if here != contents:
                return f"{folder} is not there" if not here else f"{folder} is another one there"
        folder = cache_folder()
        free = shutil.disk_usage(folder).free
        if free < self.needs.room:
            return f"{free / 1e6:.0f} MB are free at {folder}, {self.needs.room / 1e6:.0f} MB are needed"
        return ""


def welcome(client: Client, needs: Needs) -> tuple[str, list[str]]:
    """The resource that tasks ask for, once a worker is fit, and a sentence for each worker that is not.

    Raises:
        InputError: nobody is after ``needs.patience`` seconds; the sentence names the workers and what is wrong with them.
    """
    plugin = Fit(needs, fingerprint(needs))
    patience = needs.patience
    deadline = time.monotonic() + patience
    strangers: dict[str, str] = {}
    while True:
        try:
            client.register_plugin(plugin)
            break
        except OSError as error:  # a worker died before it answered, or is frozen and was given up
            if time.monotonic() > deadline:
                raise InputError(f"--cluster: its workers do not answer ({error})") from error
        except Exception:  # one of them knows no such plugin; the others have it
            strangers = _strangers(client)
            break
    while True:
        workers = client.scheduler_info(n_workers=-1)["workers"]
        fit = [address for address, worker in workers.items() if worker["resources"].get(plugin.resource)]
        refused = strangers | _refused(client, plugin.resource, workers)
        if fit and len(fit) + len(refused) >= len(workers):
            return plugin.resource, [f"{address} does not work on this: {why}" for address, why in refused.items()]
        if time.monotonic() > deadline:
            if fit:
                return plugin.resource, []
            reasons = "; ".join(f"{address}: {why}" for address, why in refused.items()) or "there is no worker"
            raise InputError(f"--cluster: no worker is fit after {patience:.0f} s ({reasons})")
        time.sleep(0.05)


def _strangers(client: Client) -> dict[str, str]:
    """Workers on which this package, or one like it, is not installed, with the reason."""
    answers = cast("dict[str, Any]", client.run(description, on_error="return"))
    return {
        address: f"nerfvol cannot be used there ({type(answer).__name__}: {answer})"
        for address, answer in answers.items()
        if isinstance(answer, BaseException)
    }


def _refused(client: Client, resource: str, workers: dict[str, Any]) -> dict[str, str]:
    found = {}
    for _, event in cast("tuple[tuple[float, Any], ...]", client.get_events(TOPIC)):
        if isinstance(event, dict) and event.get("resource") == resource and event.get("worker") in workers:
            found[event["worker"]] = str(event.get("reason"))
    return found


def fit_workers(client: Client, resource: str) -> list[str]:
    """Addresses of the workers that may take tasks now."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    return [address for address, worker in workers.items() if worker["resources"].get(resource)]
