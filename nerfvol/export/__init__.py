"""Exports: one file a format, ``write(model, path, **options) -> bytes written``, and one row in :data:`EXPORTS`.

A writer takes only models of the kinds in its row. ``memory(model, **options)`` next to it says how many bytes writing takes,
and is asked before. Help and error messages are made from the rows. No numpy here: help answers at once.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.models import Model


@dataclass(frozen=True)
class Export:
    """name: what ``--format`` calls it; suffixes: ends of file names; module: where ``write`` and ``memory`` are; kinds: models
    it holds; opened_by: one phrase; options: the names of what ``write`` takes besides model and path."""

    name: str
    suffixes: tuple[str, ...]
    module: str
    kinds: tuple[str, ...]
    opened_by: str
    options: tuple[str, ...] = ()


EXPORTS: tuple[Export, ...] = (
    Export(
        "splats", (".ply",), "nerfvol.export.splats", ("splats", "points"), "splat viewers (SuperSplat, Spark, Brush)"
    ),
    Export(
        "spz", (".spz",), "nerfvol.export.spz", ("splats", "points"), "Niantic's and PlayCanvas' viewers; needs gsply"
    ),
    Export(
        "points",
        (".ply",),
        "nerfvol.export.points",
        ("octree", "splats", "points"),
        "Blender, MeshLab, CloudCompare",
        ("threshold",),
    ),
    Export(
        "grid",
        (".npz", ".npy"),
        "nerfvol.export.grid",
        ("octree",),
        "numpy and what reads its files",
        ("resolution", "quantity"),
    ),
    Export(
        "page",
        (".html",),
        "nerfvol.export.page",
        ("octree", "splats", "points"),
        "every browser, by a double click",
        ("level", "max_bytes", "crop"),
    ),
)
"""Of several rows with one suffix the first that holds the model is taken, unless ``--format`` names another."""


def choose(path: str | os.PathLike[str], kind: str, name: str | None = None) -> Export:
    """The row for a file called ``path`` and a model of ``kind``; ``name``: as asked for by ``--format``.

    Raises:
        InputError: an unknown suffix or name, or a format that holds no such model; says what there is.
    """
    suffix = Path(path).suffix.lower()
    known = sorted({s for row in EXPORTS for s in row.suffixes})
    if suffix not in known:
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
        if kind in row.kinds:
            return row
    wanted = sorted({k for row in rows for k in row.kinds})
    mine = sorted({f"{s} ({row.name})" for row in EXPORTS if kind in row.kinds for s in row.suffixes})
    elsewhere = f", which goes to {_listed(mine)}" if mine else ""
    hint = "; train with --representation splats for it" if "splats" in wanted and kind == "octree" else ""
    raise InputError(f"{suffix} ({rows[0].name}) holds {_listed(wanted)}, this is a model of {kind}{elsewhere}{hint}")


def export_model(
    model: Model, path: str | os.PathLike[str], name: str | None = None, free: int | None = None, **options: Any
) -> tuple[Export, int]:
    """Writes ``model`` to ``path`` atomically; the row that was chosen and the file's bytes.

    Args:
        name: of the row, where several share the suffix.
        free: bytes of memory there are; None: asks the system.
        options: of the writer, by name; those that are None keep their defaults.

    Raises:
        InputError: see :func:`choose`; an option that the format does not take, too little memory, a path that cannot be
            written.
    """
    from nerfvol.machine import available_memory

    row = choose(path, model.kind, name)
    given = {key: value for key, value in options.items() if value is not None}
    if surplus := [key for key in given if key not in row.options]:
        takers = [r.name for r in EXPORTS if surplus[0] in r.options]
        raise InputError(
            f"--{surplus[0].replace('_', '-')} is no option of the format {row.name}, but of {_listed(takers)}"
        )
    module = importlib.import_module(row.module)
    needed, free = module.memory(model, **given), available_memory() if free is None else free
    if free is not None and needed > 0.9 * free:
        raise InputError(
            f"writing {path} takes about {needed / 2**30:.2g} GiB of memory, {free / 2**30:.2g} GiB are free"
        )
    write = cast(Callable[..., int], module.write)
    return row, write(model, path, **given)


def _listed(words: list[str]) -> str:
    words = list(dict.fromkeys(words))
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}" if words else "nothing"
