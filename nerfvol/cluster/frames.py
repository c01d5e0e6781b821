"""Views of a film drawn by the workers of a cluster, in the form in which nerfvol.film draws them here."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfvol.cameras.camera import Camera
from nerfvol.cluster.needs import Needs
from nerfvol.cluster.share import lend, lent, shared_out
from nerfvol.cluster.ship import describe
from nerfvol.cluster.tasks import Job
from nerfvol.film import Film, with_progress
from nerfvol.models import Model, load_model

if TYPE_CHECKING:
    from distributed import Client

MODEL, COMPARED = "model", "compared"


def settings_of(film: Film, **more: Any) -> dict[str, Any]:
    """Everything that a film's views depend on but models and cameras, JSON-able."""
    return {
        "background": list(film.background), "aov": list(film.aov), "early_stop_eps": film.early_stop_eps, "lod": film.lod,
        "output": film.output, "composite": getattr(film.model, "composite", None), **more,
    }  # fmt: skip


def identity(film: Film, files: Mapping[str, Path], **more: Any) -> str:
    """A hash of what is drawn: the models' files, settings and cameras."""
    digest = hashlib.sha256(json.dumps(settings_of(film, **more), sort_keys=True).encode())
    for name in sorted(files):
        digest.update(name.encode() + hashlib.sha256(files[name].read_bytes()).digest())
    for camera in film.cameras:
        digest.update(repr(camera.intrinsics).encode() + camera.c2w.tobytes())
    return digest.hexdigest()


class OnCluster:
    """Draws a film's views on the workers of the engine ``where`` (film.Each), an address or a client of one.

    ``say``: gets sentences on workers that take no part. The engine is asked for when the first view is.
    """

    def __init__(
        self, where: str | Client, film: Film, files: Mapping[str, Path], say: Callable[[str], object], **more: Any
    ) -> None:
        self._where, self._say = where, say
        self._film, self._files, self._more = film, files, more

    def __call__(self, draw: Callable[[Camera], Any], cameras: Sequence[Camera]) -> Iterator[Any]:
        """The views in order; ``draw`` says what to do here and is done there, by the name in the settings."""
        film, shipped = self._film, {name: describe(path) for name, path in self._files.items()}
        for name, model in ((MODEL, film.model), (COMPARED, film.compare)):
            if model is not None:
                lend(shipped[name].path, model, shipped[name].path)
        settings = settings_of(film, depths=list(film.depths()), **self._more)
        job = Job("nerfvol.cluster.frames:draw", settings, shipped)
        needs = Needs(room=sum(file.size for file in shipped.values()))
        return with_progress(shared_out(self._where, job, needs, list(cameras), self._say), len(cameras))


def draw(settings: Mapping[str, Any], files: Mapping[str, Path], camera: Camera) -> Any:
    """What Film.files or, with settings["suffix"] None, Film.video_frames gives of one view. A task (cluster.tasks)."""
    film = _film(json.dumps(settings, sort_keys=True), files[MODEL], files.get(COMPARED))
    near, far = settings["depths"]
    if settings["suffix"] is None:
        return film.video_frames(camera, (near, far))
    return film.files(camera, (near, far), settings["suffix"])


@functools.lru_cache(maxsize=2)
def _film(settings: str, model: Path, compared: Path | None) -> Film:
    """The film that a worker draws; it keeps the last ones open."""
    s = json.loads(settings)
    opened = _opened(model)
    if s["composite"] is not None:
        opened.composite = s["composite"]  # type: ignore[attr-defined]
    compare = None if compared is None else _opened(compared)
    return Film(opened, [], s["background"], s["aov"], s["early_stop_eps"], s["lod"], s["output"], compare)


def _opened(path: Path) -> Model:
    """The model at ``path``, which this process or the one it is a copy of may have open."""
    return lent(str(path), path) or load_model(path)
