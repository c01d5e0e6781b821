"""Who may work: machines whose pictures are the same to the last byte, who see the data and have room on their disk.

Processors are told apart by what they draw, not by their names: AVX-512 and AVX2 give the same bits, the baseline does not.
A worker that is fit gets a resource named by its fingerprint, and every task asks for it; others are named with the reason.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from typing import TYPE_CHECKING, Any, cast

from distributed import WorkerPlugin

from nerfvol.cluster.needs import Needs, description, fingerprint, listing
from nerfvol.cluster.ship import cache_folder
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, Worker

TOPIC = "nerfvol"


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
            # Waited for, as the resource is: whoever sees that this worker answered sees what it said.
            event = {"resource": self.resource, "worker": worker.address, "reason": reason}
            await worker.scheduler.log_event(topic=TOPIC, msg=event)
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
        is_over = time.monotonic() > deadline  # before it is looked: what came in time is seen
        workers = client.scheduler_info(n_workers=-1)["workers"]
        fit = [address for address, worker in workers.items() if worker["resources"].get(plugin.resource)]
        refused = strangers | _refused(client, plugin.resource, workers)
        if fit and (is_over or len(fit) + len(refused) >= len(workers)):
            return plugin.resource, [f"{address} does not work on this: {why}" for address, why in refused.items()]
        if is_over:
            reasons = "; ".join(f"{address}: {why}" for address, why in refused.items()) or "there is no worker"
            raise InputError(f"--cluster: no worker is fit after {patience:.0f} s ({reasons})")
        time.sleep(0.05)


def _strangers(client: Client) -> dict[str, str]:
    """Workers on which this package, or one like it, is not installed, with the reason."""
    answers = cast("dict[str, Any]", client.run(description, on_error="return"))
    return {
        address: f"nerfvol cannot be used there ({answer})"  # the engine hands on an exception's repr in one of its own
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
