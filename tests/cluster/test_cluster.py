"""Work on an engine's workers: in order, the same bytes, nothing lost or twice, whoever dies.

The engine is real (two processes of this machine); one of them serves all tests but those that end it.
"""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")

from nerfvol.cluster import fit, ship, window
from nerfvol.cluster.engine import connect
from nerfvol.cluster.fit import Fit
from nerfvol.cluster.needs import Needs, fingerprint, with_data
from nerfvol.cluster.tasks import Job
from nerfvol.cluster.window import Window
from nerfvol.errors import InputError
from tests.cluster.clock import Steps
from tests.cluster.work import keep_files_in

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.filterwarnings("ignore")  # the engine's own, of ports and loops


@pytest.fixture(scope="module")
def client():
    with connect("local:2") as found:
        yield found


def job(name: str, **settings) -> Job:
    return Job(f"tests.cluster.work:{name}", settings)


def workers(client) -> dict[str, int]:
    """Process numbers of both workers by address, once the scheduler has seen who is gone and who came in its place."""
    for _ in range(3000):
        with contextlib.suppress(OSError):
            if len(found := client.run(os.getpid)) == 2:
                return found
        time.sleep(0.1)
    raise AssertionError("the workers do not answer")


def test_results_come_once_and_in_order(client):
    """Of what takes no time: one worker may have ended it before the other asks for any."""
    results = list(Window(client, job("double"), Needs()).results(range(120)))
    assert [value for value, _ in results] == [2 * k for k in range(120)]
    assert {process for _, process in results} <= set(workers(client).values())


def test_all_workers_work(client, tmp_path):
    """None ends before each has begun."""
    who = workers(client).values()
    company = job("in_company", folder=str(tmp_path), n=len(who))
    assert list(Window(client, company, Needs()).results(range(30))) == [2 * k for k in range(30)]
    assert {int(path.name) for path in tmp_path.iterdir()} == set(who)


def test_no_more_is_on_its_way_than_the_window_says(client):
    taken = []

    class Items(list):
        def __getitem__(self, key):
            taken.append(key.stop)
            return super().__getitem__(key)

    running = Window(client, job("double", seconds=0.3), Needs()).results(Items(range(40)))
    next(running)
    time.sleep(1.5)  # nobody asks for more: nothing more may be given out
    a_task = round(window.TASK_SECONDS / 0.3)
    assert max(taken) <= a_task * (2 * window.TASKS_A_WORKER + 1)
    running.close()


def test_a_killed_worker_loses_nothing(client):
    results = Window(client, job("double", seconds=0.03), Needs()).results(range(100))
    found = [next(results)]
    os.kill(sorted(workers(client).values())[0], signal.SIGKILL)
    assert [value for value, _ in [*found, *results]] == [2 * k for k in range(100)]


@pytest.fixture
def patient_engine(client):
    """The engine does not give a silent worker up meanwhile."""

    def wait_for(dask_scheduler, seconds):
        before, dask_scheduler.worker_ttl = dask_scheduler.worker_ttl, seconds
        return before

    before = client.run_on_scheduler(wait_for, seconds=600.0)
    yield
    client.run_on_scheduler(wait_for, seconds=before)


def test_a_fetch_that_was_given_up_with_another_is_begun_again(client, monkeypatch):
    """The engine fetches together what is asked for at one time, and who releases one of these ends all."""
    gather, calls = client.gather, []

    async def given_up():
        raise asyncio.CancelledError

    def gathered(futures, **options):
        calls.append(None)
        return given_up() if len(calls) in (2, 3, 5) else gather(futures, **options)

    monkeypatch.setattr(client, "gather", gathered)
    results = list(Window(client, job("double", seconds=0.05), Needs()).results(range(12)))
    assert [value for value, _ in results] == [2 * k for k in range(12)] and len(calls) > 5


