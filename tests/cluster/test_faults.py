"""Real renders on workers that die, disagree or fill up, whenever they do: every frame once, with the bytes of one process."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import pytest

pytest.importorskip("distributed", reason="the engine is the extra nerfvol[cluster]")

from nerfvol.cameras.camera import Intrinsics, orbit
from nerfvol.cluster import engine, fit, ship
from nerfvol.cluster.engine import connect
from nerfvol.cluster.frames import MODEL, OnCluster
from nerfvol.cluster.needs import Needs
from nerfvol.cluster.tasks import Job
from nerfvol.cluster.window import Window
from nerfvol.errors import InputError
from nerfvol.film import Chosen, Film, write_pictures
from nerfvol.models import load_model
from nerfvol.octree.io import save_octree
from tests.cluster.clock import Steps
from tests.cluster.work import die_once_in, keep_files_in

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.filterwarnings("ignore")  # the engine's own, of processes that died
FRAMES = 24


@pytest.fixture(scope="module")
def model(tmp_path_factory, sphere_octree) -> Path:
    path = tmp_path_factory.mktemp("model") / "octree.safetensors"
    save_octree(path, sphere_octree, {"background": [0.2, 0.4, 0.6]})
    return path


def film_of(model: Path) -> Film:
    lens = Intrinsics(40, 30, 50.0, 50.0, 20.0, 15.0)
    cameras = orbit(FRAMES, center=(0, 0, 0), radius=3.2, elevation_deg=20.0, intrinsics=lens)
    return Film(load_model(model), cameras, (0.2, 0.4, 0.6))


@pytest.fixture(scope="module")
def expected(model, tmp_path_factory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("here")
    assert write_pictures(out, film_of(model)) == FRAMES
    return contents(out)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the note on what they are of, and what a killed client was writing."""
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name != "film.json" and p.suffix != ".part"}


def drawn_by(client, model: Path, out: Path) -> int:
    out.mkdir(exist_ok=True)
    film = film_of(model)
    on_cluster = OnCluster(client, film, {MODEL: model}, print, suffix="png")
    return write_pictures(out, film, "png", Chosen(0, FRAMES - 1), on_cluster, "test")


@pytest.fixture(scope="module")
def client():
    with connect("local:2") as found:
        yield found


@pytest.mark.parametrize("group", (1, 7))
@pytest.mark.parametrize("where", ("local:1", "local:2", "local:4"))
def test_any_number_of_workers_and_frames_a_task_makes_the_same_bytes(
    model, expected, tmp_path, monkeypatch, where, group
):
    monkeypatch.setattr(Window, "_group", lambda self, seconds=0.0: group)
    with connect(where) as found:
        assert drawn_by(found, model, tmp_path) == FRAMES
    assert contents(tmp_path) == expected


def restored(client) -> None:
    """Waits until two workers are there again, and none of them is to die."""
    for _ in range(1000):
        with contextlib.suppress(OSError):  # the scheduler has yet to see that one is gone
            if len(client.run(die_once_in, "", "")) == 2:
                return
        time.sleep(0.3)
    raise AssertionError("a killed worker was not started again")


@pytest.mark.parametrize("phase", ("load", "frame", "encode", "fetch", "write", "last"))
def test_a_worker_killed_in_any_phase_loses_nothing_and_does_nothing_twice(
    client, model, expected, tmp_path, phase, monkeypatch
):
    monkeypatch.setattr(Window, "_group", lambda self, seconds=0.0: 2)
    marker, out, written = tmp_path / "died", tmp_path / "out", []
    from nerfvol import film

    def write(path: Path, data: bytes) -> None:
        written.append(path.name)
        if len(written) == {"write": 5, "last": FRAMES}.get(phase):
            os.kill(sorted(client.run(os.getpid).values())[0], signal.SIGKILL)
            marker.touch()
        write_bytes(path, data)

    write_bytes = film.write_bytes
    monkeypatch.setattr(film, "write_bytes", write)
    client.run(die_once_in, phase, str(marker))
    try:
        assert drawn_by(client, model, out) == FRAMES
    finally:
        restored(client)
    assert marker.exists(), "nobody died"
    assert contents(out) == expected and len(written) == len(set(written)) == FRAMES


