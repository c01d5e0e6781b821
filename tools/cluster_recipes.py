"""Follows docs/cluster.md on this machine: farms' command lines, local processes, SSH, Slurm and TLS, all on loopback.

    python tools/cluster_recipes.py [NAME ...]      (local farm ssh slurm tls; called by .ci/run)

The page's own commands run, with what FILL puts in their place: loopback addresses and few workers. Every picture is
compared with that of one process. The Python that runs this must have nerfvol[cluster] installed. What is missing
(openssh-server, slurm-wlm and munge) is installed by root with apt-get, or its part is skipped with a sentence.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "cluster.md").read_text()
BIN = Path(sys.prefix) / "bin"
PATIENCE = 100.0
"""Seconds that a recipe may take."""
FILL = {
    "10.0.0.5": "127.0.0.5", "10.0.0.6": "127.0.0.6", "nerfvol-env/bin/": f"{BIN}/", "--nworkers 8": "--nworkers 2",
    "--ntasks=17": "--ntasks=3", "--ntasks=16": "--ntasks=2",
    "#IFRAME#-#IFRAME#": "7-7", "<STARTFRAME>-<ENDFRAME>": "10-14", "{frame_start}-{frame_end}": "20-22",
}  # fmt: skip
PACKAGES = {
    "ssh": (("sshd", "ssh-keygen", "ssh"), ("openssh-server", "openssh-client")),
    "slurm": (("slurmctld", "slurmd", "munged", "srun"), ("slurm-wlm", "munge")),
}
ON_PATH = os.pathsep.join([str(BIN), os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
SLURM = (ROOT / "tools" / "slurm_loopback.conf").read_text()


class Skipped(Exception):
    """Why a recipe cannot be followed here."""


def section(heading: str) -> str:
    """The text under a heading of the page, of any level."""
    found = re.search(rf"^#+ {re.escape(heading)}$\n(.*?)(?=^#+ |\Z)", _without_code(PAGE), re.M | re.S)
    assert found, f"docs/cluster.md has no section {heading!r}"
    return PAGE[found.start(1) : found.end(1)]


def _without_code(text: str) -> str:
    """The text with the same length, comments in its code no longer like headings."""
    return re.sub(r"^```.*?^```", lambda code: code[0].replace("\n#", "\n "), text, flags=re.M | re.S)


def commands(text: str) -> list[str]:
    """The fenced blocks of a text, filled in."""
    return [filled(block) for block in re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)]


def filled(text: str) -> str:
    """A command of the page with this machine's values."""
    for theirs, ours in FILL.items():
        text = text.replace(theirs, ours)
    return text