def test_time_in_which_nobody_looked_is_no_waiting_for_workers(client, monkeypatch):
    """As after a process was stopped, or its reader was busy: whoever was given up meanwhile comes back."""
    results = Window(client, job("double"), Needs()).results(range(40))
    found, looks, real = [next(results)], [], window.fit_workers

    def fit_workers(*given):
        looks.append(None)
        return [] if len(looks) < 2 else real(*given)

    monkeypatch.setattr(window, "fit_workers", fit_workers)
    later = types.SimpleNamespace(**{**vars(time), "monotonic": lambda: time.monotonic() + 1000})
    monkeypatch.setattr(window, "time", later)
    assert [value for value, _ in [*found, *results]] == [2 * k for k in range(40)] and looks


def test_a_frozen_worker_holds_nothing_up(client, monkeypatch, patient_engine):
    """Its work is done while it still belongs to the engine."""
    monkeypatch.setattr(window, "LEAST_PATIENCE", 0.5)
    results = Window(client, job("double", seconds=0.03), Needs()).results(range(60))
    found = [next(results)]
    address, frozen = sorted(workers(client).items())[0]
    os.kill(frozen, signal.SIGSTOP)
    try:
        assert [value for value, _ in [*found, *results]] == [2 * k for k in range(60)]
        assert address in client.scheduler_info(n_workers=-1)["workers"]
    finally:
        os.kill(frozen, signal.SIGCONT)


def test_files_are_sent_where_they_are_not(client, tmp_path, monkeypatch):
    content = os.urandom(3 * ship.PART + 17)
    client.run(keep_files_in, str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    (tmp_path / "model.bin").write_bytes(content)
    with (tmp_path / "model.bin").open("rb") as file:
        here_alone = f"/proc/self/fd/{file.fileno()}"  # another file, or none, in every other process
        described = ship.describe(tmp_path / "model.bin")
        shipped = ship.Shipped(described.sha256, described.size, here_alone, ".bin")
        sent = Job("tests.cluster.work:content", {}, {"model": shipped})
        results = list(Window(client, sent, Needs()).results(range(4)))
    assert all(result == content for result in results)
    assert [path.name for path in (tmp_path / "cache").iterdir()] == [f"{described.sha256}.bin"]


def test_what_arrives_otherwise_than_it_was_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("NERFVOL_CACHE", str(tmp_path))
    with pytest.raises(OSError, match="changed while it was sent"):
        ship.receive(ship.Shipped("0" * 64, 3, "/m", ".bin"), 0, b"abc")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_takes_its_worker_out(client, tmp_path):
    results = list(Window(client, job("no_space_on", file=str(tmp_path / "who")), Needs(room=1)).results(range(20)))
    assert results == [2 * k for k in range(20)]


def test_what_fails_everywhere_is_one_sentence(client):
    with pytest.raises(InputError, match="RuntimeError: this never works"):
        list(Window(client, job("broken"), Needs()).results(range(4)))


def test_workers_that_draw_otherwise_are_named(client, monkeypatch):
    """Once each has answered, however long that takes."""
    monkeypatch.setattr(fit, "time", Steps())
    with pytest.raises(InputError) as caught:
        fit.welcome(client, Needs(probes=("tests.cluster.work:other_probe",), patience=2.0))
    assert all(address in str(caught.value) for address in workers(client))
    assert "draws other pictures" in str(caught.value)


def test_who_is_not_fit_has_said_so_when_it_answers():
    """What is sent otherwise may come later than the answer, and after patience is over."""
    said = []

    class Scheduler:
        async def log_event(self, topic, msg):
            said.append((topic, msg["worker"], msg["reason"]))

    worker = types.SimpleNamespace(address="tcp://one", scheduler=Scheduler(), log_event=lambda *given: None)
    asyncio.run(Fit(Needs(room=10**18), fingerprint(Needs())).setup(worker))  # pyright: ignore[reportArgumentType]
    ((topic, address, reason),) = said
    assert topic == fit.TOPIC and address == "tcp://one" and "are needed" in reason


def test_who_is_silent_takes_nothing_from_what_others_said(client, monkeypatch):
    """Of three workers one is fit, one says why not, and the last never answers."""
    registered, refused = [], {"worker": "tcp://two", "reason": "why"}
    workers = dict.fromkeys(("tcp://two", "tcp://three"), {"resources": {}})

    def info(n_workers):
        return {"workers": {**workers, "tcp://one": {"resources": {registered[0].resource: 1}}}}

    monkeypatch.setattr(fit, "time", Steps())
    monkeypatch.setattr(client, "register_plugin", registered.append)
    monkeypatch.setattr(client, "scheduler_info", info)
    monkeypatch.setattr(client, "get_events", lambda topic: [(0.0, {**refused, "resource": registered[0].resource})])
    assert fit.welcome(client, Needs())[1] == ["tcp://two does not work on this: why"]


def test_fit_asks_for_kernels_data_and_room(tmp_path, monkeypatch):
    monkeypatch.setenv("NERFVOL_CACHE", str(tmp_path / "cache"))
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "a.png").write_bytes(b"1")
    mine = Needs(data=with_data([tmp_path / "scene"]))
    expected = fingerprint(mine)
    assert Fit(mine, expected).reason() == ""
    assert "draws other pictures" in Fit(mine, "0" * 16).reason()
    (tmp_path / "scene" / "b.png").write_bytes(b"2")
    assert "is another one there" in Fit(mine, expected).reason()
    (tmp_path / "scene").rename(tmp_path / "elsewhere")
    assert "is not there" in Fit(mine, expected).reason()
    assert "are needed" in Fit(Needs(room=10**18), expected).reason()


