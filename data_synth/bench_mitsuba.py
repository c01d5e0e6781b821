"""The cumulus of ``bench.py`` in Mitsuba 3, next to the path tracer: ``nerfvol synth bench mitsuba [--fork PYTHON]``.

Wants ``pip install mitsuba``. PYTHON: of another environment, with ``pip install eradiate-mitsuba`` (both bring the module
``mitsuba``), the fork with local majorants. ``llvm_ad_rgb`` also wants an LLVM library of version 15 or later that Dr.Jit can
use, named by DRJIT_LIBLLVM_PATH; without one that line says why it is missing.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path as Folder

import numpy as np

from data_synth import bench_theirs, media
from data_synth.cameras import Camera
from data_synth.errors import InputError
from data_synth.integrators import Path
from data_synth.scene import Scene

SIZE, DEPTH, RUNS = 256, 64, 8
VARIANTS = ("llvm_ad_rgb", "scalar_rgb")


def numbers(scene: Scene, camera: Camera) -> dict[str, np.ndarray]:
    """What ``bench_theirs.scene_of`` makes the scene of."""
    m, sun = scene.medium, scene.lights[0]
    if not isinstance(m, media.Medium):
        raise InputError(f"bench mitsuba: expected a scene with one grey medium, {scene.name} has none")
    given = {
        "density": media.dense(m), "lo": m.lo, "hi": m.hi, "sigma_t": m.sigma_t[0], "albedo": m.albedo[0, 0], "g": m.phase.g1,
        "towards": -sun[7:10], "irradiance": sun[4:7], "eye": camera.c2w[:3, 3], "fov": scene.viewpoints.fov,
        "size": camera.width, "depth": DEPTH,
    }  # fmt: skip
    return {name: np.asarray(value) for name, value in given.items()}


def row(name: str, spp: int, pictures: np.ndarray, taken: np.ndarray) -> None:
    """A row from pictures with different seeds and their wall and CPU seconds; the first, which may compile, is not timed."""
    wall, cpu = np.median(taken[1:], axis=0)
    variance = np.var(pictures, axis=0, ddof=1).mean()
    means = np.mean(pictures, axis=(1, 2, 3))
    spread = means.std(ddof=1) / np.sqrt(len(means))
    print(
        f"| {name} | {spp} | {wall:.2f} | {cpu:.2f} | {means.mean():.4f} ± {spread:.4f} | {variance:.2f} "
        f"| {variance * cpu:.2f} |",
        flush=True,
    )


def fork(python: str, given: dict[str, np.ndarray]) -> None:
    """Rows of eradiate-mitsuba, which cannot live in one environment with mitsuba: ``python`` is the interpreter of another."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Folder(folder) / "scene.npz", Folder(folder) / "pictures.npz"
        np.savez(source, **given)  # pyright: ignore[reportArgumentType]
        for variant in VARIANTS:
            command = [python, bench_theirs.__file__, str(source), str(target), variant, "4", str(RUNS)]
            try:
                done = subprocess.run(command, capture_output=True, text=True)
            except OSError as error:
                raise InputError(f"bench mitsuba: {python} cannot be run: {error.strerror}") from error
            if done.returncode:
                why = (done.stderr.strip().splitlines() or ["no word"])[-1]
                print(f"{variant} of the fork cannot be used: {why}")
                continue
            with np.load(target, allow_pickle=False) as made:
                name = f"eradiate-mitsuba `{variant}`, local majorants (Mitsuba {made['version']})"
                row(name, 4, made["pictures"], made["taken"])


def main(scene: Scene, python: str | None = None, size: int = SIZE) -> None:
    """Path tracing to 64 events by data_synth, by Mitsuba's variants and by its fork's, in one run."""
    try:
        import mitsuba as mi
    except ImportError as error:
        raise InputError("bench mitsuba: mitsuba is not installed, expected 'pip install mitsuba'") from error
    if python is not None and shutil.which(python) is None:
        raise InputError(f"bench mitsuba: --fork expects a Python interpreter, {python} is none that can be run")
    camera = scene.viewpoints.camera(-55, 22, size, size)
    given = numbers(scene, camera)
    print(f"\npath tracing to {DEPTH} events, one sun, {size}x{size}; Mitsuba {mi.__version__} volpath")
    print("| renderer | paths a pixel | wall s | CPU s | mean | variance of a pixel | variance × CPU s |")
    print("|---|---|---|---|---|---|---|")
    for name, path in (
        ("data_synth, C++", Path(spp=4, max_depth=DEPTH)),
        ("data_synth, textbook", Path(spp=4, max_depth=DEPTH, textbook=True)),
    ):
        row(name, 4, *bench_theirs.timed(lambda seed, path=path: path.render(scene, camera, seed).rgb, RUNS))
    for variant in VARIANTS:
        try:
            mi.set_variant(variant)
            found = bench_theirs.rendered(mi, given, 4, RUNS)
        except ImportError as error:
            print(f"{variant} cannot be used: {error}")
            continue
        row(f"Mitsuba `{variant}`", 4, *found)
    if python is not None:
        fork(python, given)
