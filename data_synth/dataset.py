"""Render a scene into a folder in the NeRF-synthetic layout: transforms_{train,val,test}.json and RGBA PNG files."""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_synth import truth
from data_synth.cameras import Camera
from data_synth.errors import InputError
from data_synth.files import remove_leftovers, replacing
from data_synth.image import Picture
from data_synth.integrators import Integrator
from data_synth.scene import Scene
from data_synth.suns import LIGHTS, Sun, document, shared_out, suns_of
from data_synth.views import Each, Files, Renderable, View, encode, render_numbered, rendered

PLAN, PROVENANCE = "plan.json", "provenance.json"
"""What a set is of: while it is not complete, and then."""
SPLITS = ("train", "val", "test")


@dataclass
class Options:
    """How ``write_dataset`` renders.

    views: training views; a twentieth as many are added for validation and an eighth for testing (at least 1 and 2).
    size: (width, height) in pixels. exr: also write linear float EXR files with distance, and variance where known.
    integrator: None for the scene's own choice, else an object with ``render(scene, camera, seed)``.
    progress: called with (views done, views in all) after every view.
    chosen: of all views, counted through the splits, (first, last, step): these alone are rendered, and of these only those
    that are not there yet; the folder is complete, and says so, once all are, whoever made them. None: all.
    suns: so many lights for training views, one a view, and others for test views, in place of the scene's own (``suns.py``);
    0: the scene's own, all of them, in every view.
    each: renders views, large ones in parts, elsewhere; None: here, one after the other.
    """

    views: int = 60
    size: tuple[int, int] = (400, 400)
    seed: int = 0
    integrator: Integrator | None = None
    exr: bool = False
    progress: Callable[[int, int], None] | None = None
    chosen: tuple[int, int, int] | None = None
    each: Each | None = None
    suns: int = 0

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"--views: expected at least 1, got {self.views}")
        if self.seed < 0:
            raise InputError(f"--seed: expected a whole number from 0 on, got {self.seed}")
        if not 0 <= self.suns <= 1000:
            raise InputError(f"--suns: expected 0 to 1000, got {self.suns}")
        if min(self.size) < 1 or max(self.size) > 16384:
            raise InputError(f"--size: expected 1 to 16384 pixels a side, got {self.size[0]}x{self.size[1]}")


