"""One view of a scene and its files, rendered whole or, where several machines share the work, in pieces."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, cast

import numpy as np

from data_synth.cameras import Camera, Viewpoints
from data_synth.errors import InputError
from data_synth.image import Picture, encode_exr, encode_png
from data_synth.integrators import Integrator
from data_synth.parts import Part, joined
from data_synth.scene import Scene
from data_synth.suns import Sun, under

Files = dict[str, bytes]
"""The files of a view by the end of their names."""


class View(NamedTuple):
    """One picture of a data set: its number through the splits, its name below the folder, its camera, and the one light it
    is taken under; None: the scene's own."""

    number: int
    name: str
    camera: Camera
    sun: Sun | None = None


class Piece(NamedTuple):
    """What one machine renders at a time: a view, to files; or a part of one, to sums (``Integrator.sums``)."""

    view: View
    part: Part | None = None


Each = Callable[[Sequence[Piece]], Iterable[Files | np.ndarray]]
"""Renders pieces elsewhere (``render_piece``): what they become, in their order."""


class Renderable(Protocol):
    """What a folder of pictures is made of: a ``Scene``, or anything else that renders itself."""

    name: str
    viewpoints: Viewpoints
    aabb: np.ndarray
    integrators: tuple[str, ...]
    exposure: float
    parameters: dict

    def render(self, camera: Camera, *, seed: int = 0) -> Picture: ...

    def write_truth(self, out_dir: Path) -> None: ...


def render_view(scene: Renderable, camera: Camera, integrator: Integrator | None = None, seed: int = 0) -> Picture:
    """One view of any scene: by ``integrator`` if given, else the way the scene prefers."""
    if integrator is None:
        return scene.render(camera, seed=seed)
    if not isinstance(scene, Scene):
        raise InputError(f"--integrator: the {scene.name} renders itself, got {integrator}")
    return integrator.render(scene, camera, seed=seed)


def render_numbered(scene: Renderable, integrator: Integrator | None, seed: int, view: View) -> Picture:
    """One view; its seed is that of the data set and its number, whoever renders it."""
    return render_view(_lit(scene, view), view.camera, integrator, view_seed(seed, view))


def _lit(scene: Renderable, view: View) -> Renderable:
    if view.sun is None:
        return scene
    assert isinstance(scene, Scene)
    return under(scene, view.sun)


def view_seed(seed: int, view: View) -> int:
    """The seed of one view of a data set."""
    return (seed * 1_000_003 + view.number) & 0x7FFFFFFF


def encode(picture: Picture, exposure: float, exr: bool) -> Files:
    """The files of a picture."""
    files = {".png": encode_png(picture.rgba8(exposure))}
    return files | ({".exr": encode_exr(exr_channels(picture))} if exr else {})


def render_piece(
    scene: Renderable, integrator: Integrator | None, seed: int, exr: bool, piece: Piece
) -> Files | np.ndarray:
    """The files of a view, or the sums of a part of it."""
    if piece.part is None:
        return encode(render_numbered(scene, integrator, seed, piece.view), scene.exposure, exr)
    if integrator is None or not isinstance(scene, Scene):
        raise InputError(f"the {scene.name} renders itself: it has no parts")
    lit = _lit(scene, piece.view)
    assert isinstance(lit, Scene)
    return integrator.sums(lit, piece.view.camera, view_seed(seed, piece.view), piece.part)


def pieces_of(integrator: Integrator | None, views: Sequence[View]) -> list[Piece]:
    """The views one after the other; large ones in the parts that the integrator makes of them."""
    pieces = []
    for view in views:
        parts = integrator.parts(view.camera.height, view.camera.width) if integrator is not None else []
        pieces += [Piece(view, part) for part in parts] if len(parts) > 1 else [Piece(view)]
    return pieces


def rendered(each: Each, integrator: Integrator | None, views: Sequence[View]) -> Iterator[Files | Picture]:
    """Views rendered by ``each``: their files, or the picture of those that came in parts; in the order of ``views``."""
    pieces = pieces_of(integrator, views)
    made = iter(each(pieces))
    for _, group in itertools.groupby(pieces, key=lambda piece: piece.view.number):
        parts = [piece.part for piece in group if piece.part is not None]
        if not parts or integrator is None:
            yield cast(Files, next(made))
        else:
            yield integrator.picture(joined(parts, cast(Iterator[np.ndarray], made)))


def exr_channels(picture: Picture) -> dict[str, np.ndarray]:
    """Channels of a float picture: R, G, B (linear, premultiplied), A, Z (distance), variance of the mean."""
    channels = {name: picture.rgb[..., c] for c, name in enumerate("RGB")}
    channels |= {"A": picture.alpha, "Z": picture.distance}
    if picture.variance is not None:
        channels |= {f"variance.{name}": picture.variance[..., c] for c, name in enumerate("RGB")}
    return channels