@pytest.mark.parametrize("copies", (True, False), ids=("copies", "processes"))
def test_when_the_only_worker_is_killed_its_successor_goes_on(copies, monkeypatch, tmp_path):
    """The scheduler does not look again at tasks that nobody could take when a worker it knows becomes fit; and nothing is late
    while nobody knows how long a task takes."""
    monkeypatch.setattr(engine, "may_copy", lambda: copies)
    with connect("local:1") as found:
        found.wait_for_workers(1, timeout=600)
        (process,) = cast(dict[str, int], found.run(os.getpid)).values()
        held = {"process": process, "begun": str(tmp_path / "begun")}
        window = Window(found, Job("tests.cluster.work:held", held), Needs())

        def kill() -> None:
            while not (tmp_path / "begun").exists():
                time.sleep(0.01)
            os.kill(process, signal.SIGKILL)

        threading.Thread(target=kill, daemon=True).start()
        results = list(window.results(range(3)))
    assert [value for value, _ in results] == [0, 2, 4]
    assert process not in {who for _, who in results}


def test_a_client_that_was_killed_goes_on_with_the_same_command(model, expected, tmp_path):
    code = (
        "import sys\nfrom pathlib import Path\nfrom tests.cluster import test_faults as t\n"
        "with t.connect('local:1') as client: print(t.drawn_by(client, Path(sys.argv[1]), Path(sys.argv[2])))"
    )
    command = [sys.executable, "-c", code, str(model), str(tmp_path)]
    first = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while len(list(tmp_path.glob("0*.png"))) < 4 and first.poll() is None:
        time.sleep(0.01)
    first.kill()
    first.wait()
    there = len(list(tmp_path.glob("0*.png")))
    assert there >= 4
    second = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert second.returncode == 0 and int(second.stdout) == FRAMES - there
    assert contents(tmp_path) == expected


