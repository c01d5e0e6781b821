"""08  Export an octree as coloured points (PLY) for any viewer of points, and in the three storages of its own file.

python examples/08_export.py [RUN]  (leaves that are opaque along their side, in their mean colour)
"""

import sys
from pathlib import Path

import numpy as np

import data_synth as ds
import nerfvol
from nerfvol.octree.io import load_octree, save_octree
from nerfvol.octree.points import octree_density

SHORT = {"steps": 300, "levels": [5, 6], "downscales": [2, 1], "stage_ends": [0.4, 1.0], "tiles": [64, 96],
         "prunes": [2, 2]}  # fmt: skip
run = Path(sys.argv[1] if len(sys.argv) > 1 else "run")
if not run.exists():  # a small one
    scene = ds.write_dataset(ds.scenes.Showcase(), "scene", ds.Options(views=30, size=(80, 80)))
    nerfvol.train(data=scene, out=run, octree=SHORT)
octree, metadata = load_octree(run / "octree.safetensors")

centers = octree.leaf_centers()
shown = -np.expm1(-octree_density(octree, centers) * octree.leaf_sizes()) > 0.3
mean_colour = 0.5 + 0.28209479 * octree.sh[octree.corners[shown], :, 0].mean(axis=1)
points = np.empty(shown.sum(), [("position", "<f4", 3), ("colour", "u1", 3)])
points["position"], points["colour"] = centers[shown], np.round(255 * np.clip(mean_colour, 0, 1))
header = "".join(f"property {c}\n" for c in ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"))
with open("points.ply", "wb") as file:
    file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{header}end_header\n".encode())
    file.write(points.tobytes())
print(f"points.ply: {len(points)} of {octree.n_leaves} leaves")
for storage in ("float32", "float16", "compact"):
    print(f"octree_{storage}: {save_octree(f'octree_{storage}.safetensors', octree, metadata, storage):,} bytes")
