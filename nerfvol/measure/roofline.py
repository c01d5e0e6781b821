"""What this machine allows at most: memory bandwidth and float32 arithmetic against the least that a ray can cost.

A roofline [Williams, Waterman & Patterson 2009, doi:10.1145/1498765.1498785]: a rate can exceed neither
bandwidth / bytes nor peak / operations. The bytes are those of every array element that has to be touched, each counted
once; nothing is added for cache lines fetched in vain or fetched twice. The bound by bandwidth supposes that nothing
stays in a cache from one frame (step) to the next: an octree that fits into the cache may pass it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from nerfvol.cameras.camera import Camera, tile_pixels, tile_rays
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.kernels.state import TILE_RAYS
from nerfvol.octree.rows import BLOCKS
from nerfvol.octree.tree import Octree

STREAM_BYTES = 256 << 20
"""Of each of two arrays, all threads together: far larger than a last-level cache."""
MATRIX = 1024
TRIALS = 7
"""The best counts: a limit is what the machine can do, not what it usually does."""
FRAME_TILES = 512
"""Tiles that are looked at together; more would only need more memory."""

ROW_BYTES = 64
"""A block of a vertex row: 16 float32."""
CORNER_BYTES = 32
"""The eight vertex numbers of a leaf."""
STATISTICS_BYTES = 24
"""Three float32 a leaf, read and written."""
RENDER_RAY_BYTES = 24
"""Direction in, colour out."""
TRAIN_RAY_BYTES = 28
"""Direction, target and weight in."""
FORWARD_OPERATIONS = 256
"""Per segment and block: seven multiply-adds on 16 numbers and the products with the ray's harmonics, added up."""
BACKWARD_OPERATIONS = 272
"""Per segment and block: gradient times harmonics, and eight corners' multiply-adds on 16 numbers."""


@dataclass(frozen=True)
class Machine:
    """read, copy: bytes/s of memory (a copy counts both ways); operations: float32 operations/s; of that many threads."""

    read: float
    copy: float
    operations: float
    threads: int

    @property
    def bandwidth(self) -> float:
        """The larger of both rates, bytes/s."""
        return max(self.read, self.copy)


@dataclass(frozen=True)
class Work:
    """Rays, segments, and the distinct leaves and vertices they touch."""

    rays: int
    segments: float
    leaves: int
    vertices: int


@dataclass(frozen=True)
class Cost:
    """Least bytes moved and float32 operations of a frame or a training step."""

    bytes: float
    operations: float


# ------------------------------------------------------------------ the machine
def measure_machine(threads: int) -> Machine:
    """Bandwidth and float32 rate of ``threads`` threads, in a process of its own, where BLAS starts no more of them.

    Raises:
        InputError: that process failed.
    """
    single = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL", "BLIS")} | {
        "VECLIB_MAXIMUM_THREADS": "1"
    }
    command = [sys.executable, "-m", "nerfvol.measure.roofline", str(threads)]
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, **single, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"the machine's speed could not be measured: {done.stderr.strip().splitlines()[-1]}")
    return Machine(**json.loads(done.stdout))


