"""kill -9 and SIGTERM at random moments of train, synth, render and export: nothing half or lost, the same bytes after."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from nerfvol.octree.io import save_octree
from tests.fixtures.runs import TINY

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(os.name != "posix", reason="the system has no such signals")


def kill(folder: Path, seed: int, first: str, command: str, names: str) -> None:
    """Runs the command (killing.py); then each folder has of ``names`` what the undisturbed one has, and nothing half."""
    script = [sys.executable, "tests/cli/killing.py", str(seed), first, str(folder), *command.split()]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    done = subprocess.run(script, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr[-2000:]
    assert int(done.stdout.split()[-1]) >= 1
    whole, *others = (
        {p.relative_to(run): p.read_bytes() for p in run.rglob(names) if p.is_file()}
        for run in (folder / "whole", *folder.glob("killed_*"))
    )
    assert whole and len(others) >= 2 and all(other == whole for other in others)
    assert not list(folder.rglob(".*.tmp*"))


def test_train(tmp_path, tiny_scene):
    config = tmp_path / "tiny.yaml"
    octree = TINY["octree"] | {"steps": 20}
    config.write_text(yaml.safe_dump(TINY | {"data": str(tiny_scene), "init": "direct", "octree": octree}))
    command = f"train --config {config} --out OUT --then train --resume --out OUT"
    kill(tmp_path, 0, "checkpoint.safetensors", command, "octree.safetensors")


def test_synth(tmp_path):
    kill(tmp_path, 1, "", "synth slab --views 3 --size 8x6 --integrator emission --out OUT", "[rtd]*")


def test_render_and_export(tmp_path, sphere_octree):
    model = tmp_path / "o.safetensors"
    save_octree(model, sphere_octree, {})
    for folder, command, names in (
        ("frames", f"render {model} --orbit 6 --size 24x24 --frames 0-5 --out OUT", "*.png"),
        ("grid", f"export {model} --resolution 64 --out OUT/o.npy", "o.npy"),
    ):
        (tmp_path / folder).mkdir()
        kill(tmp_path / folder, 2, "", command, names)
