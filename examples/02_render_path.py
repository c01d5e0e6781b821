"""02  Render a camera path of your own: a descending spiral, as a video and as a camera file.

    python examples/02_render_path.py [RUN]

``nerfvol render RUN --cameras spiral.json --out spiral.mp4`` renders the same path.
"""

import json
import sys
from pathlib import Path

import data_synth as ds
import nerfvol
from nerfvol.cameras.paths import cameras_document
from nerfvol.files.pictures import open_video

SHORT = {"steps": 300, "levels": [5, 6], "downscales": [2, 1], "stage_ends": [0.4, 1.0], "tiles": [64, 96],
         "prunes": [2, 2]}  # fmt: skip
run = Path(sys.argv[1] if len(sys.argv) > 1 else "run")
if not run.exists():  # a small one
    scene = ds.write_dataset(ds.scenes.Showcase(), "scene", ds.Options(views=30, size=(80, 80)))
    nerfvol.train(data=scene, out=run, octree=SHORT)
model = nerfvol.load_model(run)

lens = nerfvol.Intrinsics(width=160, height=120, fx=170.0, fy=170.0, cx=80.0, cy=60.0)
stored = model.metadata["orbit"]  # around what the training cameras looked at
circle = {"center": stored["center"], "radius": stored["radius"], "intrinsics": lens}
rings = [nerfvol.orbit(24, elevation_deg=60 - 2 * i, **circle) for i in range(24)]
cameras = [ring[i] for i, ring in enumerate(rings)]
with open_video("spiral.mp4", fps=12) as video:
    for camera in cameras:
        video.add(model.render(camera)["rgb"])
Path("spiral.json").write_text(json.dumps(cameras_document(cameras, [f"{i:04d}" for i in range(24)])))
print("spiral.mp4, spiral.json")
