"""Render a scene into a folder in the NeRF-synthetic layout: transforms_{train,val,test}.json and RGBA PNG files."""

from __future__ import annotations

import importlib
import json
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from data_synth.cameras import Camera, Viewpoints
from data_synth.errors import InputError
from data_synth.image import Picture, replacing, write_exr, write_png
from data_synth.integrators import Integrator
from data_synth.scene import Scene


@dataclass
class Options:
    """How ``write_dataset`` renders.

    views: training views; a twentieth as many are added for validation and an eighth for testing (at least 1 and 2).
    size: (width, height) in pixels. exr: also write linear float EXR files with distance, and variance where known.
    integrator: None for the scene's own choice, else an object with ``render(scene, camera, seed)``.
    progress: called with (views done, views in all) after every view.
    """

    views: int = 60
    size: tuple[int, int] = (400, 400)
    seed: int = 0
    integrator: Integrator | None = None
    exr: bool = False
    progress: Callable[[int, int], None] | None = None

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"--views: expected at least 1, got {self.views}")
        if self.seed < 0:
            raise InputError(f"--seed: expected a whole number from 0 on, got {self.seed}")
        if min(self.size) < 1 or max(self.size) > 16384:
            raise InputError(f"--size: expected 1 to 16384 pixels a side, got {self.size[0]}x{self.size[1]}")


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


def split_cameras(scene: Renderable, views: int, size: tuple[int, int], seed: int) -> dict[str, list[Camera]]:
    """Disjoint camera sets by split: spirals over the scene's viewing band, turned differently for each split."""
    counts = {"train": views, "val": max(1, views // 20), "test": max(2, views // 8)}
    return {split: scene.viewpoints.spread(n, *size, seed=3 * seed + k) for k, (split, n) in enumerate(counts.items())}


def write_dataset(scene: Renderable, out_dir: str | os.PathLike, options: Options | None = None) -> Path:
    """Render every split of ``scene`` into ``out_dir`` and return the folder.

    Pictures are 8-bit sRGB PNG with straight alpha. ``transforms_*.json`` are written last, so that a folder that has
    them is complete; ``provenance.json`` tells how to make the folder again.
    """
    options = options or Options()
    out_dir = Path(out_dir)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: cannot make the folder {out_dir}: {error.strerror}") from error
    started = time.perf_counter()
    splits = split_cameras(scene, options.views, options.size, options.seed)
    total, done = sum(map(len, splits.values())), 0
    with ThreadPoolExecutor(1) as writer:  # compresses a picture while the next one renders
        written = []
        for split, cameras in splits.items():
            (out_dir / split).mkdir(exist_ok=True)
            for k, camera in enumerate(cameras):
                view_seed = (options.seed * 1_000_003 + done) & 0x7FFFFFFF
                picture = render_view(scene, camera, options.integrator, view_seed)
                stem = out_dir / split / f"r_{k}"
                written.append(writer.submit(_write_picture, picture, stem, scene.exposure, options.exr))
                done += 1
                if options.progress:
                    options.progress(done, total)
        for future in written:
            future.result()
    for split, cameras in splits.items():
        _write_json(out_dir / f"transforms_{split}.json", _transforms(scene, split, cameras))
    scene.write_truth(out_dir)
    _write_json(out_dir / "provenance.json", _provenance(scene, options, time.perf_counter() - started))
    return out_dir


def _write_picture(picture: Picture, stem: Path, exposure: float, exr: bool) -> None:
    write_png(stem.with_suffix(".png"), picture.rgba8(exposure))
    if exr:
        write_exr(stem.with_suffix(".exr"), exr_channels(picture))


def exr_channels(picture: Picture) -> dict[str, np.ndarray]:
    """Channels of a float picture: R, G, B (linear, premultiplied), A, Z (distance), variance of the mean."""
    channels = {name: picture.rgb[..., c] for c, name in enumerate("RGB")}
    channels |= {"A": picture.alpha, "Z": picture.distance}
    if picture.variance is not None:
        channels |= {f"variance.{name}": picture.variance[..., c] for c, name in enumerate("RGB")}
    return channels


def _transforms(scene: Renderable, split: str, cameras: list[Camera]) -> dict:
    frames = [
        {"file_path": f"./{split}/r_{k}", "transform_matrix": camera.c2w.tolist()} for k, camera in enumerate(cameras)
    ]
    return {"camera_angle_x": cameras[0].angle_x, "aabb": scene.aabb.tolist(), "frames": frames}


def _provenance(scene: Renderable, options: Options, seconds: float) -> dict:
    import numba

    integrator = options.integrator
    return {
        "scene": scene.name,
        "parameters": dict(scene.parameters),
        "integrator": repr(integrator) if integrator is not None else scene.integrators[0],
        "views": options.views,
        "size": list(options.size),
        "seed": options.seed,
        "seconds": round(seconds, 3),
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
