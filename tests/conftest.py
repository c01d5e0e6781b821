"""Fixtures that several test files need: the tiny scene, an octree of it, the command line."""

import os
from pathlib import Path

import hypothesis
import pytest

from nerfvol.octree.tree import Octree
from tests.fixtures.tiny import make_sphere_octree, write_scene

os.environ.setdefault("OMP_NUM_THREADS", "1")
# The same examples in every run, however long they take: what is to be found by chance is looked for by tools/fuzz.py.
hypothesis.settings.register_profile(
    "same", derandomize=True, deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("same")


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    """Twelve training views, two of val and two of test, 40x40."""
    return write_scene(tmp_path_factory.mktemp("tiny"), {"train": 12, "val": 2, "test": 2})


@pytest.fixture(scope="session")
def sphere_octree() -> Octree:
    return make_sphere_octree()


@pytest.fixture
def command(capsys):
    """Run the command line in this process: command("eval", ...) -> (exit code, stdout, stderr)."""
    from nerfvol.cli.main import main

    def run(*arguments):
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run
