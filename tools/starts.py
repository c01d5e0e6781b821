"""Which start is best for an octree, by measurement: a row a number of views and a budget, a column a start.

    python tools/starts.py DATA OUT [--downscale 2] [--views 100,16,8,4] [--budgets 10s,30s,1m,2m] [--starts fog,field,splats]
        [--busy] [--background white]

Of the N training views of DATA n are taken: with transforms_train.json every (N // n)-th, of photographs n evenly chosen ones.
fog: ``train --init direct``; field: ``train --init mlp``; splats: trained for 0.4 of the budget, then ``convert --to octree``
and trained for the rest; ``octree`` (the start that ``train`` chooses for one), ``auto`` (the representation that it chooses),
``field-alone`` and ``splats-alone`` can be asked for too. Each command is one that a person could type; held-out views are
scored afterwards, by ``nerfvol eval``, outside of the budget. What is in OUT/starts.json already is not run again.

--busy: where other work shares the processor, every clock of the runs counts CPU seconds / 1.6, about what two threads of a
quiet machine take (one with --threads 1); what is said of seconds then means those.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from nerfvol.config.parsers import seconds as seconds_of
from nerfvol.datasets.dataset import evenly

BUSY = 1.6
"""CPU seconds that two threads take in a second of a quiet machine, loading included."""
SPLATS_SHARE = 0.4


def on_cpu_clock(argv: list[str]) -> None:
    """nerfvol's command line, with a clock of CPU seconds."""
    import runpy
    import time

    import nerfvol.machine

    def clock() -> float:
        return time.process_time() / BUSY

    time.perf_counter = clock
    nerfvol.machine.process_seconds = clock  # before anything takes it from there
    sys.argv = ["nerfvol", *argv]
    runpy.run_module("nerfvol", run_name="__main__")


def subset(data: Path, out: Path, n: int) -> Path:
    """A folder of ``data`` with n of its training views, evenly chosen, and all that are held out; made once."""
    if not (data / "transforms_train.json").is_file():
        return subset_of_photographs(data, out, n)
    listed: dict[str, Any] = json.loads((data / "transforms_train.json").read_text())
    if n > len(listed["frames"]):
        raise SystemExit(f"starts: --views: {data} has {len(listed['frames'])} training views, got {n}")
    every = len(listed["frames"]) // n
    folder = out / f"{data.name}_{n}"
    folder.mkdir(parents=True, exist_ok=True)
    for entry in data.iterdir():
        link = folder / entry.name
        if entry.name != "transforms_train.json" and not link.exists():
            link.symlink_to(entry.resolve())
    frames = listed["frames"][: every * n : every]
    (folder / "transforms_train.json").write_text(json.dumps({**listed, "frames": frames}))
    return folder


def subset_of_photographs(data: Path, out: Path, n: int) -> Path:
    """The same of photographs, by lists of names beside them."""
    from nerfvol.datasets.load import load_dataset

    training, held_out = (load_dataset(data, split).names for split in ("train", "val"))
    if not 1 < n <= len(training):
        raise SystemExit(f"starts: --views: {data} has {len(training)} training views, got {n}")
    folder = out / f"{data.name}_{n}"
    folder.mkdir(parents=True, exist_ok=True)
    lists = {"train.txt": [training[i] for i in evenly(len(training), n)], "val.txt": held_out}
    for entry in data.iterdir():  # the data's own lists are not linked to, for they would be written over
        if entry.name not in lists and not (folder / entry.name).exists():
            (folder / entry.name).symlink_to(entry.resolve())
    for name, names in lists.items():
        (folder / name).write_text("\n".join(names))
    return folder


def commands(start: str, data: Path, out: Path, seconds: float, common: list[str]) -> tuple[list[list[str]], Path]:
    """nerfvol's commands for a cell, and the model that comes of them."""

    def train(representation: str, budget: float, *more: str) -> list[str]:
        return ["train", "--data", str(data), "--out", str(out / representation), "--representation", representation,
                "--time-budget", f"{budget:g}s", *common, *more]  # fmt: skip

    if start in ("fog", "field"):
        return [train("octree", seconds, "--init", "direct" if start == "fog" else "mlp")], out / "octree"
    if start in ("auto", "octree"):
        return [train(start, seconds)], out / start
    if start in ("field-alone", "splats-alone"):
        kind = start.split("-")[0]
        return [train(kind, seconds)], out / kind
    first, model = SPLATS_SHARE * seconds, out / "octree.safetensors"
    convert = ["convert", str(out / "splats"), "--to", "octree", "--data", str(data), "--out", str(model),
               "--time-budget", f"{seconds - first:g}s", *common]  # fmt: skip
    return [train("splats", first), convert], model


def cell(start: str, data: Path, out: Path, seconds: float, common: list[str], busy: bool) -> dict[str, float]:
    """PSNR, SSIM and the seconds of CPU of all that a cell's commands did."""
    out.mkdir(parents=True, exist_ok=True)
    wanted, model = commands(start, data, out, seconds, common)
    scores = out / "scores.json"
    score = ["eval", str(model), "--data", str(data), *common, "--json", str(scores)]
    before = os.times()
    for arguments in wanted:
        head = [sys.executable, __file__, "--on-cpu-clock"] if busy else [sys.executable, "-m", "nerfvol"]
        subprocess.run([*head, *arguments], check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    subprocess.run([sys.executable, "-m", "nerfvol", *score], check=True, stdout=subprocess.DEVNULL)
    read = json.loads(scores.read_text())
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {"psnr": read["psnr"], "ssim": read["ssim"], "cpu_seconds": cpu, "seconds": after.elapsed - before.elapsed}


def table(results: dict[str, dict[str, float]], starts: list[str]) -> str:
    """What was measured, in Markdown; the best of a row is bold."""
    lines = ["| views, budget | " + " | ".join(starts) + " |", "|---" * (len(starts) + 1) + "|"]
    for row in dict.fromkeys(key.rsplit("/", 1)[0] for key in results):
        held = {start: results.get(f"{row}/{start}") for start in starts}
        best = max((r["psnr"] for r in held.values() if r), default=0.0)
        cells = ["–" if not r else f"{'**' * (r['psnr'] == best)}{r['psnr']:.2f}{'**' * (r['psnr'] == best)} / {r['ssim']:.3f}"
                 for r in held.values()]  # fmt: skip
        lines.append(f"| {row.replace('/', ' views, ')} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    """Run what is missing, and print the table after each cell."""
    if argv[:1] == ["--on-cpu-clock"]:
        on_cpu_clock(argv[1:])
        return 0
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("data", type=Path)
    p.add_argument("out", type=Path)
    p.add_argument("--downscale", default="2")
    p.add_argument("--background", default="white")
    p.add_argument("--views", default="100,16,8,4")
    p.add_argument("--budgets", default="10s,30s,1m,2m")
    p.add_argument("--starts", default="fog,field,splats")
    p.add_argument("--busy", action="store_true")
    given = p.parse_args(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    path, starts = given.out / "starts.json", given.starts.split(",")
    results: dict[str, dict[str, float]] = json.loads(path.read_text()) if path.exists() else {}
    common = ["--downscale", given.downscale, "--background", given.background]
    for n in map(int, given.views.split(",")):
        data = subset(given.data, given.out, n)
        for budget in given.budgets.split(","):
            for start in starts:
                key = f"{n}/{budget}/{start}"
                if key not in results:
                    folder = given.out / key.replace("/", "_")
                    results[key] = cell(start, data, folder, seconds_of(budget), common, given.busy)
                    path.write_text(json.dumps(results, indent=1))
                    print(f"\n{table(results, starts)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
