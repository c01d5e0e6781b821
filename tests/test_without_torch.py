"""What is done without torch and numba: all of the default paths, and one sentence where an extra is needed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nerfvol.native import native

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(native() is None, reason="without compiled kernels everything needs torch")

BLOCKED = """import sys
sys.modules["torch"] = sys.modules["numba"] = None
from nerfvol.cli.main import main
sys.exit(main(sys.argv[1:]))"""
OCTREE = ["octree.levels=[3,4]", "octree.downscales=[2,1]", "octree.stage_ends=[0.5,1]", "octree.tiles=[8,8]",
          "octree.prunes=[1,1]", "octree.steps=12"]  # fmt: skip
FIELD = ["field.steps=12", "field.samples_per_step=2048", "field.grid_resolution=16", "field.march_steps=[32]",
         "field.shape.hash_levels=4", "field.shape.hash_log2_table=10", "field.shape.hash_max=32"]  # fmt: skip
KINDS = {
    "octree": ["--init", "direct"],
    "distilled": [
        "--init",
        "mlp",
        *(w for s in FIELD for w in ("--set", s)),
        "--set",
        "distill.level=4",
        "--set",
        "distill.coarse_level=3",
    ],
    "splats": ["--representation", "splats", "--set", "splats.steps=12"],
    "field": ["--representation", "field", *(word for setting in FIELD for word in ("--set", setting))],
}


def run(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", BLOCKED, *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("kind", KINDS)
def test_training_drawing_scoring_and_exporting(tiny_scene, tmp_path, kind):
    settings = [word for setting in OCTREE for word in ("--set", setting)]
    done = run(tmp_path, "train", "--data", tiny_scene, "--out", "run", *KINDS[kind], *settings)
    assert done.returncode == 0, done.stdout + done.stderr
    exports = {"octree": (["o.npz", "--format", "plenoctree"], ["o.vdb", "--level", "3"]), "splats": (["o.ply"],)}
    for words in (
        ["render", "run", "--orbit", "1", "--size", "16x16", "--out", "views"], ["eval", "run", "--data", tiny_scene],
        ["info", "run"], *(["export", "run", "--out", *words] for words in exports.get(kind, ())),
    ):  # fmt: skip
        done = run(tmp_path, *words)
        assert done.returncode == 0, done.stdout + done.stderr


def test_what_needs_it_says_which_extra_has_it(tiny_scene, tmp_path):
    done = run(tmp_path, "train", "--data", tiny_scene, "--out", "run", "--init", "mlp", "--set", "field.trainer=torch")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1 and "needs torch" in done.stderr and "pip install 'nerfvol[mlp]'" in done.stderr
    done = run(tmp_path, "synth", "slab", "--out", "scene", "--views", "1", "--size", "8x8")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1 and "pip install 'nerfvol[synth]'" in done.stderr
