"""The examples run as a stranger runs them, and so does the Python in the documents."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import nerfvol

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
WRITES = {
    "01_train": ["run/octree.safetensors"], "02_render_path": ["spiral.mp4", "spiral.json"], "05_cloud": ["cloud_slices.png"],
    "06_distil": ["distilled.safetensors"], "07_dataset_reader": ["poses.csv"], "08_export": ["points.ply"],
    "09_score": ["worst.png"],
}  # fmt: skip
SAYS = {
    "01_train": "dB", "03_query_density": "of the slice", "04_quadrature": "order of convergence: 1.00 with starts, 2.00 ",
    "05_cloud": "opacity: relative L1", "06_distil": "distilled", "07_dataset_reader": "leaves", "09_score": "mean",
    "10_known_truth": "0.5       0.9157",
}  # fmt: skip
LONGEST = 35


def run(*arguments, cwd: Path) -> str:
    """What Python prints, with this copy of the packages; the process must end well."""
    paths = [str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """One folder for all: who finds a run there does not make another."""
    return tmp_path_factory.mktemp("examples")


# ---------------------------------------------------------------- examples
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, folder):
    if path.stem == "06_distil" and importlib.util.find_spec("torch") is None:
        pytest.skip("needs torch")
    printed = run(path, cwd=folder)
    assert SAYS.get(path.stem, "") in printed
    for name in WRITES.get(path.stem, ()):
        assert (folder / name).stat().st_size > 0


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short_and_says_what_it_is(path):
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST
    assert text.startswith(f'"""{path.stem[:2]}  ')
    assert f"[{path.name}]({path.name})" in (ROOT / "examples" / "README.md").read_text()


def test_examples_are_numbered_from_one():
    assert [int(path.stem[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


# ---------------------------------------------------------------- documents
def blocks(text: str) -> list[str]:
    """The Python in a document. A fence that says ``python sketch`` shows the shape of something and is not run."""
    return re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


SNIPPETS = [
    pytest.param(block, id=f"{path.name}-{i}")
    for path in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
    for i, block in enumerate(blocks(path.read_text()))
]
QUICK = (
    ", init='direct', octree={'steps': 10, 'levels': [4], 'downscales': [2], 'stage_ends': [1.0], 'tiles': [16], "
    "'prunes': [1]}"
)


@pytest.fixture
def stranger(tiny_scene, tmp_path) -> Path:
    """A folder with what the documents speak of: ``photos``, ``run`` and an octree file."""
    (tmp_path / "photos").symlink_to(tiny_scene, target_is_directory=True)
    run("-c", f"import nerfvol; nerfvol.train(data='photos', out='run'{QUICK})", cwd=tmp_path)
    (tmp_path / "octree.safetensors").write_bytes((tmp_path / "run" / "octree.safetensors").read_bytes())
    return tmp_path


@pytest.mark.parametrize("block", SNIPPETS)
def test_snippet_runs(block, stranger):
    # a run of two minutes becomes one of ten steps
    (stranger / "snippet.py").write_text(re.sub(r", time_budget=\"\d+m\"", QUICK, block))
    run("snippet.py", cwd=stranger)


def test_blocks_are_found():
    text = "a\n```python\nx = 1\n```\n```python sketch\nx = y\n```\n```\nz\n```\n```python\nprint(2)\n```\n"
    assert blocks(text) == ["x = 1\n", "print(2)\n"]
    assert nerfvol.__doc__ and len(SNIPPETS) > 0
