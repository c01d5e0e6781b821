"""Builds the kernels with the address and undefined-behaviour sanitizers and runs the kernels' tests on them.

    python tools/sanitize.py      (make sanitize)

Exits with 0 where there is no C++ compiler or no sanitizer runtime: then there is nothing to check.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from own_build import build_kernels, run_tests

# Every build of every kernel: images, gradients, steps, determinism (threads) and the refusals.
TESTS = (
    *(f"kernels/{name}.py" for name in ("test_ops", "test_train", "test_determinism", "test_checks", "test_view")),
    "kernels/test_field_steps.py", "kernels/test_field_march.py", "splats/test_point_surfaces.py", "octree/test_merge.py",
    "splats/test_gradients.py", "splats/test_step.py", "starts/test_plane_sweep.py", "datasets/test_photographs.py",
    "octree/test_lod.py", "starts/test_surfaces.py",
)  # fmt: skip


def runtime(compiler: str) -> str:
    """The libraries that must be loaded before Python: the sanitizer's, and C++'s, in which it looks for the function that
    throws while it starts; empty where there is no sanitizer."""
    names = ("libasan.so", "libclang_rt.asan-x86_64.so", "libclang_rt.asan-aarch64.so")
    found = next((path for name in names if (path := _library(compiler, name))), "")
    return f"{found} {_library(compiler, 'libstdc++.so.6')}".strip() if found else ""


def _library(compiler: str, name: str) -> str:
    """The path of a library of the compiler's, or ""."""
    found = subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    return found.stdout.strip() if Path(found.stdout.strip()).is_absolute() else ""


def main() -> int:
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    library = runtime(compiler) if compiler and shutil.which("cmake") else ""
    if not compiler or not library:
        print("sanitize: no C++ compiler, CMake or sanitizer runtime here; nothing was checked")
        return 0
    build = build_kernels("sanitize", compiler, ["-DNERFVOL_SANITIZE=ON"])
    environment = {
        "LD_PRELOAD": library,
        # Python and torch keep memory to their end: leaks are not looked for. A report ends the run.
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:halt_on_error=1",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
    }
    return run_tests(build, TESTS, environment)


if __name__ == "__main__":
    sys.exit(main())