def test_another_instruction_set_has_another_fingerprint():
    """Baseline kernels round otherwise than those with fused multiply-add."""
    from nerfvol.kernels import ops

    if ops.isa() not in ("avx2", "avx512"):
        pytest.skip(f"these kernels are {ops.isa()}: there is nothing to tell them from")
    code = "from nerfvol.cluster.needs import *; print(fingerprint(Needs()))"
    prints = {}
    for isa in (ops.isa(), "baseline"):
        environment = {**os.environ, "NERFVOL_ISA": isa}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        prints[isa] = done.stdout.strip()
    assert prints["baseline"] != prints[ops.isa()] == fingerprint(Needs())


def test_a_scheduler_that_dies_is_one_sentence(tmp_path):
    file = tmp_path / "scheduler.json"
    starter = "import sys; from distributed.cli.dask_{0} import main; main(sys.argv[1:])"
    arguments = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    arguments_of_worker = ["--scheduler-file", str(file), "--no-dashboard", "--nthreads", "1", "--no-nanny"]
    with contextlib.ExitStack() as stack:

        def start(what: str, given: list[str]) -> subprocess.Popen:
            command = [sys.executable, "-c", starter.format(what), *given]
            process = stack.enter_context(subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=ROOT))
            stack.callback(process.kill)
            return process

        scheduler = start("scheduler", arguments)
        while not file.exists() or not file.read_text():
            assert scheduler.poll() is None
            time.sleep(0.05)
        start("worker", arguments_of_worker)
        with connect(str(file)) as client:
            results = Window(client, job("double", seconds=0.05), Needs()).results(range(400))
            assert next(results)[0] == 0
            scheduler.kill()
            with pytest.raises(InputError, match="scheduler is gone"):
                list(results)


@pytest.mark.parametrize("where", ("local:0", "local:many", "nowhere", "tcp://127.0.0.1:9"))
def test_what_cannot_be_reached_is_one_sentence(where, monkeypatch):
    monkeypatch.setattr("nerfvol.cluster.engine.CONNECT_SECONDS", 1.0)
    with pytest.raises(InputError, match="--cluster"), connect(where):
        pass


def test_the_package_imports_no_engine():
    code = "import sys, nerfvol, nerfvol.cli.main; print('distributed' in sys.modules or 'dask' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"
