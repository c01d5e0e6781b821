"""A model: what nerfvol draws, scores and saves, whatever it is made of; and the one way to open a file of it.

A representation joins by a class with :class:`Model`'s methods and a row in :data:`FORMATS`.
"""

from __future__ import annotations

import importlib
import operator
import os
from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError, shown
from nerfvol.files.arrayfile import ArrayFile
from nerfvol.files.page import model_file
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
    "nerfvol octree": "nerfvol.views:OctreeModel.load",
    "nerfvol splats": "nerfvol.views:SplatModel.load",
    "nerfvol field": "nerfvol.neural:FieldModel.load",
    "nerfvol medium": "nerfvol.medium.model:MediumModel.load",
}
"""The ``format`` key of a file's document, and what opens it."""
SUFFIXES = {
    ".ply": "nerfvol.clouds:load_ply_model", ".spz": "nerfvol.views:SplatModel.load",
    ".splat": "nerfvol.views:SplatModel.load", ".npz": "nerfvol.views:OctreeModel.load_plenoctree",
}  # fmt: skip
"""Files of other programs, by the end of their names, and what opens them."""
NOT_READ = {
    ".ksplat": "Gaussians as GaussianSplats3D keeps them", ".sog": "Gaussians as PlayCanvas keeps them in pictures",
    ".lcc": "Gaussians as XGRIDS keeps them", ".splatv": "Gaussians that move",
}  # fmt: skip
"""Files that splat-transform and SuperSplat, or their own program, can write as a .ply; what they hold."""


def load_model(target: str | os.PathLike[str]) -> Model:
    """The model in a run folder or a file: our own octrees, splats, fields and media, the first two also in a page (.html),
    Gaussians or points in a .ply, Gaussians in a .spz or .splat, a PlenOctree in an .npz.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    with model_file(model_path(target)) as path:
        opener = SUFFIXES.get(path.suffix.lower())
        if opener is None:
            stated = describe_file(path).get("format")
            stated = stated if isinstance(stated, str) else shown(stated)
            if stated not in FORMATS:
                raise InputError(f"{path}: its format is {shown(stated)}, expected one of {', '.join(FORMATS)}")
            opener = FORMATS[stated]
        module, _, name = opener.partition(":")
        return cast(Model, operator.attrgetter(name)(importlib.import_module(module))(path))


def describe_file(target: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON document in a model's file; of other programs' files the format alone."""
    named = model_path(target)
    if held := NOT_READ.get(named.suffix.lower()):
        others = f"SuperSplat or 'splat-transform {named.name} {named.stem}.ply' do"
        by = "the program that made it may" if named.suffix.lower() == ".splatv" else others
        raise InputError(f"{named} holds {held}, which nerfvol does not read: export it as .ply, as {by}")
    if named.suffix.lower() in SUFFIXES:
        return {"format": named.suffix.lower()}
    with model_file(named) as path:
        try:
            with ArrayFile(path, "model file") as file:
                return file.document
        except InputError as error:
            raise InputError(
                f"{error} (a model is a run folder, its .safetensors file, a page, {', '.join(SUFFIXES)})"
            ) from error


def save_model(path: str | os.PathLike[str], model: Model, storage: str = "compact") -> int:
    """Writes ``model`` to ``path`` atomically and returns the file's bytes. ``storage``: docs/file_format.md."""
    return model.save(path, storage)
