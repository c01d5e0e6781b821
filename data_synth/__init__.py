"""data_synth: volumes with a known truth, rendered to posed image sets. Imports nothing from nerfvol.

>>> import data_synth as ds
>>> scene = ds.scenes.cloud(resolution=64)
>>> picture = ds.render(scene, scene.viewpoints.camera(30, 20, 64, 64), integrator=ds.Path(spp=4))
"""

__version__ = "0.1.0"

from data_synth import scenes
from data_synth.cameras import Camera, Viewpoints, look_at
from data_synth.dataset import Options, render_view, write_dataset
from data_synth.errors import InputError, RenderWarning
from data_synth.image import Picture
from data_synth.integrators import DeepShadow, Emission, March, Path, Preview
from data_synth.scene import Scene

render = render_view

__all__ = [
    "Camera", "DeepShadow", "Emission", "InputError", "March", "Options", "Path", "Picture", "Preview", "RenderWarning",
    "Scene", "Viewpoints", "look_at", "render", "scenes", "write_dataset",
]  # fmt: skip
