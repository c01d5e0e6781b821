"""A model: what nerfvol draws, scores and saves, whatever it is made of; and the one way to open a file of it.

A representation joins by a class with :class:`Model`'s methods and a row in :data:`FORMATS`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.files.arrayfile import ArrayFile
from nerfvol.files.run_folder import model_path

Float = NDArray[np.float32]


class Model(Protocol):
    """A representation with what it knows of itself. ``metadata``: JSON-able; "background", "orbit" and "provenance"."""

    kind: str
    metadata: dict[str, Any]

    def render(
        self,
        camera: Camera,
        background: Sequence[float] | None = None,
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = DEFAULT_EARLY_STOP,
        lod: float = DEFAULT_LOD,
    ) -> dict[str, Float]:
        """One view: float32 (H, W, 3) or (H, W) for each of ``outputs`` (views.render_image says which there are).

        background: RGB in [0, 1]; None: the model's own. early_stop_eps: a ray ends where its transmittance falls below;
        0 is exact. lod: pixels below which a representation with levels of detail draws something coarser; 0: never.
        """
        ...

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner of what there is, scene units."""
        ...

    def describe(self) -> dict[str, Any]:
        """Counts, sizes and bytes in memory, JSON-able."""
        ...

    def save(self, path: str | os.PathLike[str], storage: str = "compact") -> int:
        """Writes the model atomically; the file's bytes."""
        ...


FORMATS = {
    "nerfvol octree": "nerfvol.views:OctreeModel",
}
"""The ``format`` key of a file's document, and the class whose ``load`` opens it."""


def load_model(target: str | os.PathLike[str]) -> Model:
    """The model in a run folder or a file.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    path = model_path(target)
    with ArrayFile(path, "model file") as file:
        known = FORMATS.get(str(file.document.get("format")))
    if known is None:
        raise InputError(f"{path}: its format is {file.document.get('format')!r}, expected one of {', '.join(FORMATS)}")
    module, _, name = known.partition(":")
    return cast(Model, getattr(importlib.import_module(module), name).load(path))


def save_model(path: str | os.PathLike[str], model: Model, storage: str = "compact") -> int:
    """Writes ``model`` to ``path`` atomically and returns the file's bytes. ``storage``: docs/file_format.md."""
    return model.save(path, storage)
