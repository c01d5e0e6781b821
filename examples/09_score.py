"""09  Score a model on views it has not seen: PSNR and SSIM a view, and truth | render side by side for the worst.

    python examples/09_score.py [RUN DIR]

``nerfvol eval RUN --data DIR --split test`` prints the same means.
"""

import sys
from pathlib import Path

import data_synth as ds
import nerfvol
from nerfvol.files import pictures
from nerfvol.measure.scores import evaluate

SHORT = {"steps": 300, "levels": [5, 6], "downscales": [2, 1], "stage_ends": [0.4, 1.0], "tiles": [64, 96],
         "prunes": [2, 2]}  # fmt: skip
run, scene = (Path(name) for name in (sys.argv[1:3] if len(sys.argv) > 2 else ("run", "scene")))
if not run.exists():  # a small one
    ds.write_dataset(ds.scenes.Showcase(), scene, ds.Options(views=30, size=(80, 80)))
    nerfvol.train(data=scene, out=run, octree=SHORT)
model, views = nerfvol.load_model(run), nerfvol.load_dataset(scene, "test")
background = model.metadata["background"]

pairs = {}
scores = evaluate(model, views, background, on_view=lambda i, truth, image: pairs.update({i: (truth, image)}))
for row in scores["rows"]:
    print(f"{row['name']:>8}  {row['psnr']:6.2f} dB  {row['ssim']:.4f}")
print(f"    mean  {scores['psnr']:6.2f} dB  {scores['ssim']:.4f}   over background {background}")
worst = min(pairs, key=lambda i: scores["rows"][i]["psnr"])
pictures.write_png(Path("worst.png"), pictures.side_by_side(list(pairs[worst])))
