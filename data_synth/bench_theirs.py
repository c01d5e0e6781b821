"""Mitsuba 3 and its fork on the benchmark's cloud: numbers in, pictures out. Numpy and mitsuba are all it imports, so that it
also runs as a script, in an environment that has no data_synth: ``python bench_theirs.py IN.npz OUT.npz VARIANT SPP RUNS``.

The fork [eradiate-mitsuba] cuts a medium's box into cells with majorants of their own (``extremum_grid``), as data_synth does;
its own integrator, ``eovolpath``, looks at them, ``volpath`` does not.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

LOCAL = 2
"""Majorants along eight cells of the grid: 1, 2 and 4 took the same time."""


def scene_of(mi: Any, n: Mapping[str, np.ndarray], spp: int, local: int = 0) -> Any:
    """The scene for the variant that is set. n: ``bench_mitsuba.numbers``; local: cells of a majorant along a side of eight
    of the grid's, 0 for one majorant for all, as Mitsuba has it."""
    t = mi.ScalarTransform4f
    lo, hi, rho = n["lo"], n["hi"], n["density"]
    middle, half, shape = (lo + hi) / 2, (hi - lo) / 2, np.array(rho.shape)
    # their samples stand at the centres of cells, ours at the corners of the box
    stretched = (hi - lo) * shape / (shape - 1.0)
    placed = t().translate((middle - stretched / 2).tolist()).scale(stretched.tolist())
    grid = np.ascontiguousarray(rho.transpose(2, 1, 0)[..., None])
    sigma: dict[str, Any] = {
        "type": "gridvolume",
        "wrap_mode": "clamp",
        "grid": mi.VolumeGrid(grid),
        "to_world": placed,
    }
    medium: dict[str, Any] = {
        "type": "heterogeneous", "albedo": float(n["albedo"]), "scale": float(n["sigma_t"]), "sigma_t": sigma,
        "phase": {"type": "hg", "g": float(n["g"])},
    }  # fmt: skip
    size, integrator = int(n["size"]), "eovolpath" if local else "volpath"
    if local:
        # the structure wants the volume's transform again: without it the picture is silently wrong
        medium["sigma_t"] = volume = mi.load_dict(sigma)
        medium["extremum"] = {
            "type": "extremum_grid", "volume": volume, "to_world": placed, "scale": float(n["sigma_t"]),
            "resolution": (local * np.maximum(shape // 8, 1)).tolist(),
        }  # fmt: skip
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": int(n["depth"]) + 1, "rr_depth": 6, "hide_emitters": True},
        "sensor": {
            "type": "perspective", "fov": float(n["fov"]),
            "to_world": t().look_at(origin=n["eye"].tolist(), target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": spp},
        },
        "sun": {
            "type": "directional", "direction": n["towards"].tolist(),
            "irradiance": {"type": "rgb", "value": n["irradiance"].tolist()},
        },
        "cube": {
            "type": "cube", "to_world": t().translate(middle.tolist()).scale(half.tolist()), "bsdf": {"type": "null"},
            "interior": medium,
        },
    })  # fmt: skip


def timed(render: Callable[[int], np.ndarray], runs: int) -> tuple[np.ndarray, np.ndarray]:
    """(pictures of ``runs`` seeds, (runs, 2) wall and CPU seconds of each)."""
    pictures, taken = [], []
    for seed in range(runs):
        wall, cpu = time.perf_counter(), time.process_time()
        pictures.append(render(seed))
        taken.append((time.perf_counter() - wall, time.process_time() - cpu))
    return np.array(pictures), np.array(taken)


def rendered(
    mi: Any, n: Mapping[str, np.ndarray], spp: int, runs: int, local: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """``timed``, for the variant that is set."""
    scene = scene_of(mi, n, spp, local)
    return timed(lambda seed: np.array(mi.render(scene, seed=mi.UInt32(seed)))[..., :3], runs)


def main(source: str, target: str, variant: str, spp: str, runs: str) -> None:
    """The fork's row."""
    import mitsuba as mi

    mi.set_variant(variant)
    with np.load(source, allow_pickle=False) as numbers:
        pictures, taken = rendered(mi, dict(numbers), int(spp), int(runs), LOCAL)
    np.savez(target, pictures=pictures, taken=taken, version=np.array(mi.__version__), variant=np.array(variant))


if __name__ == "__main__":
    main(*sys.argv[1:])
