"""What a viewer shows: a model that may be replaced while it is looked at, and the photographs it was made from."""

from __future__ import annotations

import io
import math
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol.cameras.paths import load_cameras
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.export.page import page_settings, poster
from nerfvol.export.page_size import stored
from nerfvol.export.part import part_of
from nerfvol.files.atomic import write_bytes
from nerfvol.files.pictures import error_map, to_uint8
from nerfvol.film import Film, write_videos
from nerfvol.models import Model

LARGEST_COMPARED = 800
"""Pixels along the longer side of a picture that is compared with its photograph."""
MOST_FRAMES = 20_000


@dataclass(frozen=True)
class Edition:
    """A model as it is at one moment: its compact file, and the page's settings; version: counts from 1."""

    version: int
    model: Model
    data: bytes
    settings: dict[str, Any]
    poster: str
    sentence: str


class Shown:
    """The present edition, for many threads. name: of the scene; dataset: the photographs; None: there are none."""

    def __init__(self, name: str, dataset: Dataset | None = None) -> None:
        self.name, self.dataset = name, dataset
        self._edition: Edition | None = None
        self._changed = threading.Condition()
        self._drawing = threading.Lock()
        self.training, self.paused = False, False

    @property
    def edition(self) -> Edition | None:
        """The newest; None before the first."""
        return self._edition

    def publish(self, model: Model, sentence: str = "") -> Edition:
        """Makes ``model`` the present edition: encodes it, which takes seconds for a large one, and wakes who waits."""
        data = stored(model)
        before = self._edition
        if before is None:
            with self._drawing:
                settings = page_settings(model, self.name)
                first = poster(model, settings)
        else:
            settings, first = before.settings, before.poster
        edition = Edition(1 + (before.version if before else 0), model, data, settings, first, sentence)
        with self._changed:
            self._edition = edition
            self._changed.notify_all()
        return edition

    def wait(self, version: int, seconds: float) -> Edition | None:
        """The present edition once it is newer than ``version``, or after ``seconds``."""
        with self._changed:
            self._changed.wait_for(lambda: self._edition is not None and self._edition.version > version, seconds)
            return self._edition

    # ------------------------------------------------------------------ a training that is looked at
    def pause(self, paused: bool) -> None:
        """Lets the training stand still after its present step, or go on; without one, nothing."""
        with self._changed:
            self.paused = paused and self.training
            self._changed.notify_all()

    def wait_while_paused(self, stopped: Callable[[], bool]) -> None:
        """Until nobody pauses any more, or ``stopped()``, which is asked every fifth of a second."""
        with self._changed:
            while self.paused and not stopped():
                self._changed.wait(0.2)

    def state(self) -> dict[str, Any]:
        """Version and sentence of the present edition, whether a training is on its way and whether it is paused; JSON-able."""
        edition = self._edition
        version, sentence = (edition.version, edition.sentence) if edition else (0, "")
        return {"version": version, "sentence": sentence, "training": self.training, "paused": self.paused}

    # ------------------------------------------------------------------ photographs
    def cameras(self) -> list[dict[str, Any]]:
        """Name, pose (4, 4), field of view across the shorter side (radians) and size of each photograph, JSON-able."""
        if self.dataset is None:
            return []
        rows = []
        for name, camera in zip(self.dataset.names, self.dataset.cameras, strict=True):
            lens = camera.intrinsics
            fov = 2 * math.atan(0.5 * min(lens.width, lens.height) / lens.fx)
            rows.append({"name": name, "c2w": camera.c2w.tolist(), "fov": fov, "size": [lens.width, lens.height]})
        return rows

    def photograph(self, index: int) -> bytes:
        """The photograph as JPEG; LookupError where there is none of that number."""
        return _jpeg(self._truth(index))

    def compare(self, index: int) -> tuple[float, bytes]:
        """PSNR of the present model's picture against the photograph, and the map of its error as JPEG.

        LookupError where there is no such photograph, or no model.
        """
        truth, edition = self._truth(index), self._edition
        if edition is None or self.dataset is None:
            raise LookupError("there is no model yet")
        camera = self.dataset.cameras[index]
        k = max(1, -(-max(truth.shape[:2]) // LARGEST_COMPARED))
        if k > 1:
            height, width = truth.shape[0] // k, truth.shape[1] // k
            truth = truth[: height * k, : width * k].reshape(height, k, width, k, 3).mean((1, 3))
        image = self.draw(edition.model, camera.scaled(k), edition.settings["background"])
        error = float(((np.clip(image, 0, 1) - truth) ** 2).mean())
        return -10 * math.log10(max(error, 1e-10)), _jpeg(error_map(truth.astype(np.float32), image))

    def draw(self, model: Model, camera: Any, background: Any) -> np.ndarray:
        """(H, W, 3), one picture at a time: all of them want every core."""
        with self._drawing:
            return model.render(camera, background)["rgb"]

    def _truth(self, index: int) -> np.ndarray:
        if self.dataset is None or not 0 <= index < len(self.dataset):
            raise LookupError(f"there is no photograph {index}")
        background = self._edition.settings["background"] if self._edition else (1.0, 1.0, 1.0)
        return self.dataset.composited(index, background)


def _jpeg(image: np.ndarray) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(out, "JPEG", quality=90)
    return out.getvalue()


class Stopped(Exception):
    """A video is not wanted any more."""


class Video:
    """A camera path on its way to an MP4 in ``folder``, drawn by the native kernels in a thread of its own."""

    def __init__(
        self, shown: Shown, edition: Edition, path: bytes, fps: int, folder: Path, crop: Sequence[float] | None = None
    ) -> None:
        """path: a camera path as JSON, see cameras.paths.load_cameras; crop: the box that alone is drawn (export.part).

        Raises:
            InputError: it is no path, or nothing of the model lies in the box.
        """
        with tempfile.TemporaryDirectory() as place:
            written = Path(place) / "path.json"
            write_bytes(written, path)
            try:
                self._cameras = load_cameras(written)
            except InputError as error:
                raise InputError(str(error).replace(str(written), "the path")) from error
        if len(self._cameras) > MOST_FRAMES:
            raise InputError(f"the path has {len(self._cameras)} pictures, at most {MOST_FRAMES} are drawn")
        self._shown, self._edition, self._fps = shown, edition, fps
        self.crop, self._model = crop, part_of(edition.model, crop=crop)
        self.file = folder / "path.mp4"
        self.done, self.fault, self._stop = 0, "", False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def state(self) -> dict[str, Any]:
        """Pictures drawn and to be drawn, whether it is finished, and what went wrong; JSON-able."""
        return {
            "done": min(self.done, len(self._cameras)),
            "of": len(self._cameras),
            "finished": not self._thread.is_alive(),
            "fault": self.fault,
        }

    def stop(self) -> None:
        """Ends it after the present picture."""
        self._stop = True
        self._thread.join()

    def render(self, camera: Any, background: Any = None, outputs: Any = ("rgb",), *rest: Any) -> dict[str, Any]:
        """One picture of the path: the model's, counted (a Model as far as films ask)."""
        if self._stop:
            raise Stopped
        with self._shown._drawing:
            image = self._model.render(camera, background, outputs, *rest)
        self.done += "rgb" in outputs
        return image

    def aabb(self) -> Any:
        """As the model's."""
        return self._model.aabb()

    def _run(self) -> None:
        try:
            background = self._edition.settings["background"]
            write_videos(self.file, Film(self, self._cameras, background), self._fps)  # type: ignore[arg-type]
        except Stopped:
            self.fault = "stopped"
        except Exception as error:  # the page says it
            self.fault = str(error) or type(error).__name__