def split_cameras(scene: Renderable, views: int, size: tuple[int, int], seed: int) -> dict[str, list[Camera]]:
    """Disjoint camera sets by split: spirals over the scene's viewing band, turned differently for each split."""
    counts = {"train": views, "val": max(1, views // 20), "test": max(2, views // 8)}
    return {split: scene.viewpoints.spread(n, *size, seed=3 * seed + k) for k, (split, n) in enumerate(counts.items())}


def write_dataset(scene: Renderable, out_dir: str | os.PathLike, options: Options | None = None) -> Path:
    """Render every split of ``scene`` into ``out_dir`` and return the folder.

    Pictures are 8-bit sRGB PNG with straight alpha. ``transforms_*.json`` are written last, and an earlier set's go before its
    pictures do, so that a folder that has them is complete; ``provenance.json`` tells how to make the folder again. A set whose
    making was stopped goes on.
    """
    options = options or Options()
    out_dir = Path(out_dir)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: cannot make the folder {out_dir}: {error.strerror}") from error
    started = time.perf_counter()
    splits = split_cameras(scene, options.views, options.size, options.seed)
    suns = suns_of(scene, options.suns) if options.suns else []
    lit = shared_out(suns, splits)
    views, record = views_of(splits, lit), _provenance(scene, options)
    wanted = views
    if options.chosen is not None:
        first, last, step = options.chosen
        if last >= len(views):
            raise InputError(
                f"--frames {first}-{last}: there are the views 0-{len(views) - 1} (training, validation, test)"
            )
        wanted = views[first : last + 1 : step]
    if not _claim(out_dir, record, shared=options.chosen is not None):
        return out_dir
    remove_leftovers(out_dir)
    for split in splits:
        (out_dir / split).mkdir(exist_ok=True)
        remove_leftovers(out_dir / split)
    wanted = [view for view in wanted if not _is_there(out_dir, view, options.exr)]
    with ThreadPoolExecutor(1) as writer:  # compresses and writes a picture while the next one renders

        def encoded(picture: Picture) -> Future[Files]:
            return writer.submit(encode, picture, scene.exposure, options.exr)

        if options.each is None:
            made = (encoded(render_numbered(scene, options.integrator, options.seed, view)) for view in wanted)
        else:
            elsewhere = rendered(options.each, options.integrator, wanted)
            made = (encoded(found) if isinstance(found, Picture) else _done(found) for found in elsewhere)
        written = []
        for done, (view, files) in enumerate(zip(wanted, made, strict=True), 1):
            written.append(writer.submit(_write_files, out_dir / view.name, files))
            if options.progress:
                options.progress(done, len(wanted))
        for future in written:
            future.result()
    if not all(_is_there(out_dir, view, options.exr) for view in views):
        return out_dir
    for split, cameras in splits.items():
        _write_json(out_dir / f"transforms_{split}.json", _transforms(scene, split, cameras, lit[split]))
    if suns and isinstance(scene, Scene):
        _write_json(out_dir / LIGHTS, document(scene, suns))
    scene.write_truth(out_dir)
    _write_json(out_dir / PROVENANCE, record | {"seconds": round(time.perf_counter() - started, 3)})
    (out_dir / PLAN).unlink(missing_ok=True)
    return out_dir


def views_of(
    splits: Mapping[str, Sequence[Camera]], lit: Mapping[str, Sequence[Sun | None]] | None = None
) -> list[View]:
    """All views of a data set, in the order of its splits; ``lit``: their suns."""
    rows = [
        (f"{split}/r_{k}", camera, None if lit is None else lit[split][k])
        for split, cameras in splits.items()
        for k, camera in enumerate(cameras)
    ]
    return [View(number, *row) for number, row in enumerate(rows)]


def _done(files: Files) -> Future[Files]:
    future: Future[Files] = Future()
    future.set_result(files)
    return future


def _is_there(out_dir: Path, view: View, exr: bool) -> bool:
    return all((out_dir / f"{view.name}{end}").is_file() for end in ((".png", ".exr") if exr else (".png",)))


def _write_files(stem: Path, files: Future[Files]) -> None:
    for end, data in files.result().items():
        with replacing(stem.with_name(stem.name + end)) as temporary:
            temporary.write_bytes(data)


def _claim(out_dir: Path, record: dict, shared: bool) -> bool:
    """Makes the folder one that this set's pictures go to, so that its transforms never stand beside others' pictures; False
    where there is nothing to do.

    A set that was begun goes on. What was there of another set, or of this one when it is complete, goes first; unless the
    folder is ``shared`` with other processes: then a complete set of this kind is done, and anything else is refused.
    """
    plan, text = out_dir / PLAN, json.dumps(record, indent=1)
    if plan.is_file() and plan.read_text() == text:
        return True
    old = [p for p in out_dir.glob("*/*") if p.parent.name in SPLITS and re.fullmatch(r"r_\d+.*\.(png|exr)", p.name)]
    marks = [
        p for p in (plan, out_dir / PROVENANCE, out_dir / LIGHTS, *out_dir.glob("transforms_*.json")) if p.is_file()
    ]
    if shared and (old or marks):
        if not plan.is_file() and _complete(out_dir) == record:
            return False
        raise InputError(
            f"--out: {out_dir} holds pictures of another scene, or rendered otherwise: choose another folder"
        )
    for path in (*marks, *old):  # the marks of a complete set before its pictures
        path.unlink(missing_ok=True)
    with replacing(plan) as temporary:
        temporary.write_text(text)
    return True


def _complete(out_dir: Path) -> dict | None:
    """What a complete set is of."""
    try:
        found = json.loads((out_dir / PROVENANCE).read_text())
    except (OSError, ValueError):
        return None
    return {key: value for key, value in found.items() if key != "seconds"} if isinstance(found, dict) else None


def _transforms(scene: Renderable, split: str, cameras: list[Camera], lit: Sequence[Sun | None]) -> dict:
    frames = [
        {"file_path": f"./{split}/r_{k}", "transform_matrix": camera.c2w.tolist()}
        | ({} if sun is None else {"light": sun.name})
        for k, (camera, sun) in enumerate(zip(cameras, lit, strict=True))
    ]
    return {"camera_angle_x": cameras[0].angle_x, "aabb": scene.aabb.tolist(), "frames": frames}


def _provenance(scene: Renderable, options: Options) -> dict:
    import numba

    integrator = options.integrator
    return {
        "scene": scene.name,
        "parameters": dict(scene.parameters),
        "integrator": repr(integrator) if integrator is not None else scene.integrators[0],
        "views": options.views,
        "size": list(options.size),
        "seed": options.seed,
        **({"suns": options.suns} if options.suns else {}),
        **({"truth": truth.described(scene)} if isinstance(scene, Scene) else {}),
        "versions": {
            "data_synth": importlib.import_module("data_synth").__version__,
            "numpy": np.__version__,
            "numba": numba.__version__,
            "python": platform.python_version(),
        },
    }


def _write_json(path: Path, value: dict) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1))
