"""03  Ask an octree for its density at points: a horizontal slice, drawn in characters.

    python examples/03_query_density.py [RUN] [HEIGHT]

The density is an extinction coefficient, 1 / scene unit: light falls by exp(-density * length).
"""

import sys
from pathlib import Path

import numpy as np

import data_synth as ds
import nerfvol
from nerfvol.octree.io import load_octree
from nerfvol.octree.points import octree_density

SHORT = {"steps": 300, "levels": [5, 6], "downscales": [2, 1], "stage_ends": [0.4, 1.0], "tiles": [64, 96],
         "prunes": [2, 2]}  # fmt: skip
run = Path(sys.argv[1] if len(sys.argv) > 1 else "run")
if not run.exists():  # a small one
    scene = ds.write_dataset(ds.scenes.Showcase(), "scene", ds.Options(views=30, size=(80, 80)))
    nerfvol.train(data=scene, out=run, octree=SHORT)
octree, _ = load_octree(run / "octree.safetensors")
middle = octree.origin + octree.size / 2
height = float(sys.argv[2]) if len(sys.argv) > 2 else middle[2]
columns, rows = 72, 36  # characters are twice as high as wide
x = octree.origin[0] + (np.arange(columns) + 0.5) / columns * octree.size
y = octree.origin[1] + (np.arange(rows) + 0.5) / rows * octree.size
points = np.stack([*np.meshgrid(x, y), np.full((rows, columns), height)], axis=-1)
sigma = octree_density(octree, points.reshape(-1, 3)).reshape(rows, columns)
opacity = -np.expm1(-sigma * octree.size / columns)  # of a slab as thick as a column is wide
for row in opacity[::-1]:
    print("".join(" .:-=+*#%@"[min(int(10 * a), 9)] for a in row))
print(f"z = {height:g}: density up to {sigma.max():.3g} / unit, {np.mean(sigma > 0):.0%} of the slice is not empty")
