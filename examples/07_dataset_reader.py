"""07  A data set in a format of your own, poses.csv (name, eye, target) next to pictures; then training, step by step.

A reader ends with cameras, uint8 images, names, and the region that the scene fills. docs/extending.md makes it a format.
"""

import csv
from pathlib import Path

import numpy as np
from PIL import Image

import data_synth as ds
import nerfvol
from nerfvol.config.octree import OctreeConfig
from nerfvol.region import SceneBounds
from nerfvol.training.octree_trainer import OctreeTrainer


def read(folder: Path, focal: float, box: np.ndarray) -> nerfvol.Dataset:
    rows = [(name, np.array(numbers, float)) for name, *numbers in csv.reader((folder / "poses.csv").open())]
    images = [np.asarray(Image.open(folder / name)) for name, _ in rows]
    lens = nerfvol.Intrinsics(64, 64, focal, focal, cx=32.0, cy=32.0)
    cameras = [nerfvol.Camera(lens, nerfvol.look_at(eye=v[:3], target=v[3:])) for _, v in rows]
    return nerfvol.Dataset(cameras, images, [name for name, _ in rows], SceneBounds(box, None, True), str(folder))


folder, scene = Path("."), ds.scenes.slab()
with open("poses.csv", "w") as file:
    for i, view in enumerate(scene.viewpoints.spread(20, 64, 64, seed=0)):
        Image.fromarray(ds.render(scene, view).rgba8(scene.exposure)).save(f"{i}.png")
        file.write(f"{i}.png,{','.join(map(str, view.c2w[:3, 3]))},0,0,0\n")
stages = OctreeConfig(levels=[4, 5], downscales=[2, 1], stage_ends=[0.4, 1.0], tiles=[32, 64], prunes=[1, 1])
trainer = OctreeTrainer(read(folder, view.focal, scene.aabb), (1.0, 1.0, 1.0), stages, seed=0, octree=None)
reports = [trainer.step(step / 200) for step in range(200)]
print(f"{trainer.octree.n_leaves} leaves, {-10 * np.log10(reports[-1].squared_error):.1f} dB on the last batch")
