"""The engine behind ``--cluster``: one that runs already, by its address or scheduler file, or one of this machine alone.

Everything that Dask sends is a pickle: whoever reaches its ports runs code on all machines. So a cluster of our own stays
on the loopback interface, its dashboard too, and docs/cluster.md says how to close the others.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    """The address of a scheduler with ``processes`` workers, on the loopback interface alone."""
    import distributed

    if not 1 <= processes <= 1024:
        raise InputError(f"--cluster local:N takes 1 to 1024 processes, got {processes} ({usable_cores()} cores here)")
    with tempfile.TemporaryDirectory(prefix="nerfvol-cluster-") as scratch:
        try:
            cluster = distributed.LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",  # None would open 8787 on every interface
                local_directory=scratch,
                silence_logs=logging.CRITICAL,
                memory_limit=0,
            )
        except (OSError, RuntimeError, TimeoutError) as error:
            raise InputError(f"--cluster local:{processes}: its processes did not start ({error})") from error
        try:
            yield cluster.scheduler_address
        finally:
            with contextlib.suppress(OSError, TimeoutError):
                cluster.close(timeout=10)
