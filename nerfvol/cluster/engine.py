"""The engine behind ``--cluster``: one that runs already, by its address or scheduler file, or one of this machine alone.

Everything that Dask sends is a pickle: whoever reaches its ports runs code on all machines. So a cluster of our own stays
on the loopback interface, its dashboard too, and docs/cluster.md says how to close the others.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfvol.cluster.copies import Keeper, may_copy
from nerfvol.errors import InputError
from nerfvol.machine import usable_cores

if TYPE_CHECKING:
    from distributed import Client

CONNECT_SECONDS = 10.0
FILE_SECONDS = 60.0
"""How long a scheduler may take to write its file: a queue may hold it."""
SETTINGS = {
    "distributed.scheduler.worker-ttl": "30s",  # a frozen worker is given up after this; the default is five minutes
    "distributed.scheduler.allowed-failures": 10,  # deaths of workers count against every task that waited there
    "distributed.comm.timeouts.connect": "10s",
    "distributed.admin.log-format": "%(message)s",
    # What nobody looks at here, in every process: a profile (100 times a second), ticks (50), memory and network (2).
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
    # The engine has its processes return freed memory at once, which costs a frame 10 ms of page faults.
    "distributed.nanny.pre-spawn-environ": {
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    },
}


@contextlib.contextmanager
def connect(where: str) -> Iterator[Client]:
    """A client of the engine that ``where`` names; ended with everything that was started for it.

    ``where``: ``local:N`` (N processes of this machine), an address such as ``tcp://host:8786`` or ``tls://host:8786``, or
    the path of a scheduler file.

    Raises:
        InputError: ``distributed`` is not installed, nothing answers there, or ``where`` is none of the three.
    """
    try:
        import distributed
        from dask import config
    except ImportError as error:
        raise InputError("--cluster needs the package distributed: pip install 'nerfvol[cluster]'") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong is said by us, once
    with contextlib.ExitStack() as stack:
        stack.enter_context(config.set(SETTINGS))
        local = re.fullmatch(r"local:(\d+)", where)
        if local:
            target: dict[str, Any] = {"address": stack.enter_context(_own_cluster(int(local[1])))}
        elif "://" in where:
            target = {"address": where}
        elif Path(where).is_file() or where.endswith(".json"):
            target = {"scheduler_file": _scheduler_file(where)}
        else:
            raise InputError(
                f"--cluster: expected local:N, an address such as tcp://host:8786, or a scheduler file, got {where!r}"
            )
        try:
            client = distributed.Client(**target, timeout=CONNECT_SECONDS)
        except (OSError, ValueError, TypeError, RuntimeError, TimeoutError) as error:
            raise InputError(f"--cluster {where}: {_why(error)}") from error
        stack.callback(_leave, client)
        yield client


def _scheduler_file(where: str) -> str:
    """The path ``where`` once a scheduler has written it, which one that was just started has yet to do."""
    deadline = time.monotonic() + FILE_SECONDS
    told = False
    while True:
        with contextlib.suppress(OSError, ValueError):
            if isinstance(json.loads(Path(where).read_text()).get("address"), str):
                return where
        if time.monotonic() > deadline:
            what = "is no scheduler file" if Path(where).is_file() else "is not there"
            raise InputError(f"--cluster: {where} {what} (waited {FILE_SECONDS:.0f} s for a scheduler to write it)")
        if not told:
            print(f"waiting for the scheduler file {where}", file=sys.stderr)
            told = True
        time.sleep(0.1)


def _why(error: Exception) -> str:
    """What kept a client out, for a person."""
    if isinstance(error, FileNotFoundError):
        return "a certificate or key that distributed.comm.tls of Dask's settings names is not there"
    said = str(error).lower()
    if isinstance(error, TypeError | RuntimeError) or any(
        word in said for word in ("ssl", "tls", "certificate", "closed")
    ):
        return (
            "it does not let this client in; tls:// asks for the certificate that distributed.comm.tls of Dask's settings "
            "names, tcp:// for a scheduler without one (docs/cluster.md)"
        )
    return f"nothing answers there (waited {CONNECT_SECONDS:.0f} s)"


def _leave(client: Client) -> None:
    with contextlib.suppress(OSError, TimeoutError):
        client.close(timeout=5)


@contextlib.contextmanager
def _own_cluster(processes: int) -> Iterator[str]:
    """The address of a scheduler with ``processes`` workers, on the loopback interface alone.

    The workers are copies of this process where those are sound, else started by the engine, which takes seconds longer.
    """
    if not 1 <= processes <= 1024:
        raise InputError(f"--cluster local:N takes 1 to 1024 processes, got {processes} ({usable_cores()} cores here)")
    with contextlib.ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="nerfvol-cluster-"))
        keeper = Keeper(processes) if may_copy() else None
        try:
            cluster = _local_cluster(0 if keeper else processes, scratch)
        except (OSError, RuntimeError, TimeoutError) as error:
            if keeper:
                keeper.close()
            raise InputError(f"--cluster local:{processes}: its processes did not start ({error})") from error
        stack.callback(_close, cluster)
        if keeper:
            stack.callback(keeper.close)
            keeper.start(functools.partial(serve, cluster.scheduler_address, scratch))
        yield cluster.scheduler_address


def _local_cluster(processes: int, scratch: str) -> Any:
    import distributed

    return distributed.LocalCluster(
        n_workers=processes,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",  # None would open 8787 on every interface
        local_directory=scratch,
        silence_logs=logging.CRITICAL,
        memory_limit=0,
    )


def _close(cluster: Any) -> None:
    with contextlib.suppress(OSError, TimeoutError):
        cluster.close(timeout=10)


def serve(address: str, scratch: str, number: int) -> None:
    """Works for the scheduler at ``address`` of this machine until it is gone: what a copy of a client does."""
    import asyncio

    import distributed

    async def work() -> None:
        worker = distributed.Worker(
            address,
            nthreads=1,
            name=str(number),
            host="127.0.0.1",
            dashboard=False,
            local_directory=scratch,
            memory_limit=0,
        )
        async with worker:
            await worker.finished()

    asyncio.run(work())
