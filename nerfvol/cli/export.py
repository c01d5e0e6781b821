"""``nerfvol export``: a model as a file that other programs open."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from nerfvol.cli.command import Command, add_target, need, prepare_outputs, set_threads
from nerfvol.cli.target import Target, open_target
from nerfvol.config.assemble import run_settings
from nerfvol.config.parsers import box, byte_count, fraction
from nerfvol.config.values import Count
from nerfvol.export import EXPORTS, choose, export_model

if TYPE_CHECKING:
    from nerfvol.export.part import Up
    from nerfvol.export.surface import Cameras
    from nerfvol.models import Model


@dataclass
class ExportOptions:
    """``nerfvol export``."""

    target: str = ""
    out: str = ""
    format: str | None = None
    level: Count | None = None
    max_bytes: Annotated[int | None, byte_count] = None
    crop: Annotated[tuple[float, ...] | None, box] = None
    up: Literal["none", "+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    threshold: Annotated[float, fraction] | None = None
    method: Literal["surface", "centers"] | None = None
    views: Count | None = None
    cameras: str | None = None
    resolution: Count | None = None
    quantity: Literal["sigma", "opacity", "color"] | None = None
    full_float: bool = False
    srgb: bool = False
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--out", metavar="FILE", help="; ".join(
        f"{' or '.join(s or 'a folder' for s in row.suffixes)}: {row.name} of {' or '.join(row.kinds)}, "
        f"opened by {row.opened_by}" for row in EXPORTS).replace("%", "%%"))  # fmt: skip
    p.add_argument("--format", metavar="|".join(row.name for row in EXPORTS), help="where an extension serves several "
                   "(default: the first that holds the model)")  # fmt: skip
    p.add_argument("--level", metavar="L", help=f"{_takers('')}: finest level of an octree that is written, 1 or more "
                   "(default: all; vdb: 8)")  # fmt: skip
    p.add_argument(
        "--max-bytes", metavar="SIZE", help="the same: the finest level whose file is no larger, such as 2MB"
    )
    p.add_argument("--crop", metavar="X0,Y0,Z0,X1,Y1,Z1", help="only what lies in this box, scene units")
    p.add_argument("--up", metavar="none|+y|-y|+z|…", help=f"{_takers('up')}: axis that the scene's up becomes (default: "
                   "+y for .glb and .obj, none for the others; most splat viewers want -y)")  # fmt: skip
    p.add_argument("--method", metavar="surface|centers", help="points: median depths of views, one a voxel, with normals, "
                   "or centres of leaves and means of splats (default: surface)")  # fmt: skip
    p.add_argument("--threshold", metavar="O", help="points: least opacity, of a pixel, a leaf along its side or a splat "
                   "(default: 0.9 of surfaces, 0.5 of centers)")  # fmt: skip
    p.add_argument("--views", metavar="N", help="points, mesh: views that see the surface (default: 40, 60)")
    p.add_argument("--cameras", metavar="FILE|DATA|sphere", help="points, mesh, transforms, colmap: a camera path, a data set, "
                   "or a sphere around the model (default: the run's training cameras where its data are there)")  # fmt: skip
    p.add_argument(
        "--resolution", metavar="N", help="grid, mesh, points: voxels along the longest side (default: 256, 256, 512)"
    )
    p.add_argument("--quantity", metavar="sigma|opacity|color", help="grid: density in 1/scene unit, the opacity of a voxel "
                   "along its side, or colour (default: sigma)")  # fmt: skip
    p.add_argument("--full-float", action="store_true", help="vdb: 32-bit numbers instead of 16-bit")
    p.add_argument("--srgb", action="store_true", help="vdb: colours as trained instead of linear")


def _takers(option: str) -> str:
    return ", ".join(row.name for row in EXPORTS if (option in row.options if option else row.levels))


def run(options: ExportOptions) -> int:
    """Writes the file and prints what it is; the exit code.

    Raises:
        InputError: no such model, a format that does not hold it, or a path that cannot be written.
    """
    need("export", target=options.target, out=options.out)
    target = open_target(options.target)
    row = choose(options.out, target.model.kind, options.format)
    prepare_outputs(file=options.out)
    set_threads(options.threads)
    given: dict[str, Any] = {
        name: getattr(options, name) for name in ("threshold", "resolution", "quantity", "method", "views", "up")
    }
    given |= {"full_float": options.full_float or None, "srgb": options.srgb or None}
    if options.cameras not in (None, "sphere") or "cameras" in row.options and options.cameras is None:
        given["cameras"] = _cameras(target, options.cameras)
    cameras: Cameras | None = given.get("cameras")
    if cameras is not None and "views" in row.options:
        print(f"the surface is seen from the cameras of {cameras.source}")
    level = options.level
    if row.name == "vdb" and level is None and options.max_bytes is None:
        level = 8  # finer ones are large, and programs that march them slow
    started = time.perf_counter()
    written = export_model(
        target.model, options.out, options.format, level=level, max_bytes=options.max_bytes, crop=options.crop, **given
    )
    seconds = time.perf_counter() - started
    at = f" at level {written.level}" if row.levels and written.level is not None else ""
    print(f"{options.out}: {row.name}{at}, {written.size / 1e6:.1f} MB in {seconds:.1f} s; opened by {row.opened_by}")
    if row.name in ("splats", "spz") and (said := _relative(target.model, options.up or "none")) is not None:
        print(said)
    if (row.name == "plenoctree" or options.out.lower().endswith((".nii", ".nii.gz"))) and (
        said := _rounded(target.model)
    ):
        print(said)
    return 0


def _rounded(model: Model) -> str | None:
    """A sentence where a format's float32 origin moves the model by more than a thousandth of its size; None: it does not."""
    import numpy as np

    low, high = model.aabb()
    rounding = 0.5 * float(np.spacing(np.float32(np.abs([low, high]).max())))
    if rounding < 1e-3 * float((high - low).max()):
        return None
    return (
        f"the format's origin is float32: the model's place is rounded, by up to {rounding:.2g} units; its shape is not"
    )


