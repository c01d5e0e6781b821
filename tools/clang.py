"""Builds the kernels with Clang, no warning allowed, and runs what tests them, on every instruction set of this machine.

    python tools/clang.py      (make clang)

CXX names another Clang than clang++. Exits with 0 where there is none: then there is nothing to check.
"""

from __future__ import annotations

import os
import shutil
import sys

from own_build import build_kernels, run_tests

TESTS = (
    "kernels",
    "octree",
    "test_views.py",
    "datasets/test_tiles.py",
    "splats/test_gradients.py",
    "splats/test_step.py",
)


def main() -> int:
    named = os.environ.get("CXX", "")
    compiler = shutil.which(named if "clang" in named else "clang++")
    if not compiler or not shutil.which("cmake"):
        print("clang: no clang++ or CMake here; nothing was checked")
        return 0
    build = build_kernels("clang", compiler, ["-DCMAKE_COMPILE_WARNING_AS_ERROR=ON"])
    return run_tests(build, TESTS, {})


if __name__ == "__main__":
    sys.exit(main())
