"""Views of a data set scored by the workers of a cluster, as nerfvol.measure.scores does it here."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.cluster.needs import Needs, with_data
from nerfvol.cluster.share import lend, lent, shared_out
from nerfvol.cluster.ship import describe
from nerfvol.cluster.tasks import Job
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.load import load_dataset
from nerfvol.film import with_progress
from nerfvol.measure import scores
from nerfvol.models import Model, load_model

if TYPE_CHECKING:
    from distributed import Client

LOADING = ("data", "split", "downscale", "holdout", "scene")


def evaluate(
    where: str | Client, target: Path, model: Model, dataset: Dataset, settings: Mapping[str, Any],
    say: Callable[[str], object], on_view: Callable[[int, Any, Any], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """What scores.evaluate returns of ``model``, which lies at ``target``; the views are drawn and scored by the workers of
    the engine ``where``, an address or a client of one.

    ``settings``: background, early_stop_eps, lod and LOADING, with which ``dataset`` was loaded; the workers must have the same
    files at the same place. ``say``: gets sentences on workers that take no part.
    """
    file, data = describe(target), str(Path(settings["data"]).resolve())
    job = Job("nerfvol.cluster.views:score", {**settings, "data": data, "image": on_view is not None}, {"model": file})
    lend(file.path, (model, dataset), file.path)
    indices = scores.scored_views(dataset)
    views = [
        (index, dataset.cameras[index]) for index in indices
    ]  # cameras may be other than the files': refined, turned
    results = shared_out(where, job, Needs(data=with_data([data]), room=file.size), views, say)
    rows = []
    for index, (row, image) in zip(indices, with_progress(results, len(indices)), strict=True):
        rows.append(row)
        if on_view is not None:
            on_view(index, dataset.composited(index, settings["background"]), image)
    return scores.summarised(rows)


def score(
    settings: Mapping[str, Any], files: Mapping[str, Path], view: tuple[int, Camera]
) -> tuple[dict[str, Any], Any]:
    """The row of one view, by number and camera, and its render where settings["image"] asks for it. A task (cluster.tasks)."""
    path, (index, camera) = files["model"], view
    model, dataset = lent(str(path), path) or _opened(json.dumps(dict(settings), sort_keys=True), path)
    started = time.perf_counter()
    drawing = settings["background"], ("rgb",), settings["early_stop_eps"], settings["lod"]
    image = model.render(camera, *drawing)["rgb"]
    seconds = time.perf_counter() - started
    image = np.clip(image, 0.0, 1.0)
    row = scores.score_view(image, dataset, index, settings["background"], scores.has_colour_maps(model))
    return row | {"seconds": seconds}, image if settings["image"] else None


@functools.lru_cache(maxsize=1)
def _opened(settings: str, path: Path) -> tuple[Model, Dataset]:
    """Model and data set, which a worker keeps open."""
    s = json.loads(settings)
    return load_model(path), load_dataset(s["data"], s["split"], s["downscale"], holdout=s["holdout"], scene=s["scene"])
