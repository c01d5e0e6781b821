"""The cumulus of ``bench.py`` in Mitsuba 3, next to the path tracer: ``nerfvol synth bench mitsuba``.

Wants ``pip install mitsuba``. ``llvm_ad_rgb`` also wants an LLVM library of version 15 or later that Dr.Jit can use,
named by DRJIT_LIBLLVM_PATH; without one that line says why it is missing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from data_synth import media
from data_synth.cameras import Camera
from data_synth.errors import InputError
from data_synth.integrators import Path
from data_synth.scene import Scene

SIZE, DEPTH, RUNS = 256, 64, 8


def theirs(mi: ModuleType, scene: Scene, camera: Camera, spp: int) -> Any:
    """The scene as Mitsuba's, for the variant that is set."""
    m, t = scene.medium, mi.ScalarTransform4f
    if not isinstance(m, media.Medium):
        raise InputError(f"bench mitsuba: expected a scene with one grey medium, {scene.name} has none")
    lo, hi, n = np.array(m.lo), np.array(m.hi), np.array(m.cells) + 1
    middle, half = (lo + hi) / 2, (hi - lo) / 2
    # their samples stand at the centres of cells, ours at the corners of the box
    stretched = (hi - lo) * n / (n - 1.0)
    rho = np.ascontiguousarray(media.dense(m).transpose(2, 1, 0)[..., None])
    sun = scene.lights[0]
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": DEPTH + 1, "rr_depth": 6, "hide_emitters": True},
        "sensor": {
            "type": "perspective", "fov": scene.viewpoints.fov,
            "to_world": t().look_at(origin=camera.c2w[:3, 3].tolist(), target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": spp},
        },
        "sun": {
            "type": "directional", "direction": (-sun[7:10]).tolist(),
            "irradiance": {"type": "rgb", "value": sun[4:7].tolist()},
        },
        "cube": {
            "type": "cube", "to_world": t().translate(middle.tolist()).scale(half.tolist()), "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous", "albedo": float(m.albedo[0, 0]), "scale": m.sigma_t[0],
                "phase": {"type": "hg", "g": m.phase.g1},
                "sigma_t": {
                    "type": "gridvolume", "wrap_mode": "clamp", "grid": mi.VolumeGrid(rho),
                    "to_world": t().translate((middle - stretched / 2).tolist()).scale(stretched.tolist()),
                },
            },
        },
    })  # fmt: skip


def row(name: str, spp: int, render: Callable[[int], np.ndarray]) -> None:
    """A row from RUNS pictures with different seeds; the first run, which may compile, is not timed."""
    pictures, taken = [], []
    for seed in range(RUNS):
        wall, cpu = time.perf_counter(), time.process_time()
        pictures.append(render(seed))
        taken.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = np.median(taken[1:], axis=0)
    variance = np.var(pictures, axis=0, ddof=1).mean()
    means = np.mean(pictures, axis=(1, 2, 3))
    spread = means.std(ddof=1) / np.sqrt(RUNS)
    print(
        f"| {name} | {spp} | {wall:.2f} | {cpu:.2f} | {means.mean():.4f} ± {spread:.4f} | {variance:.2f} "
        f"| {variance * cpu:.2f} |",
        flush=True,
    )


def main(scene: Scene) -> None:
    """Path tracing to 64 events by data_synth and by Mitsuba's variants, in one run."""
    try:
        import mitsuba as mi
    except ImportError as error:
        raise InputError("bench mitsuba: mitsuba is not installed, expected 'pip install mitsuba'") from error
    camera = scene.viewpoints.camera(-55, 22, SIZE, SIZE)
    print(f"\npath tracing to {DEPTH} events, one sun, {SIZE}x{SIZE}; Mitsuba {mi.__version__} volpath")
    print("| renderer | paths a pixel | wall s | CPU s | mean | variance of a pixel | variance × CPU s |")
    print("|---|---|---|---|---|---|---|")
    for name, path in (
        ("data_synth, C++", Path(spp=4, max_depth=DEPTH)),
        ("data_synth, textbook", Path(spp=4, max_depth=DEPTH, textbook=True)),
    ):
        row(name, 4, lambda seed, path=path: path.render(scene, camera, seed).rgb)
    for variant, spp in (("llvm_ad_rgb", 4), ("scalar_rgb", 4)):
        try:
            mi.set_variant(variant)
            loaded = theirs(mi, scene, camera, spp)
        except ImportError as error:
            print(f"{variant} cannot be used: {error}")
            continue
        row(variant, spp, lambda seed, loaded=loaded: np.array(mi.render(loaded, seed=mi.UInt32(seed)))[..., :3])
