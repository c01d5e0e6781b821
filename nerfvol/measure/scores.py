"""Scores of a representation on posed images: PSNR and SSIM per view, their means, and the time a view took."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.images import map_threads
from nerfvol.defaults import DEFAULT_EARLY_STOP, DEFAULT_LOD
from nerfvol.errors import InputError
from nerfvol.files import pictures
from nerfvol.kernels import ops
from nerfvol.measure.colour_fit import apply_map, fit_colour_map
from nerfvol.measure.metrics import psnr, ssim
from nerfvol.measure.pose_fit import REFINED, fit_poses
from nerfvol.models import Model
from nerfvol.views import SplatModel, depth_range, surface_depth

LARGEST_PSNR = 100.0
"""Equal images have infinite PSNR, which JSON cannot say; an 8-bit image has 100 dB only where it is equal."""

COLOUR_MAPS = "colour_maps"
"""Key of a model's metadata: whether photographs were mapped to one exposure."""

MEANS = ("psnr", "ssim", "psnr_posed", "ssim_posed", "psnr_fitted", "ssim_fitted")
"""What rows may have and summaries average: plain, after a fit of the view's pose, and after one of its colours (there)."""

Float = NDArray[np.float32]


def score_views(
    render: Callable[[Camera], Float],
    dataset: Dataset,
    background: Sequence[float],
    on_view: Callable[[int, Float, Float], None] | None = None,
    colour_fit: bool = False,
    fitted: Sequence[Camera] | None = None,
) -> dict[str, Any]:
    """Scores of ``render`` (camera -> (H, W, 3) float32) against every image of ``dataset`` over ``background``.

    Returns psnr and ssim (means of the per-view values), seconds_per_frame (median, without the first) and rows with name,
    psnr, ssim and seconds. Renders are clipped to [0, 1] first. ``on_view(index, truth, render)`` sees each pair. Pixels that
    masks leave out, or that the lens does not reach, take no part; views of which nothing is left have no row. ``colour_fit``:
    also psnr_fitted and ssim_fitted, of the render after the colour map that brings it nearest to the photograph
    (measure.colour_fit): without what the camera's exposure and white balance do. ``fitted``: cameras whose poses were fitted
    to the model (measure.pose_fit): also psnr_posed and ssim_posed, seen from there, and the colour fit is made there.
    """

    def score(rendered: tuple[int, Float, Float, float]) -> dict[str, Any]:
        index, image, posed, seconds = rendered
        if fitted is None:
            return score_view(image, dataset, index, background, colour_fit) | {"seconds": seconds}
        there = score_view(posed, dataset, index, background, colour_fit)
        moved = {f"{name}_posed": there.pop(name) for name in ("psnr", "ssim")}
        return score_view(image, dataset, index, background, False) | moved | there | {"seconds": seconds}

    rows, at_once = [], ops.get_threads()
    scored = scored_views(dataset)
    for first in range(0, len(scored), at_once):
        # A few views one after the other, for their times; then their scores side by side.
        few = []
        for index in scored[first : first + at_once]:
            started = time.perf_counter()
            image = render(dataset.cameras[index])
            seconds = time.perf_counter() - started
            posed = image if fitted is None else render(fitted[index])
            few.append((index, np.clip(image, 0.0, 1.0), np.clip(posed, 0.0, 1.0), seconds))
        rows += map_threads(score, few, at_once)
        if on_view is not None:
            for index, _, image, _ in few:
                on_view(index, dataset.composited(index, background), image)
    return summarised(rows)


def scored_views(dataset: Dataset) -> list[int]:
    """The views that have something to score; InputError where none has."""
    scored = [i for i in range(len(dataset)) if (seen := _seen(dataset, i)) is None or seen.any()]
    if not scored:
        raise InputError(f"{dataset.source}: masks leave nothing of the images to score")
    return scored


def score_view(
    image: Float, dataset: Dataset, index: int, background: Sequence[float], colour_fit: bool
) -> dict[str, Any]:
    """One row of :func:`score_views` but for its seconds: of the render ``image`` (H, W, 3) in [0, 1] of view ``index``."""
    truth, seen = dataset.composited(index, background), _seen(dataset, index)

    def scores(of: Float) -> tuple[float, float]:
        error = psnr(of, truth) if seen is None else psnr(of[seen], truth[seen])
        return min(error, LARGEST_PSNR), ssim(of, truth, seen)

    row: dict[str, Any] = {"name": dataset.names[index]}
    row["psnr"], row["ssim"] = scores(image)
    if colour_fit:
        colours = fit_colour_map(image, truth) if seen is None else fit_colour_map(image[seen], truth[seen])
        row["psnr_fitted"], row["ssim_fitted"] = scores(np.clip(apply_map(colours, image), 0, 1))
    return row


def summarised(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What :func:`score_views` returns of its rows. The first view also made what all share, so that its time is no frame's."""
    means = [name for name in MEANS if name in rows[0]]
    return {
        **{name: statistics.fmean(row[name] for row in rows) for name in means},
        "seconds_per_frame": statistics.median(row["seconds"] for row in rows[1:] or rows),
        "rows": rows,
    }


def _seen(dataset: Dataset, index: int) -> NDArray[np.bool_] | None:
    """The pixels (h, w) of a view that count, None for all."""
    mask = dataset.mask(index)
    return None if mask is None else mask > 127


def evaluate(
    model: Model,
    dataset: Dataset,
    background: Sequence[float],
    early_stop_eps: float = DEFAULT_EARLY_STOP,
    lod: float = DEFAULT_LOD,
    on_view: Callable[[int, Float, Float], None] | None = None,
) -> dict[str, Any]:
    """What :func:`score_views` returns of ``model``, drawn as ``nerfvol render`` draws it (see models.Model.render).

    Models of photographs whose exposure differed are scored after a colour fit as well, and models whose cameras were refined
    after a fit of each view's pose (``on_view`` sees these). ``background``: (3,) in [0, 1].
    ``on_view(index, truth, render)`` sees each pair, both (H, W, 3) float32 in [0, 1].
    """

    def render(camera: Camera) -> Float:
        return model.render(camera, background, ("rgb",), early_stop_eps, lod)["rgb"]

    fitted = None
    if isinstance(model, SplatModel) and REFINED in model.metadata:
        fitted = fit_poses(model, dataset, background)
    return score_views(render, dataset, background, on_view, has_colour_maps(model), fitted)


def has_colour_maps(model: Model) -> bool:
    """Whether a model was trained on photographs that were mapped to one exposure (training.appearance)."""
    return bool(getattr(model, "metadata", {}).get(COLOUR_MAPS))


def comparison_writer(
    folder: Path, model: Model, dataset: Dataset, background: Sequence[float], early_stop_eps: float, lod: float
) -> Callable[[int, Float, Float], None]:
    """For :func:`evaluate`'s on_view: writes truth | render | error | depth of each view to ``folder``.

    One PNG a view by its name, H pixels high; truth and render are (H, W, 3) float32 in [0, 1].
    """
    depths = depth_range(model, dataset.cameras)

    def write(index: int, truth: Float, image: Float) -> None:
        camera = dataset.cameras[index]
        geometry = model.render(camera, background, ("opacity", "depth"), early_stop_eps, lod)
        depth = pictures.depth_to_grey(surface_depth(geometry), geometry["opacity"], *depths)
        panels = [truth, image, pictures.error_map(truth, image), depth]
        pictures.write_png(folder / f"{dataset.names[index]}.png", pictures.side_by_side(panels))

    return write