def _relative(model: Model, up: Up) -> str | None:
    """A sentence where a format of float32 positions has them relative to a point near them; None: as they are."""
    import numpy as np

    from nerfvol.export.splats import splats_of
    from nerfvol.splats.near import relative

    low, high = model.aabb()
    if float(np.spacing(np.float32(np.abs([low, high]).max()))) < 1e-7 * float((high - low).max()):
        return None  # far from where digits are lost
    offset = relative(splats_of(model, up))[1]
    if not offset.any():
        return None
    told = ", ".join(f"{v:.12g}" for v in offset)
    return (
        f"positions are written relative to ({told}): the format's float32 would not tell them apart there; add it to have "
        "the units of the poses"
    )


def _cameras(target: Target, name: str | None) -> Cameras | None:
    """Those of a camera path or a data set; where no name is given, of the run's data, if they are there."""
    from nerfvol.cameras.paths import load_cameras
    from nerfvol.export.surface import Cameras

    data = name or run_settings(target.name).get("data")
    if not data or name is None and not Path(data).exists():
        return None
    if Path(data).is_file():
        cameras = load_cameras(data)
        return Cameras(cameras, [f"{i:04d}.png" for i in range(len(cameras))], str(data))
    from nerfvol.datasets.formats import find_format
    from nerfvol.datasets.load import load_dataset

    dataset = load_dataset(data, "train")
    frames = find_format(Path(data)).reader.read(Path(data), "train").frames
    return Cameras(dataset.cameras, [frame.path.name for frame in frames if frame.path is not None], str(data))


COMMAND = Command(
    summary="Write a model as a file that other programs open.",
    example="nerfvol export run --out scene.glb\nnerfvol export run --out scene.vdb --level 8\n"
    "nerfvol export run --out points.ply --crop -1,-1,0,1,1,1",
    options=ExportOptions,
    arguments=arguments,
    run=run,
    place=35,
)
