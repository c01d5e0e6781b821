"""Builds of the kernels against each other on one octree, interleaved: milliseconds of thread time a step and a frame.

    PYTHONPATH=. python tools/compare_builds.py OCTREE gcc=build/dev clang=build/clang

Each build runs in a process of its own, on one thread, while the others wait; what is printed is the least of all rounds, so
that a busy machine says the same as an idle one, and its ratio to the last build.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time

WORK = ("train", "statistics", "frame")
VIEWS = (0.3, 1.87, 3.44)  # angles on a circle around the octree
TILES = 320


def work(path: str, degree: int) -> None:
    """Answers lines "build work view" on stdin with seconds, the least of three."""
    import numpy as np

    from nerfvol.cameras.camera import Camera, Intrinsics, look_at
    from nerfvol.kernels import ops
    from nerfvol.measure.bench import _batch
    from nerfvol.octree.io import load_octree
    from nerfvol.views import render_image

    ops.set_threads(1)
    octree = load_octree(path)[0]
    octree = octree if degree < 0 else octree.with_sh_degree(degree)
    centre, lens = octree.origin + octree.size / 2, Intrinsics(400, 400, 480, 480, 200, 200)
    eyes = [centre + octree.size * np.array([math.cos(a), math.sin(a), 0.5]) for a in VIEWS]
    cameras = [Camera(lens, look_at(eye, centre, (0.0, 0.0, 1.0))) for eye in eyes]
    batches = [_batch(octree, camera, seed, TILES) for seed, camera in enumerate(cameras)]
    options = ops.LossOptions(colour=0.03, distortion=0.01, tv_density=6e-5, tv_sh=6e-5)
    state, still, angle = ops.TrainState(octree), ops.Rates(density=0.0, dc=0.0, sh=0.0), 1 / lens.fx
    tasks = {
        "train": lambda view: ops.train_step(octree, state, batches[view], options, still, angle),
        "statistics": lambda view: ops.leaf_statistics(octree, batches[view], options, angle, state),
        "frame": lambda view: render_image(octree, cameras[view]),
    }
    print(*ops.available_isas(), flush=True)
    for line in sys.stdin:
        isa, task, view = line.split()
        ops.set_isa(isa)
        seconds = []
        for _ in range(3):
            started = time.thread_time()
            tasks[task](int(view))
            seconds.append(time.thread_time() - started)
        print(min(seconds), flush=True)


def compare(path: str, builds: dict[str, str], degree: int, rounds: int) -> None:
    """Starts a process for each build, asks them interleaved and prints a line for each instruction set and kind of work."""
    workers, isas = {}, []
    for name, folder in builds.items():
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")]))
        command = [sys.executable, __file__, path, "--work", "--degree", str(degree)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        workers[name] = subprocess.Popen(command, env=environment, **pipes)
        isas = workers[name].stdout.readline().split()
    least: dict[tuple[str, str, str, int], float] = {}
    for _ in range(rounds):
        for key in ((isa, task, name, view) for isa in isas for task in WORK for view in range(3) for name in builds):
            isa, task, name, view = key
            print(isa, task, view, file=workers[name].stdin, flush=True)
            least[key] = min(least.get(key, math.inf), float(workers[name].stdout.readline()))
    for isa in isas:
        for task in WORK:
            row = {name: sum(least[isa, task, name, view] for view in range(3)) / 3 for name in builds}
            last = list(row.values())[-1]
            print(f"{isa:9}{task:11}", *(f"{name} {1e3 * s:.2f} ms ({s / last:.2f})" for name, s in row.items()))
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("octree")
    parser.add_argument("builds", nargs="*", metavar="NAME=FOLDER")
    parser.add_argument("--degree", type=int, default=-1, help="SH degree to measure with; -1: the octree's own")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_intermixed_args()
    if given.work:
        work(given.octree, given.degree)
    else:
        compare(given.octree, dict(build.split("=", 1) for build in given.builds), given.degree, given.rounds)


if __name__ == "__main__":
    main()
