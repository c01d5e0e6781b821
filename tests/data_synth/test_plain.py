"""The tracer's source without a compiler: see plain_paths.py."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMMAND = "-m pytest -q -x -n 0 -p no:cacheprovider tests/data_synth/plain_paths.py tests/data_synth/plain_fields.py"


def test_paths_in_plain_python():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, *COMMAND.split()]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:]
