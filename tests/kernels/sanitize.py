"""Builds the kernels with the address and undefined-behaviour sanitizers and runs the kernels' tests on them.

    python tests/kernels/sanitize.py [BUILD_DIR]      (make sanitize)

The build directory (default build/sanitize) is kept, so that a second run compiles only what has changed. Exits with 0
where there is no C++ compiler or no sanitizer runtime: then there is nothing to check.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Every build of every kernel: images, gradients, steps, determinism (threads) and the refusals.
TESTS = ("test_ops.py", "test_train.py", "test_determinism.py", "test_checks.py")


def runtime(compiler: str) -> str:
    """The sanitizer's shared library, which must be loaded before Python; empty where there is none."""
    for name in ("libasan.so", "libclang_rt.asan-x86_64.so", "libclang_rt.asan-aarch64.so"):
        found = subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        if Path(found.stdout.strip()).is_absolute():
            return found.stdout.strip()
    return ""


def main() -> int:
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    cmake = shutil.which("cmake")
    library = runtime(compiler) if compiler and cmake else ""
    if not library:
        print("sanitize: no C++ compiler, CMake or sanitizer runtime here; nothing was checked")
        return 0
    build = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "build" / "sanitize").resolve()
    generator = ["-G", "Ninja"] if shutil.which("ninja") else []
    source = ROOT / "nerfvol" / "kernels" / "csrc"
    options = ["-DNERFVOL_SANITIZE=ON", "-DSKBUILD_PROJECT_VERSION=sanitize", f"-DPython_EXECUTABLE={sys.executable}"]
    subprocess.run([cmake, "-S", source, "-B", build, *generator, *options], check=True, stdout=subprocess.DEVNULL)
    subprocess.run([cmake, "--build", build, "--parallel"], check=True, stdout=subprocess.DEVNULL)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(build), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
        "LD_PRELOAD": library,
        # Python and torch keep memory to their end: leaks are not looked for. A report ends the run.
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:halt_on_error=1",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "OMP_NUM_THREADS": "1",
        "NERFVOL_EXPECT_KERNELS": str(build),
    }
    tests = [str(ROOT / "tests" / "kernels" / name) for name in TESTS]
    # -s: a sanitizer writes its report to the process's own stderr, which pytest would swallow.
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-s", "-p", "no:cacheprovider", *tests]
    return subprocess.run(command, cwd=ROOT, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
