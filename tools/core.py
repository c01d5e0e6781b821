"""Installs the package as pip does it, without extras, into an environment of its own, and trains there.

    python tools/core.py      (make core)

What is asked of it: no torch, at most MOST_MB, the licence and the files of configs/ inside, and a training, a picture and a
page from an octree. Needs pip's package index and a C++ compiler.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_MB = 350
SCENE = "import sys; sys.path.append(sys.argv[1]); from tests.fixtures.tiny import write_scene; from pathlib import Path; " \
        "write_scene(Path('scene'), {'train': 12, 'val': 2})"  # fmt: skip


def main() -> int:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheels, env = folder / "wheels", folder / "env"
        subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", wheels, ROOT], check=True)
        (wheel,) = wheels.glob("nerfvol-*.whl")
        check_contents(zipfile.ZipFile(wheel).namelist())
        subprocess.run([sys.executable, "-m", "venv", env], check=True)
        python = env / "bin" / "python"
        subprocess.run([python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel], check=True)
        listed = subprocess.run(
            [python, "-m", "pip", "list", "--format=json"], check=True, capture_output=True, text=True
        )
        names = {row["name"].lower() for row in json.loads(listed.stdout)}
        assert not names & {"torch", "numba", "imageio", "scipy", "scikit-image"}, f"the core installs {sorted(names)}"
        files = [path for path in (env / "lib").rglob("*") if path.is_file() and not path.is_symlink()]
        megabytes = sum(path.stat().st_size for path in files) / 1e6
        assert megabytes <= MOST_MB, f"the core takes {megabytes:.0f} MB, at most {MOST_MB} were promised"
        environment = {**os.environ, "PYTHONPATH": ""}
        subprocess.run([python, "-c", SCENE, ROOT], cwd=folder, check=True, env=environment)
        nerfvol = env / "bin" / "nerfvol"
        train = "train --config smoke.yaml --data scene --out run"
        for words in (train, "render run --orbit 1 --out views", "export run --out run.html"):
            subprocess.run([nerfvol, *words.split()], cwd=folder, check=True, env=environment)
        print(f"core: {megabytes:.0f} MB, {len(names)} packages, none of them torch; it trains, draws and exports")
    return 0


def check_contents(names: list[str]) -> None:
    """AssertionError where the wheel lacks something or holds too much."""
    assert any("/licenses/LICENSE" in name or name.endswith("/LICENSE") for name in names), "the wheel has no LICENSE"
    assert {"nerfvol/configs/smoke.yaml", "nerfvol/configs/paper_mlp.yaml"} <= set(names), "the wheel has no configs"
    assert any(name.startswith("_nerfvol_kernels") for name in names), "the wheel has no compiled kernels"
    assert not [name for name in names if name.startswith(("tests/", "tools/"))], "the wheel holds tests"


if __name__ == "__main__":
    sys.exit(main())
