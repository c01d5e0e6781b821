"""The command line ``nerfvol synth``: list the scenes, or render one to a folder of posed images."""

from __future__ import annotations

import argparse
import ast
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from data_synth import integrators, scenes
from data_synth.dataset import Options, Renderable, render_view, write_dataset
from data_synth.errors import InputError
from data_synth.image import write_png
from data_synth.integrators import Integrator


def parser() -> argparse.ArgumentParser:
    """The options of ``synth``."""
    p = argparse.ArgumentParser(
        prog="nerfvol synth",
        description="Render a scene with a known truth to posed images in the NeRF-synthetic layout.",
    )
    p.add_argument("scene", metavar="SCENE", help="a scene by name, 'list' for all of them, or 'bench' [one|sky|...]")
    p.add_argument("--out", metavar="DIR", help="folder to write (made if it is not there)")
    p.add_argument("--picture", metavar="FILE", help="instead: one portrait of the scene, .jpg or .png with a backdrop")
    p.add_argument("--views", type=int, default=60, help="training views; val and test are added (default 60)")
    p.add_argument("--size", default="400x400", metavar="WxH", help="pixels of every view (default 400x400)")
    p.add_argument("--seed", type=int, default=0, help="seed of camera places and of Monte Carlo (default 0)")
    p.add_argument("--integrator", metavar="NAME", help="how to render; by default the scene's own choice")
    p.add_argument("--spp", type=int, metavar="N", help="samples per pixel of Monte Carlo integrators")
    lights = ", ".join(scenes.LIGHTS)
    p.add_argument("--light", metavar="NAME,...", help=f"lights instead of the scene's own: {lights}")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a parameter of the scene")
    p.add_argument("--volume", metavar="FILE", help="a density volume (.vdb or .npz) for scenes that take one")
    p.add_argument("--exr", action="store_true", help="also write linear float EXR files")
    return p


def main(argv: list[str]) -> int:
    """Run ``synth`` with the arguments after the word; the exit code. Bad input is one sentence and code 2."""
    try:
        if argv[:1] == ["bench"]:
            from data_synth.bench import main as bench

            return bench(argv[1:])
        args = parser().parse_args(argv)
        return _list() if args.scene == "list" else _render(args)
    except InputError as error:
        print(f"nerfvol synth: {error}", file=sys.stderr)
        return 2


def _list() -> int:
    for name in scenes.SCENES:
        print(f"{name:14s} {scenes.summary(name)}  [docs/gallery/{name}.jpg]")
    return 0


def _parameters(args: argparse.Namespace) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for item in args.set:
        key, equals, value = item.partition("=")
        if not equals:
            raise InputError(f"--set: expected KEY=VALUE, got '{item}'")
        try:
            parameters[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            parameters[key] = value
    if args.volume:
        parameters["volume"] = args.volume
    if args.light:
        parameters["light"] = args.light
    return parameters


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise InputError(f"--size: expected WxH such as 400x400, got '{text}'")
    return int(width), int(height)


def _render(args: argparse.Namespace) -> int:
    if not args.out and not args.picture:
        raise InputError("--out: expected a folder to write, got nothing")
    started = time.perf_counter()
    size = _size(args.size)
    scene = scenes.make(args.scene, **_parameters(args))
    name = args.integrator or scene.integrators[0]
    if args.integrator and args.integrator not in scene.integrators:
        known = ", ".join(scene.integrators)
        raise InputError(f"--integrator: scene {scene.name} takes {known}, got {args.integrator}")
    if args.spp is not None and name != "path":
        raise InputError(f"--spp: only the path integrator has samples, {scene.name} is rendered by {name}")
    integrator = None if args.scene == "showcase" else integrators.make(name, spp=args.spp)

    if args.picture:
        return _portrait(scene, integrator, size, args)

    def progress(done: int, total: int) -> None:
        if sys.stderr.isatty():
            end = "\n" if done == total else ""
            print(f"\r{scene.name}: view {done}/{total}", end=end, file=sys.stderr, flush=True)

    options = Options(args.views, size, args.seed, integrator, args.exr, progress)
    out = write_dataset(scene, args.out, options)
    print(f"{out}: {args.views} training views of {scene.name} in {time.perf_counter() - started:.1f} s")
    return 0


def _portrait(scene: Renderable, integrator: Integrator | None, size: tuple[int, int], args: argparse.Namespace) -> int:
    """One view from the middle of the scene's viewing band, over a pale backdrop that darkens downwards."""
    if Path(args.picture).suffix not in (".jpg", ".png"):
        raise InputError(f"--picture: expected a name that ends in .jpg or .png, got {args.picture}")
    started = time.perf_counter()
    camera = scene.viewpoints.camera(-55.0, 0.5 * sum(scene.viewpoints.elevation) - 5.0, *size)
    rgba = render_view(scene, camera, integrator, args.seed).rgba8(scene.exposure) / 255.0
    backdrop = np.linspace(0.93, 0.76, size[1])[:, None, None] * np.array([0.96, 0.985, 1.0])
    pixels = rgba[..., :3] * rgba[..., 3:] + backdrop * (1.0 - rgba[..., 3:])
    write_png(args.picture, np.rint(255.0 * pixels).astype(np.uint8))
    print(f"{args.picture}: {scene.name} in {time.perf_counter() - started:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
