"""A job's results in the order of its items, with a bounded number of them on their way."""

from __future__ import annotations

import asyncio
import contextlib
import math
import statistics
import time
import uuid
from collections.abc import Coroutine, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED
from concurrent.futures import Future as Fetch
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from nerfvol.cluster import ship
from nerfvol.cluster.copies import Ahead
from nerfvol.cluster.fit import fit_workers, welcome
from nerfvol.cluster.needs import Needs
from nerfvol.cluster.tasks import Done, Job, Missing, run
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, Future

TASKS_A_WORKER = 3
"""On their way at once: one that runs, one that waits there, one whose result travels."""
TASK_SECONDS, LAST_SECONDS = 0.8, 0.1
"""A task takes at least about this long, so that its 5-10 ms of scheduling do not count; the last ones less, so that all
workers end at one time."""
MOST_BETWEEN_LOOKS = 3.0
"""Seconds: what is more between two looks for workers is no waiting for them."""
PATIENCE_FACTOR, LEAST_PATIENCE = 5.0, 10.0
ATTEMPTS = 5


@dataclass
class _Task:
    """Items first...last-1 given out; future: the engine's, None for what a copy of this process does ahead of it;
    attempts: which try this is."""

    first: int
    last: int
    future: Future | None
    started: float
    attempts: int


