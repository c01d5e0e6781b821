"""The command line ``nerfvol synth``: list the scenes, or render one to a folder of posed images."""

from __future__ import annotations

import argparse
import ast
import functools
import re
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from data_synth import integrators, scene_file, scenes
from data_synth.cameras import Camera
from data_synth.channels import Channels
from data_synth.cli_options import parser
from data_synth.dataset import Options, write_dataset
from data_synth.errors import InputError, RenderWarning
from data_synth.files import remove_leftovers
from data_synth.image import Picture, encode_png, write_png
from data_synth.integrators import Integrator
from data_synth.jit import say_when_compiling
from data_synth.media import Medium
from data_synth.portrait import portrait
from data_synth.scene import Scene
from data_synth.views import (
    Each,
    Files,
    Piece,
    Renderable,
    View,
    pieces_of,
    render_numbered,
    render_piece,
    render_view,
    rendered,
)

OWN = {
    key: "--" + key.replace("_", "-")
    for key in ("spp", "max_depth", "beams", "side", "resolution", "fill", "rain", "gradient", "shading")
}


def main(argv: list[str], each: Each | None = None) -> int:
    """Run ``synth`` with the arguments after the word; the exit code. Bad input is one sentence and code 2."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", RenderWarning)
            warnings.showwarning = lambda message, *_: print(f"nerfvol synth: {message}", file=sys.stderr)
            if argv[:1] == ["bench"]:
                from data_synth.bench import main as bench

                return bench(argv[1:])
            args = parser(_details(argv)).parse_args(argv)
            if args.scene == "list":
                return _list(argv)
            with say_when_compiling():
                return _render(args, argv, each)
    except InputError as error:
        print(f"nerfvol synth: {error}", file=sys.stderr)
        return 2


def _list(argv: list[str]) -> int:
    if len(argv) > 1:
        raise InputError(f"list: expected nothing else, got {' '.join(a for a in argv if a != 'list')}")
    for name in scenes.SCENES:
        print(f"{name:14s} {scenes.summary(name)}  [docs/gallery/{name}.jpg]")
    return 0


def _details(argv: list[str]) -> str:
    """What --help says of a scene."""
    name = next((word for word in argv if word in scenes.SCENES), None)
    if name is None or not {"-h", "--help"} & set(argv):
        return ""
    parameters = scenes.parameters_of(name)
    lines = [f"{name}: {scenes.summary(name)}", "", "parameters, with their defaults:"]
    for key, default in parameters.items():
        option = "--volume FILE" if key == "volume" else f"--set {key}={default}"
        lines.append(f"  {option:28s}" + (" a density volume instead of the scene's own" if key == "volume" else ""))
    if not parameters:
        lines.append("  none")
    own = ("emission",) if name == "showcase" else scenes.make(name, **_smallest(parameters)).integrators
    return "\n".join([*lines, "", f"integrators, its own choice first: {', '.join(own)}"])


def _smallest(parameters: dict[str, Any]) -> dict[str, Any]:
    """Parameters that make the scene in no time, to ask it something."""
    return {"resolution": 16} if "resolution" in parameters else {}


def _parameters(args: argparse.Namespace) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for item in args.set:
        key, equals, value = item.partition("=")
        if not equals:
            raise InputError(f"--set: expected KEY=VALUE, got '{item}'")
        try:
            parameters[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            parameters[key] = value
    for key in ("volume", "light"):
        given = getattr(args, key)
        if given is not None:
            if not given:
                raise InputError(f"--{key}: expected a name, got nothing")
            parameters[key] = given
    return parameters


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise InputError(f"--size: expected WxH such as 400x400, got '{text}'")
    return int(width), int(height)


def _scene(args: argparse.Namespace) -> Renderable:
    """The scene with what the command line changes of it."""
    if args.scene.endswith((".yaml", ".yml")):
        if args.set or args.volume or args.light:
            raise InputError("--set, --volume, --light: a scene file says these itself, expected none of them")
        scene: Renderable = scene_file.load(args.scene)
    else:
        scene = scenes.make(args.scene, **_parameters(args))
    if args.fov is not None:
        if not 0 < args.fov < 180:
            raise InputError(f"--fov: expected degrees between 0 and 180, got {args.fov:g}")
        scene.viewpoints = replace(scene.viewpoints, fov=args.fov)
    if args.exposure is not None:
        if not 0 < args.exposure < np.inf:
            raise InputError(f"--exposure: expected a positive number, got {args.exposure:g}")
        scene.exposure = args.exposure
    if args.step is not None:
        if not 0 < args.step < np.inf:
            raise InputError(f"--step: expected a positive length, got {args.step:g}")
        if not isinstance(scene, Scene) or scene.medium is None:
            raise InputError(f"--step: {scene.name} has no medium to march through")
        scene.medium = _with_step(scene.medium, args.step)
        scene.media = [_with_step(m, args.step) for m in scene.media]
    return scene


def _with_step(m: Medium | Channels, step: float) -> Medium | Channels:
    return m.with_step(step) if isinstance(m, Channels) else m._replace(step=step)


def _integrator(args: argparse.Namespace, scene: Renderable) -> Integrator | None:
    """The integrator that the options ask for; None for scenes that render themselves."""
    name = args.integrator or scene.integrators[0]
    if name not in scene.integrators:
        raise InputError(f"--integrator: scene {scene.name} takes {', '.join(scene.integrators)}, got {name}")
    given = {key: getattr(args, key) for key in OWN if getattr(args, key) is not None}
    known = integrators.options(name) if isinstance(scene, Scene) else set()
    for key in given:
        if key not in known:
            raise InputError(f"{OWN[key]}: expected an integrator that has it, {scene.name} is rendered by {name}")
    return integrators.make(name, **given) if isinstance(scene, Scene) else None


def _place(text: str | None, scene: Renderable) -> tuple[float, float]:
    """Azimuth and elevation of a portrait in degrees."""
    if text is None:
        return -55.0, 0.5 * sum(scene.viewpoints.elevation) - 5.0
    try:
        azimuth, elevation = map(float, text.split(","))
    except ValueError:
        azimuth, elevation = np.nan, np.nan
    if not (abs(azimuth) <= 360 and abs(elevation) < 90):
        raise InputError(f"--from: expected azimuth and elevation in degrees such as 305,20, got '{text}'")
    return azimuth, elevation


def _chosen(text: str | None) -> tuple[int, int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,9})-(\d{1,9})(?:/(\d{1,9}))?", text.strip(), re.ASCII)
    first, last, step = (int(part or 1) for part in match.groups()) if match else (0, 0, 0)
    if last < first or not step:
        raise InputError(f"--frames: expected A-B or A-B/S with A up to B and S at least 1, got '{text}'")
    return first, last, step


def _render(args: argparse.Namespace, argv: list[str], each: Each | None) -> int:
    if bool(args.out) == bool(args.picture):
        got = "both" if args.out else "nothing"
        raise InputError(f"--out, --picture: expected a folder to write or one portrait, got {got}")
    started = time.perf_counter()
    options = Options(
        args.views, _size(args.size), args.seed, None, args.exr, None, _chosen(args.frames), each, args.suns
    )
    if args.picture and (Path(args.picture).suffix not in (".jpg", ".png") or not Path(args.picture).parent.is_dir()):
        raise InputError(f"--picture: expected a .jpg or .png in a folder that exists, got {args.picture}")
    if args.place is not None and not args.picture:
        raise InputError("--from: expected --picture with it; data sets have views all around")
    if args.suns and (args.picture or args.light):
        raise InputError(f"--suns: expected --out with it, and no {'--picture' if args.picture else '--light'}")
    if args.denoise and not args.picture:
        raise InputError("--denoise: expected --picture with it; data sets are truth, and that is what is rendered")
    _, scene, integrator = _opened(tuple(argv))
    if args.picture:
        return _portrait(scene, integrator, options.size, args, each)

    def progress(done: int, total: int) -> None:
        if sys.stderr.isatty():
            end = "\n" if done == total else ""
            print(f"\r{scene.name}: view {done}/{total}", end=end, file=sys.stderr, flush=True)

    out = write_dataset(scene, args.out, replace(options, integrator=integrator, progress=progress))
    print(f"{out}: {args.views} training views of {scene.name} in {time.perf_counter() - started:.1f} s")
    return 0


def render_task(settings: Mapping[str, Any], files: Mapping[str, Path], piece: Piece) -> Files | np.ndarray:
    """A piece of the scene that settings["argv"] describes: for the workers of a cluster."""
    args, scene, integrator = _opened(tuple(settings["argv"]))
    return render_piece(scene, integrator, args.seed, args.exr, piece)


@functools.lru_cache(maxsize=1)
def _opened(argv: tuple[str, ...]) -> tuple[argparse.Namespace, Renderable, Integrator | None]:
    args = parser().parse_args(argv)
    scene = _scene(args)
    return args, scene, _integrator(args, scene)


def probe(what: str) -> bytes:
    """What tells machines apart that would render other bytes: a small picture of the scene "NAME:INTEGRATOR", made coarsely.

    Of a scene file, whose name is not one of the scenes', the sphere by its path tracer.
    """
    name, _, integrator = what.partition(":")
    name = name if name in scenes.SCENES else "sphere"
    scene = scenes.make(name, **_smallest(scenes.parameters_of(name)))
    chosen = integrators.make(integrator or scene.integrators[0]) if isinstance(scene, Scene) else None
    picture = render_view(scene, scene.viewpoints.camera(30.0, 20.0, 8, 6), chosen, 1)
    return picture.rgb.tobytes() + encode_png(picture.rgba8(1.0))


def _portrait(
    scene: Renderable, integrator: Integrator | None, size: tuple[int, int], args: argparse.Namespace, each: Each | None
) -> int:
    """One view from the middle of the scene's viewing band, as ``portrait.py`` makes it."""
    started = time.perf_counter()
    camera = scene.viewpoints.camera(*_place(args.place, scene), *size)
    glance = replace(integrator, spp=16) if isinstance(integrator, integrators.Path) else integrator

    def whole(camera: Camera) -> Picture:
        view = View(0, "", camera)
        if each is None or len(pieces_of(integrator, [view])) == 1:  # too small to share
            return render_numbered(scene, integrator, args.seed, view)
        return cast(Picture, next(rendered(each, integrator, [view])))

    pixels = portrait(
        whole, camera, args.exposure, args.denoise, lambda view: render_view(scene, view, glance, args.seed)
    )
    remove_leftovers(Path(args.picture).parent)
    write_png(args.picture, pixels)
    print(f"{args.picture}: {scene.name} in {time.perf_counter() - started:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
