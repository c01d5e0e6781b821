"""The figures of docs/data_synth.md: ``nerfvol synth bench [one|sky|preview|views|mitsuba] [--fork PYTHON] [--size N]``.

Times are wall-clock and CPU seconds (all threads) of whole renders of one view: everything that depends on the lights
(shadow maps) is made again in each of the repetitions, of which the median counts. ``view`` is a further view of the
same scene. Compiled code is warmed up first. error is the sum of |picture - truth| over the sum of the truth, rms the
root mean square over the mean of the truth, bias the relative error of the mean. The truth is the march with shadow
rays and a quarter of the step.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from data_synth import bench_mitsuba, media, scenes
from data_synth.dataset import Options, write_dataset
from data_synth.errors import InputError
from data_synth.image import Picture, write_png
from data_synth.integrators import DeepShadow, Integrator, March, Path, Preview
from data_synth.jit import core_count
from data_synth.portrait import portrait
from data_synth.scene import Scene
from data_synth.scenes.volumes import EVENING_SKY, EVENING_SUN, cumulus


def seconds(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median (wall, CPU) seconds of ``work``."""
    taken = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        taken.append((time.perf_counter() - wall, time.process_time() - cpu))
    return tuple(np.median(taken, axis=0))


def errors(picture: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """(error, rms, bias) as in the module's text."""
    d, mean = picture - truth, truth.mean()
    return np.abs(d).mean() / mean, np.sqrt((d**2).mean()) / mean, d.mean() / mean


def single_scattering(title: str, scene: Scene, size: int, beams: int, repeats: int = 3) -> None:
    """Rows of a table: shadow rays and deep shadow maps of several kinds, with time and error."""
    camera, coarse = (scene.viewpoints.camera(-55, 22, side, side) for side in (size, 4))
    methods = {
        "shadow rays": March(beams=beams),
        "deep, gathered at the density": DeepShadow(beams=beams),
        "deep, map of 96": DeepShadow(beams=beams, resolution=96),
        "deep, map of 192": DeepShadow(beams=beams, resolution=192),
    }
    medium = scene.medium
    if not isinstance(medium, media.Medium):
        raise InputError(f"bench: expected a scene with one grey medium, {scene.name} has none")
    fine = replace(scene, medium=medium._replace(step=medium.step / 4))
    truth = March(beams=beams).render(fine, camera).rgb
    print(f"\n{title}, {size}x{size}, median of {repeats}")
    print("| method | wall s | CPU s | view CPU s | faster, wall | faster, CPU | error | rms | bias |")
    print("|---|---|---|---|---|---|---|---|---|")
    rays = None
    for name, method in methods.items():
        method.render(scene, coarse)

        def again(method: March = method) -> Picture:
            scene.prepared.clear()
            return method.render(scene, camera)

        wall, cpu = seconds(again, repeats)
        _, next_view = seconds(lambda method=method: method.render(scene, camera), repeats)
        rays = rays or (wall, cpu)
        error, rms, bias = errors(method.render(scene, camera).rgb, truth)
        print(
            f"| {name} | {wall:.3f} | {cpu:.3f} | {next_view:.3f} | {rays[0] / wall:.1f} | {rays[1] / cpu:.1f} | {error:.2%} "
            f"| {rms:.2%} | {bias:+.2%} |",
            flush=True,
        )


def one() -> None:
    """One sun."""
    single_scattering("one sun", cumulus(EVENING_SUN), 256, 1)


def sky() -> None:
    """A sun and a sky of 12 beams."""
    single_scattering("a sun and a sky of 12 beams", cumulus(EVENING_SUN, EVENING_SKY), 64, 12, repeats=1)


def preview() -> None:
    """The cloud preview and single scattering against the truth, and pictures of them side by side."""
    scene = cumulus(EVENING_SUN, EVENING_SKY)
    camera = scene.viewpoints.camera(-55, 22, 160, 160)
    truth = Path(spp=128, max_depth=64).render(scene, camera)
    rgb, spread = truth.rgb, np.sqrt(0.0 if truth.variance is None else truth.variance.mean()) / truth.rgb.mean()
    print(f"\npreview, 160x160; truth: path, 128 paths a pixel, 64 events, noise {spread:.1%} of the mean a pixel")
    print(
        "| method | CPU s | error | rms | bias | error at the best exposure | correlation |\n|---|---|---|---|---|---|---|"
    )
    methods = {"preview": Preview(), "soft preview": Preview(soft=True), "single scattering": DeepShadow()}
    for name, method in methods.items():
        method.render(scene, camera)
        picture = method.render(scene, camera).rgb
        _, cpu = seconds(lambda method=method: method.render(scene, camera), 3)
        error, rms, bias = errors(picture, rgb)
        fitted = (picture * rgb).sum() / (picture**2).sum() * picture
        seen = truth.alpha > 0.05
        correlation = np.corrcoef(picture[seen].ravel(), rgb[seen].ravel())[0, 1]
        print(
            f"| {name} | {cpu:.2f} | {error:.1%} | {rms:.1%} | {bias:+.1%} | {errors(fitted, rgb)[0]:.1%} | {correlation:.3f} |"
        )
    row = [_portrait(scene, method) for method in (*methods.values(), Path(spp=48))]
    write_png("preview.jpg", np.concatenate(row, axis=1))
    print("preview.jpg: preview, soft preview, single scattering, path tracing, each framed and exposed by itself")


def _portrait(scene: Scene, method: Integrator) -> np.ndarray:
    """(200, 200, 3) uint8 as ``--picture`` makes it; without noise where Open Image Denoise is installed."""
    denoise = isinstance(method, Path) and find_spec("pyoidn") is not None
    camera = scene.viewpoints.camera(-55, 22, 200, 200)
    return portrait(lambda view: method.render(scene, view), camera, denoise=denoise)


def views() -> None:
    """A folder of 100 views of a cumulus at sunset, from the making of the cloud to the last file."""
    options = Options(views=100, size=(400, 400))
    with tempfile.TemporaryDirectory() as folder:
        wall, cpu = seconds(lambda: write_dataset(scenes.cloud(), folder, options), 1)
    print(f"117 views (100 training, 5 validation, 12 testing): {wall:.1f} s, {cpu:.1f} CPU s")


def mitsuba(fork: str | None = None, size: int = bench_mitsuba.SIZE) -> None:
    """Path tracing side by side with Mitsuba 3, and with its fork where ``fork`` names a Python that has it."""
    bench_mitsuba.main(cumulus(EVENING_SUN), fork, size)


BENCHES: dict[str, Callable[..., None]] = {
    "one": one,
    "sky": sky,
    "preview": preview,
    "views": views,
    "mitsuba": mitsuba,
}


def main(arguments: list[str]) -> int:
    """Run the named benchmarks, or all."""
    p = argparse.ArgumentParser("nerfvol synth bench", description="the figures of docs/data_synth.md")
    p.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHES))
    p.add_argument("--fork", metavar="PYTHON", help="mitsuba: an interpreter that has eradiate-mitsuba, for its rows")
    p.add_argument("--size", type=int, default=bench_mitsuba.SIZE, metavar="N", help="mitsuba: pixels a side")
    args = p.parse_args(arguments)
    names = args.names
    if args.size < 1:
        raise InputError(f"bench: --size expects a number of pixels, got {args.size}")
    if args.fork and names and "mitsuba" not in names:
        raise InputError(f"bench: --fork belongs to mitsuba, got {' '.join(names)}")
    for name in names:
        if name not in BENCHES:
            raise InputError(f"bench: expected one of {', '.join(BENCHES)}, got '{name}'")
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    print(
        f"{platform.machine()}, {core_count()} cores, load before the start {load}, Python {platform.python_version()}"
    )
    for name in names or BENCHES:
        if name == "mitsuba":
            mitsuba(args.fork, args.size)
        else:
            BENCHES[name]()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
