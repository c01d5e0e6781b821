"""01  Train an octree on a folder of posed images and see how well it does on views that it has not seen.

    python examples/01_train.py [DIR] [--out RUN] [--time-budget 2m]

Without DIR a small scene is rendered first and the run is short.
"""

import argparse
import json

import data_synth as ds
import nerfvol

SHORT = {"steps": 300, "levels": [5, 6], "downscales": [2, 1], "stage_ends": [0.4, 1.0], "tiles": [64, 96],
         "prunes": [2, 2]}  # fmt: skip

parser = argparse.ArgumentParser()
parser.add_argument("data", nargs="?", help="posed images: NeRF-synthetic, instant-ngp, nerfstudio, LLFF or COLMAP")
parser.add_argument("--out", default="run")
parser.add_argument("--time-budget", default=None, help="such as 2m; without: a number of steps")
options = parser.parse_args()

length: dict = {"time_budget": options.time_budget}
if options.data is None:
    options.data = ds.write_dataset(ds.scenes.Showcase(), "scene", ds.Options(views=30, size=(80, 80)))
    if options.time_budget is None:
        length = {"octree": SHORT}
run = nerfvol.train(data=options.data, out=options.out, background="white", **length)

scores = json.loads((run / "metrics.json").read_text())
print(f"{run}: PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f} on {scores['n_images']} held-out views")
