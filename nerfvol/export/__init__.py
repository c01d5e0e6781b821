"""Exports: one file a format, ``write(model, path, **options) -> bytes written``, and one row in :data:`EXPORTS`.

A writer takes only models of the kinds in its row. ``memory(model, **options)`` next to it says how many bytes writing takes,
and is asked before. Help and error messages are made from the rows. No numpy here: help answers at once.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.models import Model


@dataclass(frozen=True)
class Export:
    """name: what ``--format`` calls it; suffixes: ends of file names; module: where ``write`` and ``memory`` are; kinds: models
    it holds; opened_by: one phrase; options: the names of what ``write`` takes besides model and path; by_name: further
    kinds that it holds where ``--format`` asks for it; levels: whether an octree may be written at a coarser level."""

    name: str
    suffixes: tuple[str, ...]
    module: str
    kinds: tuple[str, ...]
    opened_by: str
    options: tuple[str, ...] = ()
    by_name: tuple[str, ...] = ()
    levels: bool = False


ALL = ("octree", "splats", "points")
EXPORTS: tuple[Export, ...] = (
    Export(
        "splats", (".ply",), "nerfvol.export.splats", ("splats", "points"), "splat viewers (SuperSplat, Spark, Brush)",
        ("up",), ("octree",), levels=True,
    ),
    Export(
        "spz", (".spz",), "nerfvol.export.spz", ALL, "Niantic's and PlayCanvas' viewers; needs gsply", ("up",), levels=True,
    ),
    Export(
        "points", (".ply",), "nerfvol.export.points", ALL, "Blender, MeshLab, CloudCompare",
        ("method", "threshold", "views", "cameras", "resolution", "up"),
    ),
    Export(
        "mesh", (".glb", ".obj", ".ply"), "nerfvol.export.mesh", ("octree", "splats"),
        "Blender, MeshLab, three.js, game engines; needs scikit-image", ("views", "cameras", "resolution", "up"),
    ),
    Export("vdb", (".vdb",), "nerfvol.export.vdb", ("octree",), "Blender, Houdini", ("full_float", "srgb"), levels=True),
    Export(
        "grid", (".npz", ".npy", ".nii", ".nii.gz", ".vti"), "nerfvol.export.grid", ("octree", "field"),
        "numpy; 3D Slicer, napari, Niivue (.nii); ParaView (.vti)", ("resolution", "quantity"),
    ),
    Export("plenoctree", (".npz",), "nerfvol.export.plenoctree", ("octree",), "svox, volrend", levels=True),
    Export("htg", (".htg",), "nerfvol.export.htg", ("octree",), "ParaView 5.11 and later", levels=True),
    Export("transforms", (".json",), "nerfvol.export.transforms", ALL, "nerfstudio, instant-ngp", ("cameras",)),
    Export("colmap", ("",), "nerfvol.export.colmap", ALL, "COLMAP, 3DGS trainers, OpenMVS (a folder)", ("cameras",)),
    Export(
        "page", (".html",), "nerfvol.export.page", ALL, "every browser, by a double click", ("max_bytes",), levels=True,
    ),
)  # fmt: skip
"""Of several rows with one suffix the first that holds the model is taken, unless ``--format`` names another. A row with
the suffix ""
writes a folder, and is taken by name alone."""


class Exported(NamedTuple):
    """What was written: its row, bytes, and the finest level of an octree (else None)."""

    row: Export
    size: int
    level: int | None = None


def choose(path: str | os.PathLike[str], kind: str, name: str | None = None) -> Export:
    """The row for a file called ``path`` and a model of ``kind``; ``name``: as asked for by ``--format``.

    Raises:
        InputError: an unknown suffix or name, or a format that holds no such model; says what there is.
    """
    known = sorted({s for row in EXPORTS for s in row.suffixes if s})
    suffix = max((s for s in known if Path(path).name.lower().endswith(s)), key=len, default=Path(path).suffix.lower())
    if suffix not in known and not (suffix == "" and name in {row.name for row in EXPORTS if "" in row.suffixes}):
        what = f"unknown extension {suffix}" if suffix else f"{path} has no extension"
        raise InputError(f"{what}: expected {_listed(known)}")
    rows = [row for row in EXPORTS if suffix in row.suffixes]
    if name is not None:
        if name not in {row.name for row in EXPORTS}:
            raise InputError(f"unknown format {name!r}: expected {_listed([row.name for row in EXPORTS])}")
        if name not in {row.name for row in rows}:
            raise InputError(
                f"the format {name} is not written to {suffix}, which is for {_listed([r.name for r in rows])}"
            )
        rows = [row for row in rows if row.name == name]
    for row in rows:
        if kind in row.kinds or name is not None and kind in row.by_name:
            return row
    wanted = sorted({k for row in rows for k in row.kinds})
    mine = sorted({f"{s} ({row.name})" for row in EXPORTS if kind in row.kinds for s in row.suffixes if s})
    elsewhere = f", which goes to {_listed(mine)}" if mine else ""
    raise InputError(f"{suffix} ({rows[0].name}) holds {_listed(wanted)}, this is a model of {kind}{elsewhere}")


def export_model(
    model: Model,
    path: str | os.PathLike[str],
    name: str | None = None,
    free: int | None = None,
    *,
    level: int | None = None,
    max_bytes: int | None = None,
    crop: Sequence[float] | None = None,
    **options: Any,
) -> Exported:
    """Writes ``model`` to ``path`` atomically; the row that was chosen, the file's bytes and the level.

    Args:
        name: of the row, where several share the suffix.
        free: bytes of memory there are; None: asks the system.
        level: the finest level of an octree that is written, 1 or more.
        max_bytes: an octree is written at the finest level at which the file is no larger.
        crop: the box x0, y0, z0, x1, y1, z1, scene units, outside of which nothing is written.
        options: of the writer, by name; those that are None keep their defaults.

    Raises: InputError: see :func:`choose`; an option that the format does not take, nothing in the box, no level whose file
    is so small, too little memory, a path that cannot be written.
    """
    from nerfvol.export.part import part_of

    row = choose(path, model.kind, name)
    given = {key: value for key, value in options.items() if value is not None}
    if surplus := [key for key in given if key not in row.options]:
        takers = [r.name for r in EXPORTS if surplus[0] in r.options]
        raise InputError(f"{_option(surplus[0])} is no option of the format {row.name}, but of {_listed(takers)}")
    leveled = row.levels and model.kind == "octree"
    if not leveled and (level is not None or max_bytes is not None and "max_bytes" not in row.options):
        option, takers = "--max-bytes" if level is None else "--level", [r.name for r in EXPORTS if r.levels]
        raise InputError(f"{option} is for octrees written as {_listed(takers)}, this is {model.kind} as {row.name}")
    part = part_of(model, level, crop)
    if max_bytes is not None and "max_bytes" in row.options:  # a writer that knows better than whole levels
        given["max_bytes"], max_bytes = max_bytes, None
    if max_bytes is not None:
        return _fitting(row, part, path, free, max_bytes, given)
    return _write(row, part, path, path, free, given)


def _write(
    row: Export,
    model: Model,
    path: str | os.PathLike[str],
    place: str | os.PathLike[str],
    free: int | None,
    given: dict,
) -> Exported:
    """Writes to ``place``, which is ``path`` or a temporary name of it, once there is memory for it."""
    from nerfvol.machine import available_memory

    module = importlib.import_module(row.module)
    needed, free = module.memory(model, **given), available_memory() if free is None else free
    if free is not None and needed > 0.9 * free:
        hint = "; --crop or --level take less" if row.levels and model.kind == "octree" else ""
        raise InputError(
            f"writing {path} takes about {needed / 2**30:.2g} GiB of memory, {free / 2**30:.2g} GiB are free{hint}"
        )
    write = cast(Callable[..., int], module.write)
    return Exported(row, write(model, place, **given), _finest(model))


def _fitting(
    row: Export, model: Model, path: str | os.PathLike[str], free: int | None, most: int, given: dict
) -> Exported:
    """The file at the finest level at which it has at most ``most`` bytes."""
    from nerfvol.export.part import part_of
    from nerfvol.files.atomic import atomic_write

    smallest = 0
    for level in range(_finest(model) or 1, 0, -1):
        with contextlib.suppress(_TooLarge), atomic_write(path) as temporary:
            written = _write(row, part_of(model, level), path, temporary, free, given)
            smallest = written.size
            if written.size > most:
                raise _TooLarge
            return written
    raise InputError(f"--max-bytes {most}: {path} has {smallest} bytes even at level 1")


class _TooLarge(Exception):
    """A file is not kept."""


def _finest(model: Model) -> int | None:
    octree = getattr(model, "octree", None)
    return None if octree is None else octree.max_level


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _listed(words: list[str]) -> str:
    words = list(dict.fromkeys(words))
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}" if words else "nothing"
