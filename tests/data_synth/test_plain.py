"""data_synth's source without a compiler: files plain_*.py, each in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path.name for path in Path(__file__).parent.glob("plain_*.py"))


@pytest.mark.parametrize("name", FILES)
def test_in_plain_python(name):
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [*"-m pytest -q -x -n 0 -p no:cacheprovider".split(), f"tests/data_synth/{name}"]
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=1800
    )
    assert done.returncode == 0, done.stdout[-3000:]
