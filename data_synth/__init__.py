"""data_synth: volumes with a known truth, rendered to posed image sets. Imports nothing from nerfvol.

>>> import data_synth as ds
>>> scene = ds.scenes.cloud(resolution=64)
>>> picture = ds.render(scene, scene.viewpoints.camera(30, 20, 64, 64), integrator=ds.Path(spp=4))

docs/data_synth.md has a snippet for each of the names below. They are loaded when they are asked for: who writes a volume
does not need what compiles scenes (numba, the extra ``nerfvol[synth]``).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from data_synth import (
        channels,
        clouds,
        level_sets,
        lights,
        materials,
        media,
        microflakes,
        phase,
        raycast,
        scenes,
        sggx,
        spongecake,
        surfaces,
        volumes,
        weather,
    )  # fmt: skip
    from data_synth.cameras import Camera, Viewpoints, look_at
    from data_synth.dataset import Options, write_dataset
    from data_synth.errors import InputError, RenderWarning
    from data_synth.image import Picture, read_exr, write_exr, write_png
    from data_synth.integrators import DeepShadow, Emission, March, Path, Preview, RayCast
    from data_synth.scene import Scene
    from data_synth.scene_file import load as load_scene
    from data_synth.transmittance import sample_flights, sample_transmittance
    from data_synth.views import render_view
    from data_synth.views import render_view as render

__all__ = [
    "Camera", "DeepShadow", "Emission", "InputError", "March", "Options", "Path", "Picture", "Preview", "RayCast",
    "RenderWarning", "Scene", "Viewpoints", "channels", "clouds", "level_sets", "lights", "load_scene", "look_at", "materials",
    "media", "microflakes", "phase", "raycast", "read_exr", "render", "render_view", "sample_flights", "sample_transmittance",
    "scenes", "sggx", "spongecake", "surfaces", "volumes", "weather", "write_dataset", "write_exr", "write_png",
]  # fmt: skip

_HOMES = {
    "Camera": "cameras", "Viewpoints": "cameras", "look_at": "cameras", "Options": "dataset", "render_view": "views",
    "render": "views:render_view", "write_dataset": "dataset", "InputError": "errors", "RenderWarning": "errors",
    "Picture": "image", "read_exr": "image", "write_exr": "image", "write_png": "image", "DeepShadow": "integrators",
    "Emission": "integrators", "March": "integrators", "Path": "integrators", "Preview": "integrators",
    "RayCast": "integrators", "Scene": "scene", "load_scene": "scene_file:load", "sample_flights": "transmittance",
    "sample_transmittance": "transmittance",
}  # fmt: skip
"""The module of each name, and its name there where that differs; the rest of ``__all__`` are modules."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own = _HOMES.get(name, name).partition(":")
    loaded = importlib.import_module(f"{__name__}.{module}")
    value = globals()[name] = getattr(loaded, own or name) if name in _HOMES else loaded
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
