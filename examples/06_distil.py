"""06  Train a small neural field and distil it into an octree, step by step (needs torch).

    python examples/06_distil.py [DIR]

``nerfvol.train(..., init="mlp")`` does this and then optimises the octree.
"""

import sys

import data_synth as ds
import nerfvol
from nerfvol.config.field import DistillConfig, FieldConfig
from nerfvol.octree.io import save_octree
from nerfvol.starts.field import distill
from nerfvol.training.field_trainer import FieldTrainer

WHITE = (1.0, 1.0, 1.0)
data = sys.argv[1] if len(sys.argv) > 1 else "scene"
if data == "scene":
    ds.write_dataset(ds.scenes.Showcase(), "scene", ds.Options(views=30, size=(80, 80)))
dataset = nerfvol.load_dataset(data)

short = {"steps": 100, "downscales": (2, 1), "stage_ends": (0.5, 1.0), "march_steps": (48, 64), "grid_resolution": 32}
settings = FieldConfig(**short, samples_per_step=8192, bfloat16=False)
trainer = FieldTrainer(dataset, settings, seed=0, background=WHITE)
for step in range(1, settings.steps + 1):
    report = trainer.step()
    if step % 25 == 0:
        print(f"step {step}: {report.psnr:.1f} dB on the batch, {report.samples:.0f} samples a ray")

settings = DistillConfig(level=5)
octree, report = distill(trainer.trained_field(), trainer.domain, dataset, WHITE, settings, trainer.picture)
print(report)
save_octree("distilled.safetensors", octree, {"background": WHITE}, "compact")