@contextlib.contextmanager
def scheduler_of(folder: Path) -> Iterator[tuple[str, Callable[..., subprocess.Popen]]]:
    """A scheduler file of a scheduler started by command, and what starts workers of it with given environments."""
    file = folder / "scheduler.json"
    starter = "import sys; from distributed.cli.dask_{0} import main; main(sys.argv[1:])"
    with contextlib.ExitStack() as stack:

        def start(what: str, *given: str, before: str = "", **variables: str) -> subprocess.Popen:
            given = (*given, "--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(file))
            process = subprocess.Popen([sys.executable, "-c", before + starter.format(what), *given], cwd=ROOT,
                                       stderr=subprocess.DEVNULL, env={**os.environ, **variables})  # fmt: skip
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        def worker(**variables: str) -> subprocess.Popen:
            return start("worker", "--nthreads", "1", "--no-nanny", **variables)

        start("scheduler", "--port", "0")
        yield str(file), worker


def test_workers_of_another_instruction_set_are_refused_by_name(model, expected, tmp_path, monkeypatch):
    from nerfvol.kernels import ops

    if ops.isa() not in ("avx2", "avx512"):
        pytest.skip(f"these kernels are {ops.isa()}: there is nothing to tell them from")
    monkeypatch.setattr(fit, "time", Steps())
    with scheduler_of(tmp_path) as (file, worker), connect(file) as found:
        worker(NERFVOL_ISA="baseline")
        found.wait_for_workers(1, timeout=600)
        with pytest.raises(InputError, match=r"is fit after 3 s \(tcp://.*with baseline kernels.*draws other pictures"):
            fit.welcome(found, Needs(patience=3.0))
        worker()
        found.wait_for_workers(2, timeout=600)
        resource, messages = fit.welcome(found, Needs())
        assert len(messages) == 1 and "with baseline kernels" in messages[0]
        assert len(fit.fit_workers(found, resource)) == 1
        assert drawn_by(found, model, tmp_path / "out") == FRAMES
    assert contents(tmp_path / "out") == expected


def test_where_nobody_is_left_one_sentence_says_so(tmp_path):
    with scheduler_of(tmp_path) as (file, worker), connect(file) as found:
        only = worker()
        window = Window(found, Job("tests.cluster.work:double", {"seconds": 0.2}), Needs())
        window.patience = 2.0
        results = window.results(range(99))
        assert next(results)[0] == 0
        only.kill()
        with pytest.raises(InputError, match="no worker has been fit for 2 s; what was written stays"):
            list(results)


def test_a_worker_without_nerfvol_is_named_and_the_others_work(tmp_path):
    absent = "import sys; sys.modules['nerfvol'] = None; "
    with scheduler_of(tmp_path) as (file, worker), connect(file) as found:
        worker(before=absent)
        found.wait_for_workers(1, timeout=600)
        (stranger,) = found.scheduler_info(n_workers=-1)["workers"]
        with pytest.raises(
            InputError, match=rf"is fit after 2 s \({stranger}: nerfvol cannot be used there \(ModuleNotF"
        ):
            fit.welcome(found, Needs(patience=2.0))
        worker()
        found.wait_for_workers(2, timeout=600)
        window = Window(found, Job("tests.cluster.work:double", {}), Needs(patience=600.0))
        assert [
            said for said in window.messages if said.startswith(f"{stranger} does not work on this: nerfvol cannot")
        ]
        assert len(window.messages) == 1
        assert [value for value, _ in window.results(range(8))] == [2 * k for k in range(8)]


def test_a_worker_that_joins_late_works_too(tmp_path):
    with scheduler_of(tmp_path) as (file, worker), connect(file) as found:
        worker()
        results = Window(found, Job("tests.cluster.work:double", {"seconds": 0.05}), Needs()).results(range(100_000))
        seen = {next(results)[1]}
        worker()
        while len(seen) < 2:  # ends after more than an hour at the latest
            seen.add(next(results)[1])
        results.close()


def test_a_cache_on_a_full_file_system_leaves_the_work_to_others(client, tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", small], capture_output=True)
    if mounted.returncode:
        pytest.skip("no file system of 1 MB can be mounted here")
    content = os.urandom(3 << 20)
    (tmp_path / "model.bin").write_bytes(content)
    described = ship.describe(tmp_path / "model.bin")
    (tmp_path / "model.bin").rename(tmp_path / "elsewhere.bin")
    first, second = sorted(client.scheduler_info(n_workers=-1)["workers"])
    try:
        client.run(keep_files_in, str(small), workers=[first])
        client.run(keep_files_in, str(tmp_path / "large"), workers=[second])
        with (tmp_path / "elsewhere.bin").open("rb") as file:
            here_alone = f"/proc/self/fd/{file.fileno()}"
            shipped = ship.Shipped(described.sha256, described.size, here_alone, ".bin")
            sent = Job("tests.cluster.work:content", {}, {"model": shipped})
            results = list(Window(client, sent, Needs()).results(range(12)))
        assert all(result == content for result in results)
        assert not [path for path in small.iterdir() if path.suffix != ".part"]
    finally:
        subprocess.run(["umount", small], check=True)
        client.run(keep_files_in, str(tmp_path / "large"))


def test_the_client_keeps_no_results(client):
    """150 MB more than the first 50 leave this process as large as it was, but for what may be on its way: six tasks of at most
    64, of which those that came early wait for an earlier one."""
    import psutil

    process, sizes = psutil.Process(), []
    for result in Window(client, Job("tests.cluster.work:noise", {"bytes": 100_000}), Needs()).results(range(2000)):
        assert len(result) == 100_000
        sizes.append(process.memory_info().rss)
    assert max(sizes[500:]) - max(sizes[:500]) < 6 * 64 * 100_000 + 20e6


def test_nothing_is_said_and_no_warning_raised_beside_a_port_in_use(model, expected, tmp_path):
    import socket

    taken = socket.socket()
    with contextlib.suppress(OSError):  # then another has it
        taken.bind(("127.0.0.1", 8787))
        taken.listen()
    command = [sys.executable, "-W", "error", "-m", "nerfvol.cli", "render", model, "--orbit", "4", "--size", "20x20"]
    done = subprocess.run(
        [*command, "--out", tmp_path / "o", "--cluster", "local:2"], cwd=ROOT, capture_output=True, text=True
    )
    taken.close()
    assert done.returncode == 0 and done.stderr == ""


def test_processes_of_this_machine_listen_on_loopback_alone():
    import psutil

    with connect("local:2"):
        ours, listening = [psutil.Process(), *psutil.Process().children(recursive=True)], set()
        for process in ours:
            with contextlib.suppress(psutil.NoSuchProcess):  # it ended meanwhile
                listening |= {c.laddr.ip for c in process.net_connections("tcp") if c.status == "LISTEN"}
    assert listening == {"127.0.0.1"}
