"""Builds of the kernels in folders of their own, next to the installed one, and tests on them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def build_kernels(name: str, compiler: str, options: Sequence[str]) -> Path:
    """Build into ``build/NAME``, which is kept: a second run compiles only what has changed."""
    cmake = shutil.which("cmake") or "cmake"
    build = ROOT / "build" / name
    generator = ["-G", "Ninja"] if shutil.which("ninja") else []
    source = ROOT / "nerfvol" / "kernels" / "csrc"
    options = [f"-DSKBUILD_PROJECT_VERSION={name}", f"-DPython_EXECUTABLE={sys.executable}", *options]
    environment = {**os.environ, "CXX": compiler}
    configure = [cmake, "-S", source, "-B", build, *generator, *options]
    subprocess.run(configure, check=True, stdout=subprocess.DEVNULL, env=environment)
    # Not silenced: a compiler's messages come on standard output where ninja runs it.
    subprocess.run([cmake, "--build", build, "--parallel"], check=True, env=environment)
    return build


def run_tests(build: Path, tests: Sequence[str], environment: Mapping[str, str]) -> int:
    """The exit code of pytest on ``tests`` (paths below tests/) with the kernels of ``build``."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(build), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
        "OMP_NUM_THREADS": "1",
        "NERFVOL_EXPECT_KERNELS": str(build),
        **environment,
    }
    # -s: a sanitizer writes its report to the process's own stderr, which pytest would swallow.
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-s", "-p", "no:cacheprovider"]
    return subprocess.run([*command, *(str(ROOT / "tests" / t) for t in tests)], cwd=ROOT, env=environment).returncode
