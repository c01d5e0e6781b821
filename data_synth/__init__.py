"""data_synth: volumes with a known truth, rendered to posed image sets. Imports nothing from nerfvol.

>>> import data_synth as ds
>>> scene = ds.scenes.cloud(resolution=64)
>>> picture = ds.render(scene, scene.viewpoints.camera(30, 20, 64, 64), integrator=ds.Path(spp=4))

docs/data_synth.md has a snippet for each of the names below.
"""

__version__ = "0.2.0"

from data_synth import (
    clouds,
    lights,
    materials,
    media,
    phase,
    scenes,
    sggx,
    spongecake,
    surfaces,
    volumes,
)  # fmt: skip
from data_synth.cameras import Camera, Viewpoints, look_at
from data_synth.dataset import Options, write_dataset
from data_synth.errors import InputError, RenderWarning
from data_synth.image import Picture, read_exr, write_exr, write_png
from data_synth.integrators import DeepShadow, Emission, March, Path, Preview
from data_synth.scene import Scene
from data_synth.scene_file import load as load_scene
from data_synth.transmittance import sample_flights, sample_transmittance
from data_synth.views import render_view

render = render_view

__all__ = [
    "Camera", "DeepShadow", "Emission", "InputError", "March", "Options", "Path", "Picture", "Preview", "RenderWarning",
    "Scene", "Viewpoints", "clouds", "lights", "load_scene", "look_at", "materials", "media", "phase", "read_exr", "render",
    "render_view", "sample_flights", "sample_transmittance", "scenes", "sggx", "spongecake", "surfaces",
    "volumes", "write_dataset", "write_exr", "write_png",
]  # fmt: skip