class Window:
    """Runs a job on a client's workers. ``messages``: sentences on workers that take no part.

    patience: seconds of looking, without anybody who is fit, after which it is given up. repeat_late: items that take five
    times as long as others are given out once more; not where two may not write one folder.
    """

    def __init__(self, client: Client, job: Job, needs: Needs, repeat_late: bool = True) -> None:
        self.client, self.job, self.repeat_late = client, job, repeat_late
        self.resource, self.messages = welcome(client, needs)
        self._id = uuid.uuid4().hex[:8]
        self._times: list[float] = []
        self._fit: list[str] = []
        self._known: set[str] = set()
        self._look = math.inf
        self.patience, self._alone = needs.patience, 0.0
        self._silent: set[str] = set()
        self._asked = -math.inf
        self._tasks: dict[Fetch[Any], _Task] = {}

    def results(self, items: Sequence[Any], ahead: Ahead | None = None) -> Generator[Any]:
        """The function's result for each of ``items``, in their order; ``ahead`` has begun with the first of them.

        Raises:
            InputError: the engine is gone or has nobody who is fit any more, or a task fails wherever it is tried.
        """
        ready: dict[int, Done] = {}
        submitted, yielded = 0 if ahead is None else self._taken_over(ahead), 0
        self._known.update(self._workers())
        try:
            while yielded < len(items):
                while (
                    submitted < len(items)
                    and submitted - yielded < TASKS_A_WORKER * len(self._workers()) * self._group()
                ):
                    last = submitted + self._next_group(len(items) - submitted)
                    self._submit(items, submitted, last)
                    submitted = last
                for first, done in self._finished(items):
                    if first >= yielded:
                        ready[first] = done
                        self._forget_tries_of(first)
                self._repeat_what_found_nobody(items)
                self._repeat_a_late_one(items, yielded)
                while yielded in ready:
                    results = ready.pop(yielded).results
                    yielded += len(results)
                    yield from results
        finally:
            for fetch, task in self._tasks.items():
                self._release(fetch, task)
            self._tasks.clear()

    def _workers(self) -> list[str]:
        """Addresses that may take tasks, asked of the scheduler once a second; without the silent ones, if others are left."""
        now = time.monotonic()
        if now - self._asked > 1.0:
            try:
                self._fit = fit_workers(self.client, self.resource)
            except (KeyError, OSError, ValueError) as error:
                raise self._gone() from error
            # While this process was stopped, or nobody asked for results, nobody waited.
            self._alone = 0.0 if self._fit else self._alone + min(now - self._asked, MOST_BETWEEN_LOOKS)
            self._asked = time.monotonic()
            if self._alone > self.patience:
                raise InputError(
                    f"--cluster: no worker has been fit for {self.patience:.0f} s; what was written stays, and the same "
                    "command goes on from there"
                )
        return [address for address in self._fit if address not in self._silent] or self._fit or [""]

    def _group(self, seconds: float = TASK_SECONDS) -> int:
        """Items of a task that takes so long."""
        if not self._times:
            return 1
        least = max(seconds, 0.005 * len(self._workers()))
        return max(1, min(64, round(least / max(statistics.median(self._times[-50:]), 1e-4))))

    def _next_group(self, left: int) -> int:
        """Items of the next task where so many are left."""
        share = max(left // (TASKS_A_WORKER * len(self._workers())), self._group(LAST_SECONDS))
        return min(self._group(), share, left)

    def _taken_over(self, ahead: Ahead) -> int:
        """How many items are not given out, for a copy of this process has made them or is about to."""
        count, fetch = ahead.stop()
        if count:
            self._tasks[fetch] = _Task(0, count, None, time.monotonic(), 1)
        return count

    def _submit(self, items: Sequence[Any], first: int, last: int, attempts: int = 1) -> None:
        key = f"nerfvol-{self._id}-{first}-{attempts}-{uuid.uuid4().hex[:4]}"
        where = {"workers": self._workers(), "allow_other_workers": True} if self._silent else {}
        try:
            future = self.client.submit(
                run, self.job, list(items[first:last]), self.resource,
                key=key, resources={self.resource: 1}, retries=3, pure=False, **where,
            )  # fmt: skip
        except Exception as error:
            raise self._gone() from error
        self._tasks[self._fetch(future)] = _Task(first, last, future, time.monotonic(), attempts)

    def _fetch(self, future: Future) -> Fetch[Any]:
        """Each result is fetched for itself: one that lies on a frozen worker does not hold up the others."""
        loop = cast(Any, self.client.loop).asyncio_loop
        gathering = cast(Coroutine[Any, Any, Any], self.client.gather([future], asynchronous=True))
        return asyncio.run_coroutine_threadsafe(gathering, loop)

    def _finished(self, items: Sequence[Any]) -> Iterator[tuple[int, Done]]:
        """Waits a moment for tasks; what they gave, by the first item. What could not run is given out again."""
        wait_for(list(self._tasks), timeout=0.5, return_when=FIRST_COMPLETED)
        if self.client.status not in ("running", "connecting"):
            raise self._gone()
        for fetch in [fetch for fetch in self._tasks if fetch.done()]:
            task = self._tasks.pop(fetch, None)
            if task is None:  # another try of the same items came first
                continue
            if fetch.cancelled() and task.future is not None and task.future.status != "cancelled":
                # The engine fetches together what is asked for at one time: it was given up with another that was released.
                self._tasks[self._fetch(task.future)] = task
                continue
            error = asyncio.CancelledError() if fetch.cancelled() else fetch.exception()
            if error is not None:
                self._failed(items, task, error)
                continue
            (result,) = fetch.result()
            if isinstance(result, Missing):
                self._bring(result)
                self._submit(items, task.first, task.last, task.attempts)
                continue
            assert isinstance(result, Done)
            self._silent.discard(result.worker)
            self._times.append(result.seconds / max(1, len(result.results)))
            yield task.first, result

    def _bring(self, missing: Missing) -> None:
        for file in missing.files:
            try:
                ship.send(self.client, file, missing.worker)
            except Exception as error:
                if isinstance(error, OSError) and error.filename == file.path:
                    raise InputError(f"cannot read {file.path} to send it to {missing.worker}") from error
                # The worker died, or its disk is full: the task finds another.

    def _failed(self, items: Sequence[Any], task: _Task, error: BaseException) -> None:
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        if task.future is None:  # what went wrong there, a worker says
            self._submit(items, task.first, task.last)
            return
        if isinstance(error, InputError):
            raise error
        if isinstance(error, FutureCancelledError | asyncio.CancelledError):
            raise self._gone() from error
        if task.attempts >= ATTEMPTS or not isinstance(error, KilledWorker):
            raise InputError(
                f"item {task.first} fails on the cluster's workers: {type(error).__name__}: {error}"
            ) from error
        self._submit(items, task.first, task.last, task.attempts + 1)

    def _repeat_what_found_nobody(self, items: Sequence[Any]) -> None:
        """Gives out again what nobody has once somebody new is fit: a task that was given out while nobody was, or whose only
        worker died, is not looked at again by the scheduler when a resource is added to a worker that it knows."""
        now = time.monotonic()
        if not self._known.issuperset(self._workers()):
            self._known.update(self._fit)
            self._look = now + 1.0  # what was given out a moment ago is on its way to the scheduler
        if now < self._look:
            return
        self._look = math.inf
        try:
            processing = cast(dict[str, Any], self.client.processing())
        except (OSError, KeyError, ValueError) as error:
            raise self._gone() from error
        busy = {key for keys in processing.values() for key in keys}
        for fetch, task in list(self._tasks.items()):
            waits = task.future is not None and task.future.status == "pending" and task.future.key not in busy
            if waits and task.started < now - 0.9:
                self._release(fetch, self._tasks.pop(fetch))
                self._submit(items, task.first, task.last, task.attempts)

    def _repeat_a_late_one(self, items: Sequence[Any], oldest: int) -> None:
        """The oldest items that are missing are given out once more after five times what they take: who has them is frozen,
        perhaps. The same bits come from anyone, and the first to come counts."""
        tries = [task for task in self._tasks.values() if task.first == oldest]
        if not tries or not self._times or not self.repeat_late:
            return
        task = tries[-1]
        usual = statistics.median(self._times) * (task.last - task.first)
        late = time.monotonic() - task.started > max(LEAST_PATIENCE, PATIENCE_FACTOR * usual)
        if late and len(tries) < ATTEMPTS:
            self._silent.update(self._holders(task.future))
            self._submit(items, task.first, task.last, task.attempts + 1)

    def _holders(self, future: Future | None) -> list[str]:
        """Who runs a task or holds its result."""
        if future is None:
            return []
        try:
            if future.status == "finished":
                return list(cast(dict[str, Any], self.client.who_has([future]))[str(future.key)])
            processing = cast(dict[str, Any], self.client.processing())
            return [address for address, keys in processing.items() if future.key in keys]
        except (OSError, KeyError, ValueError):
            return []

    def _forget_tries_of(self, first: int) -> None:
        for fetch in [fetch for fetch, task in self._tasks.items() if task.first == first]:
            self._release(fetch, self._tasks.pop(fetch))

    @staticmethod
    def _release(fetch: Fetch[Any], task: _Task) -> None:
        with contextlib.suppress(Exception):  # the engine may be gone
            if task.future is None or task.future.status != "pending":
                fetch.cancel()
            if task.future is not None:
                task.future.cancel(force=True)  # and its fetch ends, where it waits for this

    def _gone(self) -> InputError:
        return InputError(
            "--cluster: the scheduler is gone; what was written stays, and the same command goes on from there"
        )
