"""05  Make a cloud whose density is known, train on its pictures, and compare with the truth.

    python examples/05_cloud.py [RESOLUTION]

Pictures fix what light passes through (opacity along chords) better than the inside of a thick body (density).
"""

import sys

import data_synth as ds
import nerfvol
from nerfvol.measure import truth
from nerfvol.octree.io import load_octree

resolution = int(sys.argv[1]) if len(sys.argv) > 1 else 32
cloud = ds.scenes.cloud(resolution=resolution, density=6.0, coverage=0.8)
scene = ds.write_dataset(cloud, "cloud", ds.Options(views=24, size=(64, 64)))

# Media are no surfaces: the terms that gather what a ray sees in one place are nearly off.
medium = {"levels": [4, 5], "downscales": [2, 1], "stage_ends": [0.3, 1.0], "tiles": [32, 64], "prunes": [1, 2]}
medium |= {"steps": 300, "colour_weight": 0.01, "distortion": 0.0}
run = nerfvol.train(data=scene, out="cloud_run", background="black", octree=medium)
octree, _ = load_octree(run / "octree.safetensors")

grid = truth.load_grid(scene / "density.npz")
scores = truth.compare(octree, grid)
truth.write_slices("cloud_slices.png", octree, grid)
for name in ("opacity", "density"):
    print(f"{name}: relative L1 {scores[f'{name}_relative_l1']:.3f}, correlation {scores[f'{name}_correlation']:.3f}")
print("cloud_slices.png: middle slices, true | recovered")
