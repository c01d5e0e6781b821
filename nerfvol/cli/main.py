"""The ``nerfvol`` command: parse, call, and say in one sentence what was wrong.

Exit codes: 0 done, 2 bad input (message on stderr, no traceback), 130 interrupted after saving. Heavy modules are
imported inside the command that needs them, so that help and mistakes answer at once.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from nerfvol import __version__
from nerfvol.errors import InputError
from nerfvol.training.prepare import prepare_run, resumable_config

_DESCRIPTION = """\
From posed photographs to a sparse octree radiance field, and pictures of it, on an ordinary CPU.

  nerfvol synth showcase --out scene                      make a scene to try it on
  nerfvol train --data scene --out run                    train an octree (--time-budget 60s: in a minute)
  nerfvol eval run --data scene --split test              score it on views it has not seen
  nerfvol render run --orbit 120 --out orbit.mp4          fly around it
"""
_EPILOG = "`nerfvol COMMAND --help` explains a command. Exit codes: 0 done, 2 bad input, 130 interrupted (saved)."
_LAYERED = "Any option can stand in a YAML file given with --config (time_budget: 2m); the command line wins over it."


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints end in one sentence, with the nearest known option for a mistyped one."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see `{self.prog} --help`)")

    def check_leftovers(self, leftovers: Sequence[str]) -> None:
        """Refuse what no option took."""
        if not leftovers:
            return
        word = leftovers[0].split("=")[0]
        known = [option for action in self._actions for option in action.option_strings]
        close = difflib.get_close_matches(word, known, n=1, cutoff=0.0) if word.startswith("-") else []
        hint = f"; did you mean {close[0]}?" if close else ""
        self.error(f"unknown argument {word!r}{hint}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: that of the process) and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    return guard(lambda: _dispatch(arguments))


def guard(run: Callable[[], int]) -> int:
    """The exit code of ``run``; what the user has to put right is said in one sentence instead of a traceback."""
    try:
        code = run()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("nerfvol: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader (head, a pager) has gone. Point stdout elsewhere, or the interpreter's own flush complains at exit.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        sentence = _sentence(error)
        if sentence is None:
            raise
        print(f"nerfvol: error: {sentence}", file=sys.stderr)
        return 2


def _sentence(error: Exception) -> str | None:
    """What to tell the user, or None where ``error`` is a defect of the program and the traceback is wanted."""
    from data_synth.errors import InputError as SynthInputError

    if isinstance(error, (InputError, SynthInputError)):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return "the machine's memory is used up; try a larger --downscale"
    if isinstance(error, OSError):
        from nerfvol.files.atomic import explain_os_error

        return f"{error.filename or 'input or output'}: {explain_os_error(error)}"
    return None


def _dispatch(arguments: list[str]) -> int:
    if arguments[:1] == ["synth"]:  # data_synth has a command line of its own; it is a package independent of this one
        from data_synth.cli import main as synth_main

        return synth_main(arguments[1:]) or 0
    parser, commands = _build_parser()
    if not arguments:
        parser.print_help()
        return 0
    try:
        given, leftovers = parser.parse_known_args(arguments)
    except SystemExit as stop:  # --help and --version print and stop
        return int(stop.code or 0)
    commands[given.command].check_leftovers(leftovers)
    options = vars(given)
    options.pop("command")
    run = options.pop("run")
    return run(options)


def _build_parser() -> tuple[_Parser, dict[str, _Parser]]:
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="nerfvol", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=raw, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"nerfvol {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    commands: dict[str, _Parser] = {}

    def command(name: str, run: Callable[[dict[str, Any]], int], summary: str, epilog: str = _LAYERED) -> _Parser:
        # Only options that were given appear in the result: what is absent comes from the config file or the default.
        sub = subparsers.add_parser(
            name, help=summary, description=summary, epilog=epilog, formatter_class=raw, allow_abbrev=False,
            argument_default=argparse.SUPPRESS,
        )  # fmt: skip
        sub.set_defaults(run=run)
        commands[name] = sub
        return sub

    _train_arguments(command("train", _train, "Train an octree from a folder of posed images."))
    _eval_arguments(command("eval", _eval, "Score an octree (PSNR, SSIM) on the views of a split."))
    _render_arguments(command("render", _render, "Render pictures or a video along a camera path."))
    info = command("info", _info, "Show what an octree file holds and which compute path runs here.")
    info.add_argument("target", metavar="RUN|FILE", nargs="?", help="octree file or run folder; without: this machine")
    info.add_argument("--json", action="store_true", help="print JSON instead of text")
    subparsers.add_parser("synth", help="Make a synthetic scene with exact ground truth.", add_help=False)
    _bench_arguments(command("bench", _bench, "Measure rendering, loading and training speed."))
    return parser, commands


def _train_arguments(p: _Parser) -> None:
    p.add_argument("--data", metavar="DIR", help="posed images: a folder with transforms*.json (Blender, instant-ngp "
                   "or nerfstudio layout), or the JSON file itself")  # fmt: skip
    p.add_argument("--out", metavar="RUN", help="run folder: octree.safetensors (the product), config.yaml, "
                   "metrics.json, log.jsonl, previews/, checkpoint.safetensors")  # fmt: skip
    p.add_argument("--config", metavar="FILE", help="YAML file of settings, such as configs/smoke.yaml")
    p.add_argument("--init", metavar="mlp|direct", help="start from a small MLP field that is trained first and then "
                   "distilled, or straight from a thin octree (default: direct)")  # fmt: skip
    p.add_argument("--time-budget", metavar="TIME", help="wall-clock time for everything, such as 120s or 5m; none: "
                   "a fixed number of steps, the same result every time (default: none)")  # fmt: skip
    p.add_argument("--background", metavar="COLOUR", help="white, black or R,G,B from 0 to 1: what images with alpha "
                   "are composited on (default: white)")  # fmt: skip
    p.add_argument("--downscale", metavar="N", help="area-average the images by N (default: 1)")
    p.add_argument("--threads", metavar="N", help="CPU threads; the result does not depend on it (default: all)")
    p.add_argument("--seed", metavar="N", help="seed of every random choice (default: 0)")
    p.add_argument("--resume", action="store_true", help="go on from RUN's checkpoint; settings come from RUN")
    p.add_argument("--checkpoint-every", metavar="TIME", help="the most a crash can cost (default: 30s)")
    p.add_argument("--set", action="append", metavar="KEY=VALUE", help="any setting of the sections, such as "
                   "octree.sh_degree=2; repeatable (config.yaml in a run folder lists them all)")  # fmt: skip


def _target_arguments(p: _Parser) -> None:
    p.add_argument("target", metavar="RUN|FILE", nargs="?", help="octree file, or a run folder that holds one")
    p.add_argument("--config", metavar="FILE", help="YAML file of this command's options")
    p.add_argument("--threads", metavar="N", help="CPU threads (default: all)")


def _eval_arguments(p: _Parser) -> None:
    _target_arguments(p)
    p.add_argument("--data", metavar="DIR", help="posed images to compare with (default: those of the run)")
    p.add_argument("--split", metavar="train|val|test", help="which views (default: val)")
    p.add_argument("--downscale", metavar="N", help="area-average the images by N (default: 1)")
    p.add_argument("--background", metavar="COLOUR", help="white, black or R,G,B (default: that of the training)")
    p.add_argument("--early-stop-eps", metavar="T", help="stop a ray at this transmittance; 0: exact (default: 1/255)")
    p.add_argument("--lod", metavar="PIXELS", help="draw what is smaller as one cell; 0: every leaf (default: 0.8)")
    p.add_argument("--json", metavar="FILE", help="write scores, per-image rows, seconds per frame and hardware")
    p.add_argument("--save-images", metavar="DIR", help="write truth | render | error | depth for every view")
    p.add_argument("--truth", metavar="FILE.npz", help="the density.npz of a synthetic scene: also compare the density "
                   "(with --save-images: slices of both)")  # fmt: skip


def _render_arguments(p: _Parser) -> None:
    _target_arguments(p)
    p.add_argument("--cameras", metavar="FILE.json", help="camera path: a transforms JSON (docs/cli.md)")
    p.add_argument("--orbit", metavar="N", help="N views on a circle around the scene, as the training cameras stood")
    p.add_argument("--size", metavar="WxH", help="picture size (default: that of the cameras, or 800x800)")
    p.add_argument("--out", metavar="DIR|FILE.mp4", help="folder for pictures, or a video file")
    p.add_argument("--aov", metavar="LIST", help="also write depth,median_depth,opacity,normal")
    p.add_argument("--format", metavar="png|exr", help="exr: linear float, all AOVs in one file (default: png)")
    p.add_argument("--fps", metavar="N", help="frames a second of a video (default: 30)")
    p.add_argument("--background", metavar="COLOUR", help="white, black or R,G,B (default: that of the training)")
    p.add_argument("--early-stop-eps", metavar="T", help="stop a ray at this transmittance; 0: exact (default: 1/255)")
    p.add_argument("--lod", metavar="PIXELS", help="draw what is smaller as one cell; 0: every leaf (default: 0.8)")


def _bench_arguments(p: _Parser) -> None:
    _target_arguments(p)
    p.add_argument("--sizes", metavar="LIST", help="square picture sizes (default: 400,800,1600)")
    p.add_argument("--repeats", metavar="N", help="the median of N measurements is reported (default: 5)")
    p.add_argument("--data", metavar="DIR", help="images for the training rate (default: those of the run)")
    p.add_argument("--no-reference", dest="reference", action="store_false",
                   help="leave out the comparison with plain torch and the paper-size MLP")  # fmt: skip
    p.add_argument("--json", metavar="FILE", help="write every figure as JSON")
    p.add_argument("--plot", metavar="FILE", help="draw the curves (.png, .svg or .pdf; needs nerfvol[plot])")
    p.add_argument("--runs", metavar="RUN", nargs="+", help="with --plot: also PSNR against seconds of these runs")


def _assemble(cls: Any, given: dict[str, Any], base: tuple[dict[str, Any], str] | None = None) -> Any:
    """Defaults < ``base`` < the file of --config < the options given."""
    from nerfvol.config.assemble import assemble, parse_assignment, read_yaml

    layers = [base] if base else []
    path = given.pop("config", None)
    if path is not None:
        layers.append((read_yaml(path), str(path)))
    assignments = given.pop("set", [])
    layers.append((given, "command line"))
    layers.extend((parse_assignment(text), "--set") for text in assignments)
    return assemble(cls, *layers)


def _need(command: str, **values: Any) -> None:
    for name, value in values.items():
        if value in (None, ""):
            what = "RUN|FILE" if name == "target" else f"--{name}"
            raise InputError(f"nerfvol {command} needs {what} (see `nerfvol {command} --help`)")


def _train(given: dict[str, Any]) -> int:
    from nerfvol.config.assemble import read_yaml
    from nerfvol.config.training import Config
    from nerfvol.files import run_folder

    base = None
    if given.get("resume") and given.get("out"):
        saved = resumable_config(given["out"])
        base = (read_yaml(saved), str(saved))
    config = _assemble(Config, given, base)
    _need("train", data=config.data, out=config.out)
    if not Path(config.data).exists():
        raise InputError(f"--data {config.data}: no such folder or file")
    prepare_run(config)
    set_threads(config.threads)
    from nerfvol.training.train import train

    run = train(config)
    print(f"octree: {run_folder.octree_path(run)}")
    return 0


def _eval(given: dict[str, Any]) -> int:
    from nerfvol.cli.eval import EvalOptions

    options = _assemble(EvalOptions, given)
    _need("eval", target=options.target)
    set_threads(options.threads)
    from nerfvol.cli.eval import run_eval

    return run_eval(options)


def _render(given: dict[str, Any]) -> int:
    from nerfvol.cli.render import RenderOptions

    options = _assemble(RenderOptions, given)
    _need("render", target=options.target, out=options.out)
    set_threads(options.threads)
    from nerfvol.cli.render import run_render

    return run_render(options)


def _info(given: dict[str, Any]) -> int:
    from nerfvol.cli.info import InfoOptions, run_info

    return run_info(_assemble(InfoOptions, given))


def _bench(given: dict[str, Any]) -> int:
    from nerfvol.cli.bench import BenchOptions

    options = _assemble(BenchOptions, given)
    _need("bench", target=options.target)
    from nerfvol.cli.bench import run_bench

    return run_bench(options)


def set_threads(threads: int) -> int:
    """Use ``threads`` CPU threads (0: every core this process may use) in torch and the kernels; returns the number."""
    from nerfvol.machine import usable_cores

    if threads < 0:
        raise InputError(f"--threads must be 0 (all cores) or more, got {threads}")
    count = threads or usable_cores()
    from nerfvol.kernels import ops

    ops.set_threads(count)
    return count


if __name__ == "__main__":
    sys.exit(main())
