"""Kills commands and fills their disk at random moments, and holds what is left against the undisturbed result.

    python tools/faults.py [--seed 0] [--rounds 4] [--data DIR --downscale N] [NAME ...]      (make faults)

Each command of the table runs once in peace. Then, ``rounds`` times each: it gets SIGKILL or SIGTERM at a random moment, and
again, until it ends by itself; and it runs on a disk of a random size (Linux: a tmpfs in a namespace of its own, so that no
rights are needed), which grows until all fits. Whatever happened, its files must then be the undisturbed one's to the byte,
none half or under a temporary name; a command that a full disk ends says so in one sentence. A find is printed with its row
and the seed, and the exit code is 1. Without --data a coloured sphere of 40x40 pixels is trained on, which takes minutes.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.setdefault("NUMBA_DISABLE_JIT", "1")  # synth's few pixels are not worth compiling for, and each child would

from tests.cli.killing import SIGNALS, attempt
from tests.fixtures.runs import TINY
from tests.fixtures.tiny import write_scene

OUT = "out"
"""What commands write into, below the folder of one try."""
MOST_KILLS = 5
CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class Row:
    """``command``: with OUT for the folder that it writes, and names of what was made before. ``resume``: the command once
    OUT/checkpoint.safetensors is there. ``names``: a pattern of the files that must come out the same."""

    name: str
    command: str
    names: str
    resume: str = ""


TRAIN = "train --config CONFIG --data DATA --out OUT --representation"
RESUME = "train --resume --out OUT"
ROWS = (
    Row("octree", f"{TRAIN} octree --init direct", "octree.safetensors", RESUME),
    Row("field-start", f"{TRAIN} octree --init mlp", "octree.safetensors", RESUME),
    Row("field", f"{TRAIN} field", "field.safetensors", RESUME),
    Row("splats", f"{TRAIN} splats --init random", "splats.safetensors", RESUME),
    Row("splats-of-octree", f"{TRAIN} splats --init MADE/octree/out/octree.safetensors", "splats.safetensors", RESUME),
    Row("to-octree", "convert MADE/splats/out/splats.safetensors --to octree --out OUT/o.safetensors", "o.safetensors"),
    Row("to-octree-data", "convert MADE/splats/out --to octree --data DATA --out OUT/o.safetensors", "o.safetensors"),
    Row("to-splats", "convert MADE/octree/out/octree.safetensors --to splats --out OUT/s.safetensors", "s.safetensors"),
    Row("to-splats-data", "convert MADE/octree/out --to splats --data DATA --out OUT/s.ply", "s.ply"),
    Row("field-to-octree", "convert MADE/field/out --to octree --data DATA --out OUT/o.safetensors", "o.safetensors"),
    Row("export-grid", "export MADE/octree/out --resolution 96 --out OUT/o.npy", "o.npy"),
    Row("export-vdb", "export MADE/octree/out --out OUT/o.vdb", "o.vdb"),
    Row("export-splats", "export MADE/splats/out --out OUT/s.spz", "s.spz"),
    Row("export-page", "export MADE/splats/out --out OUT/page.html", "page.html"),
    Row("render", "render MADE/octree/out --orbit 12 --size 64x64 --out OUT", "*.png"),
    Row("render-aovs", "render MADE/octree/out --orbit 6 --size 48x48 --aov depth --out OUT", "*.png"),
    Row("synth", "synth slab --views 4 --size 8x6 --integrator emission --out OUT", "[rtd]*"),
)  # fmt: skip
SETTINGS = TINY | {"checkpoint_every": 0.05, "splats": {"steps": 250, "max_splats": 3000}}


class Faults:
    """Tries rows below one folder. ``finds``: what was wrong."""

    def __init__(self, folder: Path, seed: int, rounds: int, data: Path | None, downscale: int) -> None:
        self.folder, self.seed, self.rounds = folder, seed, rounds
        self.finds: list[str] = []
        self.made = folder / "made"
        config = folder / "config.yaml"
        settings = SETTINGS if data is None else {"checkpoint_every": 0.5, "downscale": downscale, "threads": 1} | {
            "splats": {"steps": 300}, "octree": {"steps": 150}, "field": {"steps": 60}}  # fmt: skip
        config.write_text(yaml.safe_dump(settings))
        if data is None:
            data = write_scene(folder / "data", {"train": 12, "val": 2, "test": 2})
        self.places = {"MADE": self.made, "DATA": data, "CONFIG": config}

    def argv(self, command: str, out: Path) -> str:
        """The command with its places."""
        places = {**self.places, "OUT": out}
        words = (
            "/".join(str(places.get(part, part)) for part in word.split("/")) if "/" in word or word in places else word
            for word in command.split()
        )
        return " ".join(words)

    def attempt(self, row: Row, out: Path, said: Path, after: float | None = None, number: int = 0) -> int:
        """One try of the row's command, or of its resuming; the exit code, negative for a signal."""
        said.write_text("")  # a child that is killed at once has made none
        resumes = row.resume and (out / CHECKPOINT).is_file()
        return attempt(self.argv(row.resume if resumes else row.command, out), after, number, said)

    def whole(self, row: Row) -> float:
        """Runs it undisturbed, once; the seconds it took."""
        out = self.made / row.name / OUT
        out.mkdir(parents=True)
        began, said = time.monotonic(), self.made / row.name / "said"
        if code := self.attempt(row, out, said):
            raise SystemExit(f"{row.name} ends with {code} even undisturbed: {said.read_text()}")
        return time.monotonic() - began

    def check(self, row: Row, out: Path, what: str) -> None:
        """What came out against the undisturbed."""
        expected, got = ({path.relative_to(top): path.read_bytes() for path in top.rglob(row.names) if path.is_file()}
                         for top in (self.made / row.name / OUT, out))  # fmt: skip
        if not expected or expected.keys() != got.keys():
            self.finds.append(f"{row.name}: {what}: {len(got)} of {len(expected)} files")
        for path in expected.keys() & got.keys():
            if expected[path] != got[path]:
                self.finds.append(f"{row.name}: {what}: {path} is not the undisturbed one's to the byte")
        if left := [path.name for path in out.rglob(".*")]:
            self.finds.append(f"{row.name}: {what}: left behind: {', '.join(left)}")

    def kill(self, row: Row, seconds: float, rng: random.Random) -> int:
        """Kills it until it ends by itself; how often it was killed."""
        out, said = self.folder / "killed" / OUT, self.folder / "killed" / "said"
        out.mkdir(parents=True)
        moments, code = [], -1
        for left in range(MOST_KILLS, -1, -1):
            after, number = rng.uniform(0, 1.5 * seconds / max(left, 1)), rng.choice(SIGNALS)
            code = self.attempt(row, out, said, after if left else None, number)
            if code == 0:
                break
            moments.append(f"{number.name} after {after:.2f} s")
            if "Traceback" in said.read_text():
                self.finds.append(f"{row.name}: {moments[-1]}: {said.read_text()[-300:]}")
        else:
            self.finds.append(f"{row.name}: {moments}: does not go on ({code}): {said.read_text()[-300:]}")
        if code == 0:
            self.check(row, out, ", ".join(moments) or "not killed")
        shutil.rmtree(self.folder / "killed")
        return len(moments)

    def fill(self, row: Row, rng: random.Random) -> int:
        """Runs it on a disk that is too small, which grows; how often it was full."""
        used = sum(path.stat().st_size for path in (self.made / row.name / OUT).rglob("*") if path.is_file())
        disk, said = self.folder / "disk", self.folder / "disk-said"
        disk.mkdir()
        size, full = int(used * rng.uniform(0, 1.2)), 0
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={max(size, 4096)}", "tmpfs", str(disk)], check=True)
        try:
            out = disk / OUT
            while code := self.attempt(row, out, said):
                full += 1
                text = said.read_text()
                if code != 2 or "Traceback" in text or "no space" not in text:
                    self.finds.append(f"{row.name}: a disk of {size} bytes: exit code {code}: {text[-300:]}")
                if left := [path.name for path in disk.rglob(".*")]:
                    self.finds.append(f"{row.name}: a disk of {size} bytes: left behind: {', '.join(left)}")
                if size > 8 * used + (64 << 20):
                    break
                size = int(size * rng.uniform(1.2, 2)) + 4096
                subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)
            if code == 0:
                self.check(row, out, f"a disk that was full {full} times, of {size} bytes at last")
            else:
                self.finds.append(f"{row.name}: does not go on with {size} bytes")
        finally:
            subprocess.run(["umount", str(disk)], check=True)
            disk.rmdir()
        return full

    def run(self, rows: list[Row], has_disks: bool) -> None:
        """All of the rows, each with a generator of its own, so that one alone repeats what it did among all."""
        for row in rows:
            if not (self.made / row.name).is_dir():
                self.whole(row)
            rng = random.Random(f"{self.seed} {row.name}")
            before = len(self.finds)
            began = time.monotonic()
            self.whole_again(row)
            seconds = time.monotonic() - began
            kills = sum(self.kill(row, seconds, rng) for _ in range(self.rounds))
            full = sum(self.fill(row, rng) for _ in range(self.rounds)) if has_disks else 0
            print(f"{row.name}: {kills} kills, {full} full disks, {len(self.finds) - before} finds", flush=True)

    def whole_again(self, row: Row) -> None:
        """A second undisturbed run: what differs already then says nothing of faults. It is also the one that is timed."""
        out = self.folder / "again" / OUT
        out.mkdir(parents=True)
        code = self.attempt(row, out, self.folder / "again" / "said")
        if code:
            self.finds.append(f"{row.name}: a second run ends with {code}")
        else:
            self.check(row, out, "a second run in peace")
        shutil.rmtree(self.folder / "again")


