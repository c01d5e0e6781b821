"""nerfvol: from posed photographs to a sparse octree radiance field, on an ordinary CPU.

>>> import nerfvol
>>> run = nerfvol.train(data="photographs", out="run", time_budget="2m")
>>> model = nerfvol.load_model(run)
>>> lens = nerfvol.Intrinsics(width=800, height=600, fx=700.0, fy=700.0, cx=400.0, cy=300.0)
>>> camera = nerfvol.Camera(lens, nerfvol.look_at(eye=(4, 0, 2), target=(0, 0, 0)))
>>> picture = model.render(camera)["rgb"]

Names are loaded when they are asked for: ``import nerfvol`` alone loads neither numpy nor torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from pathlib import Path

    from nerfvol.cameras.camera import Camera, look_at, orbit
    from nerfvol.cameras.intrinsics import Intrinsics
    from nerfvol.config.training import Config
    from nerfvol.datasets.dataset import Dataset
    from nerfvol.datasets.load import load_dataset
    from nerfvol.errors import InputError
    from nerfvol.models import load_model, save_model
    from nerfvol.octree.tree import Octree
    from nerfvol.splats.splats import Splats
    from nerfvol.views import render_image

__all__ = [
    "Camera", "Config", "Dataset", "InputError", "Intrinsics", "Octree", "Splats", "load_dataset", "load_model",
    "look_at", "orbit", "render_image", "save_model", "train",
]  # fmt: skip

_HOMES = {
    "Camera": "cameras.camera", "Intrinsics": "cameras.intrinsics", "look_at": "cameras.camera", "orbit": "cameras.camera",
    "Config": "config.training", "Dataset": "datasets.dataset", "load_dataset": "datasets.load", "InputError": "errors",
    "Octree": "octree.tree", "Splats": "splats.splats", "load_model": "models", "save_model": "models", "render_image": "views",
}  # fmt: skip
"""The module that holds each name; the block above says the same to type checkers."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def train(config: Config | None = None, /, **settings: Any) -> Path:
    """Train a model on posed images, as ``nerfvol train`` does, and return the run folder, which :func:`load_model` opens.

    Args:
        config: all settings; without, the defaults. It is not changed.
        settings: what differs from it, by the names and with the values that ``--config`` files have (docs/cli.md):
            ``data`` (folder of posed images), ``out`` (run folder), ``time_budget="2m"`` (counted from this call),
            ``seed=1``, sections as dicts: ``octree={"steps": 2000}``. With ``resume=True`` they are those of the run in
            ``out``.

    Raises:
        InputError: a setting that is unknown or does not fit, data that cannot be used, too little memory, a full disk; one
            sentence.
        KeyboardInterrupt: Ctrl-C, after the step was finished and a checkpoint written.
    """
    import time
    from pathlib import Path

    from nerfvol.config.assemble import assemble, read_yaml, to_plain
    from nerfvol.config.training import Config
    from nerfvol.errors import InputError
    from nerfvol.kernels.threads import set_threads
    from nerfvol.machine import usable_cores
    from nerfvol.training.prepare import resumable_config
    from nerfvol.training.train import train

    started = time.perf_counter()
    layers = [] if config is None else [(to_plain(config), "config")]
    if settings.get("resume") and settings.get("out"):
        saved = resumable_config(settings["out"])
        layers.append((read_yaml(saved), str(saved)))
    chosen = assemble(Config, *layers, (settings, "train"))
    for name in ("data", "out"):
        if not getattr(chosen, name):
            raise InputError(f"train needs {name!r}: the folder of {'posed images' if name == 'data' else 'the run'}")
    if not Path(chosen.data).exists():
        raise InputError(f"{chosen.data}: no such folder or file")
    set_threads(chosen.threads or usable_cores())
    train(chosen, started)
    return Path(chosen.out)
