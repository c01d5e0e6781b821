"""``nerfvol bench``: repeatable medians of loading, rendering and training speed, and what they stand against."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfvol import __version__
from nerfvol.cli.command import Command, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.config.values import Count
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.config.training import Config

REPEATS = 5
"""Of a measurement, where nothing else is said."""


@dataclass
class BenchOptions:
    """``nerfvol bench``."""

    target: str = ""
    sizes: tuple[Count, ...] = (400, 800, 1600)
    repeats: Count | None = None
    reference: bool = True
    json: str | None = None
    plot: str | None = None
    runs: tuple[str, ...] = ()
    threads: int = 0
    ladder: str | None = None
    out: str = ""
    budgets: tuple[str, ...] = ("10s", "30s", "1m", "2m", "5m", "15m")
    representations: tuple[Literal["octree", "splats"], ...] = ("octree", "splats")
    published: Literal["none", "lego", "bonsai"] = "none"
    settings: str | None = None


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--sizes", metavar="LIST", help="square picture sizes (default: 400,800,1600)")
    p.add_argument("--repeats", metavar="N", help="the median of N measurements is reported (default: 5; with --ladder "
                   "of N runs with the seeds 0, 1, …, default: 1)")  # fmt: skip
    p.add_argument("--no-reference", dest="reference", action="store_false",
                   help="leave out the comparison with plain torch and the paper-size MLP")  # fmt: skip
    p.add_argument("--json", metavar="FILE", help="write every figure as JSON")
    p.add_argument("--plot", metavar="FILE", help="draw the curves (.png, .svg or .pdf; needs nerfvol[plot])")
    p.add_argument("--runs", metavar="RUN", nargs="+", help="with --plot: also PSNR against seconds of these runs")
    p.add_argument("--ladder", metavar="DATA", help="instead of measuring a model: train on DATA for each of --budgets and "
                   "--representations, and write ladder.json, .md and .png; what is finished is not trained again")  # fmt: skip
    p.add_argument("--out", metavar="DIR", help="with --ladder: the folder of its runs")
    p.add_argument("--budgets", metavar="LIST", help="with --ladder (default: 10s,30s,1m,2m,5m,15m; also 500steps)")
    p.add_argument("--representations", metavar="LIST", help="with --ladder (default: octree,splats)")
    p.add_argument("--published", metavar="lego|bonsai|none", help="with --ladder: others' figures for comparison")
    p.add_argument("--settings", metavar="FILE", help="with --ladder: YAML of training settings that all runs share")


def run(options: BenchOptions) -> int:
    """Measure everything, print tables, write JSON where asked; the exit code.

    Raises:
        InputError: options that do not go together, no such model, or a path that cannot be written.
    """
    if options.ladder is not None:
        return run_ladder(options)
    need("bench", target=options.target)
    from nerfvol.files.atomic import write_json
    from nerfvol.machine import describe_hardware
    from nerfvol.measure import plots
    from nerfvol.views import OctreeModel

    prepare_outputs(file=options.json)
    if options.plot is not None:
        plots.check_plot(options.plot, options.runs)
    threads = set_threads(options.threads)
    target = open_target(options.target)
    record = {"nerfvol": __version__, "hardware": describe_hardware(), "threads": threads}
    record["representation"] = target.model.kind
    if isinstance(target.model, OctreeModel):
        record |= _measure_octree(target, options, threads)
        print_tables(record)
    else:
        record |= _measure_splats(target, options, threads)
        print_splat_tables(record)
    if options.json is not None:
        write_json(options.json, record)
        print(f"figures: {options.json}")
    if options.plot is not None:
        plots.draw_bench(options.plot, record, options.runs)
        print(f"picture: {options.plot}")
    return 0


def _measure_octree(target: Target, options: BenchOptions, threads: int) -> dict[str, Any]:
    from nerfvol.cameras.paths import orbit_cameras
    from nerfvol.measure import bench, roofline
    from nerfvol.views import OctreeModel

    assert isinstance(target.model, OctreeModel)
    octree, orbit = target.model.octree, target.orbit()
    machine = roofline.measure_machine(threads)
    views = {size: orbit_cameras(bench.VIEWS, orbit, (size, size)) for size in (*options.sizes, bench.BASE_SIZE)}
    record: dict[str, Any] = {
        "machine": {**vars(machine), "bandwidth": machine.bandwidth},
        "view_size": bench.BASE_SIZE,
        "octree": {"path": str(target.path), "leaves": octree.n_leaves, "vertices": octree.n_vertices},
        "file": bench.measure_loading(target.path, options.repeats or REPEATS),
        "render": bench.measure_rendering(
            octree, [views[size] for size in options.sizes], threads, options.repeats or REPEATS
        ),
        "size": bench.measure_sizes(octree, views[bench.BASE_SIZE], options.repeats or REPEATS, machine),
    }
    record["exponents"] = bench.exponents(record["size"])
    if options.reference:
        record["reference"] = bench.measure_reference(octree, views[bench.BASE_SIZE], record)
    return record


def _measure_splats(target: Target, options: BenchOptions, threads: int) -> dict[str, Any]:
    from nerfvol.cameras.paths import orbit_cameras
    from nerfvol.clouds import PointModel
    from nerfvol.measure import bench, splat_bench
    from nerfvol.views import SplatModel

    model = target.model
    if not isinstance(model, SplatModel | PointModel):
        raise InputError(f"nerfvol bench measures octrees and splats, {target.path} is a model of {model.kind}")
    views = [orbit_cameras(bench.VIEWS, target.orbit(), (size, size)) for size in options.sizes]
    described = model.describe()
    return {
        model.kind: {"path": str(target.path), "count": described[model.kind], **described},
        "file": splat_bench.measure_loading(target.path, options.repeats or REPEATS),
        "render": splat_bench.measure(model, views, threads, options.repeats or REPEATS),
    }


def print_splat_tables(record: dict[str, Any]) -> None:
    """The record of splats or points as text."""
    kind = record["representation"]
    _print_head(record, f"{record[kind]['path']}: {record[kind]['count']:,} {kind}")
    _print_rates(record, "frames a second", "frames_per_second")
    print()
    _print_rates(record, "ms a training step", "train_step_ms")


def _print_head(record: dict[str, Any], what: str) -> None:
    from nerfvol.machine import processor

    hardware, file = record["hardware"], record["file"]
    print(f"{processor(hardware)}, {record['threads']} threads, kernels {hardware['kernel_path']}")
    print(f"{what}, {file['bytes'] / 1e6:.1f} MB, loads in {file['seconds']:.2f} s\n")


def _print_rates(record: dict[str, Any], title: str, key: str) -> None:
    sizes = sorted({row["size"] for row in record["render"]})
    print(f"{title:21s}" + "".join(f"{f'{size}x{size}':>12s}" for size in sizes))
    for isa, threads in dict.fromkeys((row["isa"], row["threads"]) for row in record["render"]):
        rates = {r["size"]: r[key] for r in record["render"] if (r["isa"], r["threads"]) == (isa, threads)}
        plural = "s" if threads > 1 else " "
        print(f"{isa:10s} {threads:2d} thread{plural} " + "".join(f"{rates[size]:12.2f}" for size in sizes))


def print_tables(record: dict[str, Any]) -> None:
    """The record as text."""
    octree = record["octree"]
    _print_head(record, f"{octree['path']}: {octree['leaves']:,} leaves")
    _print_rates(record, "frames a second", "frames_per_second")
    print(
        f"\nfinest grid      leaves   frames/s at {record['view_size']}²   training rays/s   segments/ray   million segments/s"
    )
    for row in record["size"]:
        print(
            f"{2 ** row['level']:8d}³ {row['leaves']:12,d} {row['frames_per_second']:16.2f} "
            f"{row['train_rays_per_second']:18,.0f} {row['samples_per_ray']:14.1f} "
            f"{row['train_segments_per_second'] / 1e6:20.1f}"
        )
    _print_roofline(record)
    if "reference" in record:
        r = record["reference"]
        print(
            f"\nrays a second at {record['view_size']}²: kernels {r['kernel_rays_per_second']:,.0f}; plain torch "
            f"{r['torch_rays_per_second']:,.0f} ({r['kernel_over_torch']:,.0f} times slower); 8x256 network of the "
            f"NeRF paper {r['paper_mlp_rays_per_second']:,.0f} ({r['kernel_over_paper_mlp']:,.0f} times slower)"
        )
        print(
            f"one training step of {r['train_step_rays']:,} rays: kernels {r['kernel_train_step_seconds'] * 1e3:.1f} ms, "
            f"plain torch {r['torch_train_step_seconds']:.1f} s ({r['train_step_kernel_over_torch']:,.0f} times slower)"
        )


def _print_roofline(record: dict[str, Any]) -> None:
    machine, powers = record["machine"], record["exponents"]
    if powers["frame"] is not None:
        print(f"time grows as leaves^{powers['frame']:.2f} a frame, leaves^{powers['train_ray']:.2f} a training ray")
    print(
        f"\nroofline: memory {machine['read'] / 1e9:.1f} GB/s read, {machine['copy'] / 1e9:.1f} GB/s copied; float32 "
        f"{machine['operations'] / 1e9:.0f} GFLOP/s ({machine['threads']} threads)"
    )
    print("                 ------- frames/s allowed by -------   --- training Mrays/s allowed by ---")
    print("finest grid        MB/frame   bandwidth  arithmetic    bytes/ray   bandwidth  arithmetic")
    for row in record["size"]:
        print(
            f"{2 ** row['level']:8d}³ {row['frame_bytes'] / 1e6:17.1f} {row['frames_per_second_by_bandwidth']:11.0f} "
            f"{row['frames_per_second_by_arithmetic']:11.0f} {row['train_ray_bytes']:12.0f} "
            f"{row['train_rays_per_second_by_bandwidth'] / 1e6:11.1f} "
            f"{row['train_rays_per_second_by_arithmetic'] / 1e6:11.1f}"
        )


def run_ladder(options: BenchOptions) -> int:
    """Train what is not there yet, one after the other, and write what came of it; the exit code.

    Raises:
        InputError: options that do not go together, no such data, or a path that cannot be written.
    """
    if options.target:
        raise InputError("nerfvol bench takes either RUN|FILE or --ladder DATA, not both")
    need("bench --ladder", ladder=options.ladder, out=options.out)
    import time

    from nerfvol.config.assemble import to_plain
    from nerfvol.files.atomic import read_json
    from nerfvol.machine import describe_hardware
    from nerfvol.measure import ladder

    if not Path(str(options.ladder)).exists():
        raise InputError(f"--ladder {options.ladder}: no such folder or file")
    if not options.representations:
        raise InputError("--representations: expected octree, splats or both")
    budgets = ladder.budgets(options.budgets)
    prepare_outputs(folder=options.out)
    threads = set_threads(options.threads)
    rungs = _rungs(options, budgets)  # all settings are checked before the first run begins
    rows: list[dict[str, Any]] = []
    record: dict[str, Any] = {}
    written: list[Path] = []
    for (name, budget), runs in rungs.items():
        scored = []
        for folder, config in runs:
            metrics = ladder.finished(folder, to_plain(config))
            print(f"{folder.name}: {'finished before' if metrics else 'training'}", flush=True)
            if metrics is None:
                from nerfvol.training.train import train

                train(config, started=time.perf_counter())
                metrics = read_json(folder / "metrics.json")
            scored.append((folder, metrics))
        rows.append(ladder.row_of(name, budget, scored))
        record = {
            "nerfvol": __version__, "hardware": describe_hardware(), "threads": threads, "data": options.ladder,
            "rows": rows, "published": ladder.PUBLISHED[options.published],
        }  # fmt: skip
        written = ladder.write_ladder(Path(options.out), record)  # after each rung: the next may take long
    print(f"\n{ladder.table(record)}\nwritten: {', '.join(map(str, written))}")
    return 0


def _rungs(
    options: BenchOptions, budgets: dict[str, dict[str, Any]]
) -> dict[tuple[str, str], list[tuple[Path, Config]]]:
    """Folder and settings of each run, by representation and budget."""
    from nerfvol.config.assemble import assemble, read_yaml
    from nerfvol.config.training import Config
    from nerfvol.measure.ladder import folder_of

    shared = (read_yaml(options.settings), options.settings) if options.settings else ({}, "settings")
    rungs: dict[tuple[str, str], list[tuple[Path, Config]]] = {}
    for name in options.representations:
        for budget, settings in budgets.items():
            for k in range(options.repeats or 1):
                folder = folder_of(Path(options.out), name, budget, k)
                own = {"data": options.ladder, "out": str(folder), "representation": name, "threads": options.threads}
                config = assemble(Config, shared, (settings, "--budgets"), (own, "bench"))
                rungs.setdefault((name, budget), []).append((folder, replace(config, seed=config.seed + k)))
    return rungs


COMMAND = Command(
    summary="Measure rendering, loading and training speed.",
    example="nerfvol bench run --sizes 400,800 --json bench.json --plot bench.png\n"
    "nerfvol bench --ladder scene --out ladder --budgets 30s,2m",
    options=BenchOptions,
    arguments=arguments,
    run=run,
    place=50,
)