def _measure_here(threads: int) -> Machine:
    n = max(STREAM_BYTES // threads // 4, 1 << 20)
    a, b = ([np.ones(n, np.float32) for _ in range(threads)] for _ in range(2))
    factors = [np.ones((MATRIX, MATRIX), np.float32) for _ in range(threads)]
    products = [np.empty((MATRIX, MATRIX), np.float32) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:

        def rate(task: Callable[[int], object], work: float) -> float:
            seconds = []
            for _ in range(TRIALS):
                started = time.perf_counter()
                list(pool.map(task, range(threads)))
                seconds.append(time.perf_counter() - started)
            return threads * work / min(seconds)

        return Machine(
            read=rate(lambda t: a[t].max(), 4 * n),
            copy=rate(lambda t: np.copyto(a[t], b[t]), 8 * n),
            operations=rate(lambda t: np.matmul(factors[t], factors[t], out=products[t]), 2 * MATRIX**3),
            threads=threads,
        )


# ------------------------------------------------------------------ what rays need
def touched(octree: Octree, batches: Iterable[ops.Batch], pixel_angle: float) -> Work:
    """What the rays of all ``batches`` touch together; ``octree`` stays as it is."""
    statistics, options = ops.LeafStatistics(octree), ops.LossOptions()
    rays, segments = 0, 0.0
    for batch in batches:
        report = ops.leaf_statistics(octree, batch, options, pixel_angle, statistics)
        rays += int(np.count_nonzero(batch.weight))
        segments += report.samples * len(batch.rays_d)
    met = statistics.footprint > 0  # of every leaf that a ray crosses, whatever its weight
    vertices = np.zeros(octree.n_vertices, bool)
    vertices[octree.corners[met]] = True
    return Work(rays, segments, int(np.count_nonzero(met)), int(np.count_nonzero(vertices)))


def view_batches(camera: Camera) -> Iterable[ops.Batch]:
    """All pixels of a view, a number of tiles at a time."""
    lens = camera.intrinsics
    tiles, rays = tile_pixels(lens.width, lens.height), tile_rays(lens.width, lens.height)
    origin, directions = camera.rays()
    for first in range(0, len(tiles), FRAME_TILES):
        pixels = tiles[first : first + FRAME_TILES].reshape(-1)
        origins = np.broadcast_to(origin, (len(pixels) // TILE_RAYS, 3)).copy()
        yield ops.Batch(
            origins,
            directions[rays[first : first + FRAME_TILES].reshape(-1)],
            np.zeros((len(pixels), 3), np.float32),
            (pixels >= 0).astype(np.float32),
        )


def frame_cost(work: Work, sh_degree: int) -> Cost:
    """Rows and corners read once, directions in and colours out; the field at each segment."""
    blocks = BLOCKS[sh_degree]
    moved = ROW_BYTES * blocks * work.vertices + CORNER_BYTES * work.leaves + RENDER_RAY_BYTES * work.rays
    return Cost(moved, FORWARD_OPERATIONS * blocks * work.segments)


def step_cost(work: Work, sh_degree: int) -> Cost:
    """Rows and their moments read and written once, corners and statistics of leaves; field and gradient of segments."""
    blocks = BLOCKS[sh_degree]
    per_leaf = CORNER_BYTES + STATISTICS_BYTES
    moved = 4 * ROW_BYTES * blocks * work.vertices + per_leaf * work.leaves + TRAIN_RAY_BYTES * work.rays
    return Cost(moved, (FORWARD_OPERATIONS + BACKWARD_OPERATIONS) * blocks * work.segments)


def limits(cost: Cost, machine: Machine) -> dict[str, float]:
    """Frames (steps) a second that bandwidth and arithmetic allow."""
    return {"bandwidth": machine.bandwidth / cost.bytes, "arithmetic": machine.operations / cost.operations}


def roofs(octree: Octree, view: Camera, batch: ops.Batch, machine: Machine) -> dict[str, float]:
    """Frames of ``view`` and training rays a second that this machine allows at most, and the bytes behind them."""
    angle = 1.0 / view.intrinsics.fx
    frame = frame_cost(touched(octree, view_batches(view), angle), octree.sh_degree)
    trained = touched(octree, [batch], angle)
    step = step_cost(trained, octree.sh_degree)
    frames, steps = limits(frame, machine), limits(step, machine)
    return {
        "frame_bytes": frame.bytes,
        "frame_operations": frame.operations,
        "train_ray_bytes": step.bytes / trained.rays,
        "train_ray_operations": step.operations / trained.rays,
        "frames_per_second_by_bandwidth": frames["bandwidth"],
        "frames_per_second_by_arithmetic": frames["arithmetic"],
        "train_rays_per_second_by_bandwidth": steps["bandwidth"] * trained.rays,
        "train_rays_per_second_by_arithmetic": steps["arithmetic"] * trained.rays,
    }


def fitted_exponent(leaves: Sequence[float], seconds: Sequence[float]) -> float | None:
    """The p of seconds = c leaves^p by least squares of the logarithms; None for fewer than two sizes."""
    if len(set(leaves)) < 2:
        return None
    return float(np.polyfit(np.log(leaves), np.log(seconds), 1)[0])


if __name__ == "__main__":
    measured = _measure_here(int(sys.argv[1]))
    print(json.dumps(vars(measured)))
