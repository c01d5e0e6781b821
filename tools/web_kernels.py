"""Builds nerfvol/viewer/kernels.wasm from kernels/csrc/web.cpp: ``make wasm``. Users never need it; the result is committed.

Next to it goes kernels.json: which sources, byte by byte, it was made from, and by which compiler. A test compares.
The compiler: clang++ with wasm-ld and a WASI library (Debian: clang-19 lld-19 wasi-libc libc++-19-dev-wasm32
libc++abi-19-dev-wasm32 libclang-rt-19-dev-wasm32), or ``python -m ziglang c++``.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "nerfvol" / "kernels" / "csrc"
UNITS = (
    "web.cpp",
    "web_octree.cpp",
    "web_splats.cpp",
    "web_inflate.cpp",
    "web_pool.cpp",
    "prefilter.cpp",
    "topology.cpp",
)
OUT = ROOT / "nerfvol" / "viewer" / "kernels.wasm"
STAMP = OUT.with_suffix(".json")
FLAGS = (
    "-std=c++17", "-O3", "-msimd128", "-fno-exceptions", "-fno-rtti", "-fno-threadsafe-statics",
    "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-DNERFVOL_ISA=baseline", "-DNERFVOL_SHORT_ROWS",
    "-Wall", "-Wextra", "-Wno-psabi",
)  # fmt: skip
LINK = ("-mexec-model=reactor", "-Wl,-z,stack-size=1048576", "-Wl,--gc-sections", "-Wl,--strip-all")
"""Packets of rays overflow the linker's own stack of 64 kB."""


def compilers() -> list[list[str]]:
    """Commands that may build it, the preferred one first."""
    names = [f"clang++-{version}" for version in range(30, 13, -1)] + ["clang++"]
    found = [[path, "--target=wasm32-wasi"] for name in names if (path := shutil.which(name))]
    if importlib.util.find_spec("ziglang") is not None:
        found.append([sys.executable, "-m", "ziglang", "c++", "-target", "wasm32-wasi"])
    return found


def sources(compiler: list[str]) -> dict[str, str]:
    """SHA-256 of each file of csrc that the preprocessor reads, by name."""
    command = [*compiler, *FLAGS, "-MM", *UNITS]
    listed = subprocess.run(command, cwd=SOURCES, check=True, capture_output=True, text=True).stdout
    names = {Path(word).name for word in re.split(r"[\s\\]+", listed) if word.endswith((".h", ".cpp"))}
    return {name: digest(SOURCES / name) for name in sorted(names)}


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> int:
    """Builds with the first compiler that can; the exit code."""
    said = []
    for compiler in compilers():
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "kernels.wasm"
            done = subprocess.run(
                [*compiler, *FLAGS, *UNITS, "-o", str(made), *LINK], cwd=SOURCES, capture_output=True, text=True
            )
            if done.returncode:
                said.append(
                    f"{' '.join(compiler)}: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else 'failed'}"
                )
                continue
            sys.stderr.write(done.stderr)
            version = subprocess.run([*compiler[:1], "--version"] if len(compiler) == 2 else [*compiler[:3], "version"],
                                     capture_output=True, text=True).stdout.splitlines()[0]  # fmt: skip
            OUT.write_bytes(made.read_bytes())
        stamp = {"compiler": version, "flags": [*FLAGS, *LINK], "wasm": digest(OUT), "sources": sources(compiler)}
        STAMP.write_text(json.dumps(stamp, indent=1) + "\n")
        print(f"{OUT.relative_to(ROOT)}: {OUT.stat().st_size} bytes from {len(stamp['sources'])} files, {version}")
        return 0
    print(
        "no compiler for WebAssembly: install clang, lld and wasi-libc, or ziglang", *said, sep="\n  ", file=sys.stderr
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