def needed(rows: list[Row]) -> list[Row]:
    """Those of the table whose results ``rows`` read."""
    return [row for row in ROWS if any(f"MADE/{row.name}/" in other.command for other in rows)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=4, help="kills and full disks of each command, begun so often")
    parser.add_argument("--data", type=Path, help="posed images instead of the sphere")
    parser.add_argument("--downscale", type=int, default=8, help="of --data")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(row.name for row in ROWS)}")
    options = parser.parse_args()
    if sys.platform == "linux" and "NERFVOL_FAULTS" not in os.environ and shutil.which("unshare"):
        command = ["unshare", "-rm", "--", sys.executable]
        if subprocess.run([*command, "-c", ""], capture_output=True).returncode == 0:
            os.environ["NERFVOL_FAULTS"] = "disks"
            os.execvp(command[0], [*command, *sys.argv])
    has_disks = os.environ.get("NERFVOL_FAULTS") == "disks"
    if not has_disks:
        print("no full disks: this system lets nobody mount one in a namespace")
    rows = [row for row in ROWS if not options.names or row.name in options.names]
    with tempfile.TemporaryDirectory() as folder:
        faults = Faults(Path(folder), options.seed, options.rounds, options.data, options.downscale)
        for row in needed(rows):
            faults.whole(row)
        faults.run(rows, has_disks)
    for find in faults.finds:
        print(f"FIND (seed {options.seed}) {find}")
    return 1 if faults.finds else 0


if __name__ == "__main__":
    sys.exit(main())
