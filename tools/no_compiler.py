"""Builds the package where there is no C++ compiler and uses it: pip must succeed, the commands must run and say so once.

    python tools/no_compiler.py      (make no-compiler)

The wheel is built by pip in an environment of its own, so this needs pip's package index. The packages that nerfvol
depends on are those of the Python that runs this.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# The Python that runs this may have compiled kernels installed: they are not of this wheel.
HIDE_INSTALLED = 'import sys\nsys.modules["_nerfvol_kernels"] = None\n'
USE = """
import sys
sys.path.append(sys.argv[1])  # after the wheel: of the checkout, only the tests' sphere is wanted
from nerfvol.cli import main as cli
from nerfvol.octree.io import save_octree
from tests.fixtures.tiny import make_sphere_octree

assert cli.__file__.startswith(sys.argv[2]), cli.__file__
save_octree("sphere.safetensors", make_sphere_octree(4), {})
assert cli.main(["info", "sphere.safetensors"]) == 0
assert cli.main(["render", "sphere.safetensors", "--orbit", "1", "--size", "48x48", "--out", "views"]) == 0
"""


def main() -> int:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheels, site, empty = folder / "wheels", folder / "site", folder / "bin"
        empty.mkdir()
        environment = {
            **os.environ,
            "PATH": str(empty),
            "CC": "/no/compiler",
            "CXX": "/no/compiler",
            "PYTHONPATH": "",
        }
        pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", wheels]
        # A build folder of its own: another one's cache knows where the compiler is.
        subprocess.run([*pip, f"--config-settings=build-dir={folder / 'build'}", ROOT], check=True, env=environment)
        (wheel,) = wheels.glob("nerfvol-*.whl")
        with zipfile.ZipFile(wheel) as archive:
            compiled = [name for name in archive.namelist() if "_nerfvol_kernels" in name]
            archive.extractall(site)
        assert not compiled, f"something compiled {compiled}: the compiler was not hidden"
        (site / "sitecustomize.py").write_text(HIDE_INSTALLED)
        environment["PYTHONPATH"] = str(site)
        command = [sys.executable, "-c", USE, ROOT, site]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        print(done.stdout + done.stderr)
        assert done.returncode == 0, "the package does not run without compiled kernels"
        assert "compute path    reference" in done.stdout
        assert done.stderr.count("kernels are not available") == 1 and "C++17 compiler" in done.stderr
        assert list((folder / "views").glob("*.png"))
    print("no-compiler: pip installs, and the commands run on the torch reference")
    return 0


if __name__ == "__main__":
    sys.exit(main())