def shell(script: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Runs a script as one shell; what it leaves in the background ends with it. AssertionError where it fails."""
    environment = {**os.environ, "PATH": ON_PATH, **variables}
    process = subprocess.Popen(
        ["bash", "-eu", "-c", script], cwd=folder, env=environment, text=True, start_new_session=True,
        stdout=(out := tempfile.TemporaryFile("w+")), stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        code: int | None = process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        code = None
    finally:
        try:
            os.killpg(process.pid, signal.SIGTERM)
            time.sleep(0.5)
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
    out.seek(0)
    said = out.read()
    ended = f"code {code}" if code is not None else f"nothing after {PATIENCE:.0f} s"
    assert code == 0, f"the page's commands\n{script}\nended with {ended}:\n{said}"
    return subprocess.CompletedProcess(script, code, said)


def pictures(folder: Path) -> dict[str, bytes]:
    """Every file of a folder of pictures."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class Here:
    """A folder with a small scene, a run of it and its 240 frames drawn by one process; recipes run in folders beside."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make = "from pathlib import Path\nfrom tests.fixtures.tiny import write_scene\n"
        make += 'write_scene(Path("scene"), {"train": 12, "val": 1, "test": 2})'
        shell(
            f"'{sys.executable}' -c '{make}'\nnerfvol train --data scene --out run --time-budget 3s",
            folder,
            PYTHONPATH=str(ROOT),
        )
        shell("nerfvol render run --path orbit --seconds 8 --out frames", folder)
        self.frames = {name: data for name, data in pictures(folder / "frames").items() if name != "film.json"}
        assert len(self.frames) == 241  # and cameras.json

    def fresh(self, name: str) -> Path:
        """A folder in which ``run`` is that run."""
        folder = self.folder / name
        folder.mkdir()
        for shared in ("run", "scene"):
            (folder / shared).symlink_to(self.folder / shared)
        return folder

    def check(self, folder: Path, chosen: range | None = None) -> None:
        """The frames there are those of one process: all, or those that were asked for."""
        found = pictures(folder / "frames")
        assert found.pop("film.json")
        wanted = self.frames if chosen is None else {
            name: data for name, data in self.frames.items() if name == "cameras.json" or int(name[:-4]) in chosen
        }  # fmt: skip
        assert found == wanted, f"{folder}: other frames than those of one process ({len(found)} of {len(wanted)})"


def follow_local(here: Here) -> None:
    """The lines of the section on the engine, on local:2 in place of a scheduler."""
    folder = here.fresh("local")
    lines = [
        line for line in commands(section("An engine: Dask distributed"))[0].splitlines() if "--cluster local" in line
    ]
    assert lines and all(line.startswith("nerfvol ") for line in lines)
    for line in lines:
        shell(line.replace("orbit.mp4", "frames"), folder)
    here.check(folder)


def follow_farm(here: Here) -> None:
    """The two commands of the page's first section and every row of its table but Slurm's, tokens filled in."""
    text = section("A farm that runs command lines")
    for k, line in enumerate(commands(text)[0].strip().splitlines()):
        folder = here.fresh(f"farm-{k}")
        shell(line, folder)
        here.check(folder, (range(60), range(1, 240, 2))[k])
    rows = dict(re.findall(r"^\| ([^|]+?) \| .*?`(.*)` ?.*\|$", text.replace(r"\|", "¦"), re.M))
    chosen = {"OpenCue": range(7, 8), "Deadline (CommandLine plug-in)": range(10, 15), "Flamenco": range(20, 23)}
    for name, frames in chosen.items():
        command = re.search(r"`((?:nerfvol )?render [^`]*)`", f"`{rows[name]}`")
        assert command, f"no command for {name}"
        folder = here.fresh(name.split()[0])
        shell("nerfvol " + filled(command[1]).removeprefix("nerfvol "), folder)
        here.check(folder, frames)
    folder = here.fresh("xargs")
    shell(filled(rows["one machine's shell"]).replace("¦", "|"), folder)
    here.check(folder)


def follow_ssh(here: Here) -> None:
    """The section on SSH, with a real sshd on 127.0.0.6 that knows one key."""
    folder = here.fresh("ssh")
    keys, shims = folder / "keys", folder / "bin"
    keys.mkdir()
    shims.mkdir()
    for name in ("host", "user"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", keys / name], check=True)
    if os.getuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)  # where sshd of root keeps its unprivileged part
    (keys / "sshd").write_text(
        f"ListenAddress 127.0.0.6\nPort 26022\nHostKey {keys}/host\nAuthorizedKeysFile {keys}/user.pub\nPidFile none\n"
        "StrictModes no\nUsePAM no\nPasswordAuthentication no\nPermitRootLogin prohibit-password\n"
    )
    (keys / "config").write_text(
        f"Host *\nPort 26022\nIdentityFile {keys}/user\nIdentitiesOnly yes\nStrictHostKeyChecking no\n"
        f"UserKnownHostsFile {keys}/known\nLogLevel ERROR\n"
    )
    shim = shims / "ssh"  # the page's ssh, that leaves the user's own settings and keys alone
    shim.write_text(f'#!/bin/sh\nexec {shutil.which("ssh", path=ON_PATH)} -F {keys}/config "$@"\n')
    shim.chmod(0o755)
    variables = {"PATH": f"{shims}{os.pathsep}{ON_PATH}"}
    with (folder / "sshd.log").open("w+") as log, contextlib.ExitStack() as stack:
        sshd = subprocess.Popen([str(shutil.which("sshd", path=ON_PATH)), "-D", "-e", "-f", keys / "sshd"], stderr=log)
        stack.callback(sshd.wait)
        stack.callback(sshd.terminate)
        try:  # the page takes a machine that can be reached: this one's sshd needs a moment to listen
            shell("for k in $(seq 100); do ssh 127.0.0.6 true && exit 0; sleep 0.2; done; exit 1", folder, **variables)
        except AssertionError as why:
            ended = "" if sshd.poll() is None else f", sshd ended with code {sshd.poll()}"
            said = " / ".join([*(folder / "sshd.log").read_text().splitlines()[-5:], *str(why).splitlines()[-2:]])
            raise Skipped(f"no shell by SSH on 127.0.0.6{ended}: {said}") from None
        (script,) = commands(section("On several machines by SSH"))
        shell(script, folder, **variables)
    here.check(folder)


def follow_slurm(here: Here) -> None:
    """The array of the farms' table and the section on Slurm, on one node with daemons of our own."""
    folder = here.fresh("slurm")
    for name in ("state", "spool"):
        (folder / name).mkdir()
    folder.chmod(0o755)  # munge's clients must reach its socket
    key = folder / "munge.key"
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    host = os.uname().nodename.split(".")[0]
    user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
    (folder / "slurm.conf").write_text(SLURM.format(host=host, user=user, folder=folder))
    conf = {"SLURM_CONF": str(folder / "slurm.conf")}
    munge = (
        "--socket {0}/munge.socket --key-file {0}/munge.key --pid-file {0}/pid --seed-file {0}/seed --log-file {0}/log"
    )
    rows = dict(re.findall(r"^\| (Slurm array) \| `(.*)` \|$", section("A farm that runs command lines"), re.M))
    name, script = re.search(r"`(\S+\.sh)`", section("On Slurm")), commands(section("On Slurm"))
    assert name and len(script) == 2
    (folder / name[1]).write_text(script[0])
    wait = "\nwhile squeue -h | grep -q .; do sleep 0.3; done\n"
    with contextlib.ExitStack() as stack:
        for daemon in (f"munged -F -f {munge.format(folder)}", "slurmctld -D", f"slurmd -D -N {host}"):
            environment = {**os.environ, "PATH": ON_PATH, **conf}
            started = subprocess.Popen(daemon.split(), cwd=folder, env=environment, stdout=subprocess.DEVNULL,
                                       stderr=subprocess.DEVNULL)  # fmt: skip
            stack.callback(started.wait)
            stack.callback(started.terminate)
        idle = "for k in $(seq 100); do sinfo -h -o %T 2> /dev/null | grep -q idle && exit 0; sleep 0.2; done; exit 1"
        stack.callback(shell, f"scancel --user={user} || true{wait}", folder, **conf)  # before the daemons go
        try:
            shell(idle, folder, **conf)
        except AssertionError:  # the daemons' own affair: slurm.conf is ours, not the page's
            raise Skipped(f"no idle Slurm node within 20 s: {_logs(folder)}") from None
        try:
            shell(filled(rows["Slurm array"]) + wait + "mv frames array\n" + script[1], folder, **conf)
        except AssertionError:
            print(_logs(folder))
            raise
    here.check(folder)
    shutil.rmtree(folder / "frames")
    (folder / "array").rename(folder / "frames")
    here.check(folder)


def _logs(folder: Path) -> str:
    """The last lines of what Slurm's daemons and jobs wrote in a folder."""
    names = [name for name in ("slurmctld.log", "slurmd.log") if (folder / name).exists()]
    names += [path.name for path in folder.glob("slurm-*.out")]
    return "\n".join(f"--- {name}\n" + "\n".join((folder / name).read_text().splitlines()[-15:]) for name in names)


def follow_tls(here: Here) -> None:
    """The section on TLS; then a client without its certificate, which must be refused in one sentence."""
    folder = here.fresh("tls")
    certificates, work = commands(section("TLS"))
    shell(certificates, folder)
    *_, render, kill = work.strip().splitlines()
    assert render.startswith("nerfvol") and kill.startswith("kill")
    stranger = (
        "unset DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY\n"
        f"if {render.replace('--out frames', '--out others')} > refused.txt 2>&1; then exit 9; fi\n"
    )
    shell("\n".join([*work.strip().splitlines()[:-1], stranger, kill]), folder)
    here.check(folder)
    said = (folder / "refused.txt").read_text().strip()
    assert len(said.splitlines()) == 1 and "certificate" in said, f"a client without its certificate was told:\n{said}"


RECIPES: dict[str, Callable[[Here], None]] = {
    "local": follow_local, "farm": follow_farm, "ssh": follow_ssh, "slurm": follow_slurm, "tls": follow_tls,
}  # fmt: skip


def provide(name: str) -> None:
    """Installs what a recipe takes where it is missing; Skipped where that cannot be."""
    programs, packages = PACKAGES.get(name, ((), ()))
    missing = [program for program in programs if not shutil.which(program, path=ON_PATH)]
    if not missing:
        return
    if os.getuid() != 0 or not shutil.which("apt-get"):
        raise Skipped(
            f"{', '.join(missing)} not there, and only root with apt-get can install {' and '.join(packages)}"
        )
    for command in (["apt-get", "update", "-q"], ["apt-get", "install", "-qy", "--no-install-recommends", *packages]):
        if subprocess.run(command, stdout=subprocess.DEVNULL).returncode:
            raise Skipped(f"apt-get could not install {' and '.join(packages)}")


def main(names: list[str]) -> int:
    if unknown := set(names) - set(RECIPES):
        print(f"cluster recipes: expected some of {', '.join(RECIPES)}, got {', '.join(sorted(unknown))}")
        return 2
    if sys.platform != "linux":
        print("cluster recipes: skipped, they take Linux (its loopback has 127.0.0.5)")
        return 0
    with tempfile.TemporaryDirectory(prefix="recipes-") as name:
        here = Here(Path(name))
        for recipe in names or RECIPES:
            started = time.perf_counter()
            try:
                provide(recipe)
                RECIPES[recipe](here)
            except Skipped as why:
                print(f"cluster recipes: {recipe} skipped: {why}", flush=True)
                continue
            print(f"cluster recipes: {recipe} as the page says, {time.perf_counter() - started:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
